"""Mutation testing of the firmware: how many small faults in it the unit tests notice."""
