"""Text logs with a frame a line: the usual lines are read in C, the few others one by one."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

from bridge._native import ffi
from dbc.frames import FRAME_SIZE
from tools.dbw.chunk import OnBroken

#: Characters after which a line that does not end is no line.
_LINE_MAX = 1 << 16


class Usual(NamedTuple):
    """Usual lines that were read: their frames, a line each, and their length with their ends."""

    frames: bytes
    used: int


ReadUsual = Callable[[Any, int], Usual]
"""Takes a place in the text (`char *`) and how much there is; reads lines up to one that is not usual."""

ReadOther = Callable[[str], bytes | None]
"""Takes a line; gives its frames, which may be none, or None when it should be a frame and is not."""


def read_text(
    blocks: Iterable[bytes], read_usual: ReadUsual, read_other: ReadOther, on_broken: OnBroken
) -> Iterator[bytes]:
    """Frames out of a text.

    Parameters
    ----------
    blocks : the text, cut anywhere; its last line ends.
    read_usual, read_other : read lines.
    on_broken : called for each line that should be a frame and is not.
    """
    count = number = begin = 0
    text = b""
    for block in blocks:
        text, begin = text[begin:] + block, 0
        start = ffi.from_buffer("char[]", text)
        while begin < len(text):
            frames, used = read_usual(start + begin, len(text) - begin)
            got = len(frames) // FRAME_SIZE
            count, number, begin = count + got, number + got, begin + used
            yield frames
            end = text.find(b"\n", begin)
            if end < 0:
                break
            line, number, begin = text[begin:end].decode("utf-8", "replace").strip(), number + 1, end + 1
            other = read_other(line)
            if other is None:
                on_broken(count, f"line {number} is no frame: {line[:40]}")
            else:
                count += len(other) // FRAME_SIZE
                yield other
        if len(text) - begin > _LINE_MAX:
            on_broken(count, f"line {number + 1} does not end")
            begin = len(text)
