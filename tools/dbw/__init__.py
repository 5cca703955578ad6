"""`raceloop dbw`: drive-by-wire messages as they are on the wire, for people."""
