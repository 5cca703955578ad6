"""Sensor models: the truth of the plant in, frames of CAN-S and CAN-R with realistic errors out."""
