"""Results of a campaign on disk: a line of JSON for each run, appended as they come, so that nothing done is lost."""

from __future__ import annotations

import fcntl
import json
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

from bridge.campaign.file import Campaign
from dbc.errors import ConfigurationError, RaceloopError

RESULTS = "results.jsonl"


class ResultFile:
    """The results so far, and where more go.

    Parameters
    ----------
    path : of the file.
    file : open for appending.
    by_id : results that were there.
    """

    def __init__(self, path: Path, file: IO[bytes], by_id: dict[str, dict[str, Any]]) -> None:
        self.path = path
        self.by_id = by_id
        self._file = file

    @classmethod
    def opened(cls, folder: Path, campaign: Campaign, restart: bool) -> Self:
        """Open the results in a folder, and go on with what is there.

        A line that was torn when somebody died is dropped.

        Parameters
        ----------
        restart : forget what is there.

        Raises
        ------
        RaceloopError
            When they are of something else, or cannot be read or written, or somebody else is at it.
        """
        path = folder / RESULTS
        head = {"campaign": campaign.name, "runs": campaign.count, "fingerprint": campaign.fingerprint()}
        try:
            file = path.open("ab+")
        except OSError as error:
            raise RaceloopError(f"{path}: cannot be written: {error.strerror}") from error
        try:
            return cls(path, file, _kept(path, file, head, restart))
        except BaseException:
            file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._file.close()

    def add(self, result: dict[str, Any]) -> None:
        """Keep a result, on disk too."""
        self.by_id[result["id"]] = result
        self._append(result)

    def _append(self, content: dict[str, Any]) -> None:
        try:
            _write(self._file, content)
        except OSError as error:
            raise RaceloopError(f"{self.path}: cannot be written: {error.strerror}") from error


def _kept(path: Path, file: IO[bytes], head: dict[str, Any], restart: bool) -> dict[str, dict[str, Any]]:
    """What the file holds of the runs of a campaign, whose head it gets when it is empty."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if restart:
            file.truncate(0)
        file.seek(0)
        content = file.read()
        whole = content[: content.rfind(b"\n") + 1]
        file.truncate(len(whole))
        if not whole:
            _write(file, head)
            return {}
    except BlockingIOError as error:
        raise RaceloopError(f"{path}: another campaign is writing it") from error
    except OSError as error:
        raise RaceloopError(f"{path}: cannot be written: {error.strerror}") from error
    lines = [_parsed(path, number, line) for number, line in enumerate(whole.splitlines(), 1)]
    if lines[0] != head:
        what = "files or a build that have changed since"
        if lines[0].get("campaign") != head["campaign"]:
            what = "another campaign"
        raise ConfigurationError(path, "line 1", f"the results are of {what}; --restart begins anew")
    return {line["id"]: line for line in lines[1:]}


def _write(file: IO[bytes], content: dict[str, Any]) -> None:
    file.write(line(content))
    file.flush()


def line(content: dict[str, Any]) -> bytes:
    """A result as it is in the file."""
    return json.dumps(content, sort_keys=True, allow_nan=False).encode() + b"\n"


def _parsed(path: Path, number: int, text: bytes) -> dict[str, Any]:
    try:
        content = json.loads(text)
    except ValueError:
        content = None
    if not isinstance(content, dict) or (number > 1 and "id" not in content):
        raise ConfigurationError(path, f"line {number}", "is no result; --restart begins anew")
    return content
