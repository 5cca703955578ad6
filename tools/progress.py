"""Progress of a run on a terminal: time against the scenario's limit, and what the car is doing."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn


class ProgressBar:
    """A context manager; shows nothing where there is no terminal, and is gone afterwards.

    Parameters
    ----------
    console : to show it on.
    name : of what runs.
    limit : time, us, or count at which the bar is full.
    """

    def __init__(self, console: Console, name: str, limit: int) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TextColumn("{task.fields[state]}"),
            TimeElapsedColumn(),
        )
        self._progress = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._task = self._progress.add_task(name, total=limit, state="")

    def __enter__(self) -> ProgressBar:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._progress.stop()

    def update(self, time_us: int, state: str) -> None:
        """Show time and state of the run."""
        self.show(time_us, f"{time_us * 1e-6:6.1f} s  {state}")

    def show(self, completed: int, state: str) -> None:
        """Show how much is done, in the unit of the limit, and a text."""
        self._progress.update(self._task, completed=completed, state=state)
