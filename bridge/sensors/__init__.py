"""Sensor models: the truth of the plant in, CAN-S frames with realistic errors out."""
