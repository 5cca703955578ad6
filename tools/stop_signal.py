"""SIGTERM as Ctrl-C, for commands that have processes to end."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def asked_to_stop_is_ctrl_c() -> Iterator[None]:
    """Let SIGTERM raise KeyboardInterrupt, so that all is put in order and nothing is left running."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
