"""Embedded C of the ECUs, with the sources and the generator of its tables."""
