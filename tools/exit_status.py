"""Exit statuses of the `raceloop` command."""

from enum import IntEnum


class ExitStatus(IntEnum):
    """What the command tells its caller."""

    DONE = 0
    MISSED = 1
    """It ran, and missed its end: a scenario its finish, a measurement its target, a replay its likeness."""
    USER_ERROR = 2
    """A mistake in what the user gave; also argparse's."""
    INTERRUPTED = 130
