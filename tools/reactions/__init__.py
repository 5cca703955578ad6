"""The reaction matrix: every fault in every operating state, for several durations, measured. See docs/reactions.md."""
