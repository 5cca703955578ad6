"""What every safety property says of itself."""

from __future__ import annotations

from abc import ABC
from typing import ClassVar


class Statement(ABC):
    """What must be true in every run.

    Attributes
    ----------
    id, text, source : what it is called, what it says, where its limits come from.
    """

    id: ClassVar[str]
    text: ClassVar[str]
    source: ClassVar[str]
