"""``episodes.jsonl``: a line for every episode as it ends, so that an evaluation goes on where it was ended."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from flowlab.errors import DataError
from flowlab.evaluation.migrations import migrate_episode
from flowlab.evaluation.results import EpisodeResult
from flowlab.evaluation.trials import Trial
from flowlab.files import write_atomically

EPISODES = "episodes.jsonl"


def append_result(path: Path, result: EpisodeResult) -> None:
    """Add a line to a file, in one write, so that processes may share it."""
    line = result.model_dump_json(exclude_defaults=True) + "\n"
    with path.open("ab", buffering=0) as file:
        file.write(line.encode())


def read_results(path: Path) -> dict[Trial, EpisodeResult]:
    """How the episodes of a file went; none where there is no file.

    A last line that a kill cut off is left out; of two lines on one trial the later counts.

    Raises:
        DataError: A line is damaged.
    """
    return {result.trial: result for result in _whole_lines(path)}


def repair_tail(path: Path) -> None:
    """Take off a last line that a kill cut off, so that others can be added."""
    text = path.read_bytes() if path.exists() else b""
    if text and not text.endswith(b"\n"):
        write_atomically(path, text[: text.rfind(b"\n") + 1].decode())


def _whole_lines(path: Path) -> Iterator[EpisodeResult]:
    """The result of every line but one that a kill cut off."""
    *whole, _ = (path.read_bytes() if path.exists() else b"").split(b"\n")
    for number, line in enumerate(whole, 1):
        try:
            values: Any = json.loads(line)
            yield EpisodeResult.model_validate(migrate_episode(values))
        except ValueError as error:  # pydantic's too
            raise DataError(
                f"{path}: line {number} is damaged (expected how an episode went, found "
                f"{line[:60].decode(errors='replace')!r}); delete the line, and the episode is tried again"
            ) from error
