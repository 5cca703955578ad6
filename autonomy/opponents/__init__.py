"""Opponents: tracking of detections and prediction of where the tracked cars will be."""
