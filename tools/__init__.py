"""The `raceloop` command and what it prints."""
