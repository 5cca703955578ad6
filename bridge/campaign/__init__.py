"""Fault campaigns: every fault of a list at every onset of a grid, from the saved states of one drive."""
