"""Autonomy of the car: track, estimation, race line and planning."""
