"""What readers of logs share: how much they give at once, and how they tell what they cannot read."""

from __future__ import annotations

from collections.abc import Callable

#: Frames in one piece.
CHUNK = 1 << 16

OnBroken = Callable[[int, str], None]
"""Takes the number of frames before, and what cannot be read there."""
