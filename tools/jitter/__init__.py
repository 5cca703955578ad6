"""`raceloop jitter`: how regular an ECU's cycle is, beside what the machine can do and what users have today."""
