"""``episodes.jsonl``: a line for every episode as it ends, so that an evaluation goes on where it was ended."""

from pathlib import Path

from pydantic import ValidationError

from flowlab.config import explain
from flowlab.errors import DataError
from flowlab.evaluation.migrations import migrate_episode
from flowlab.evaluation.results import EpisodeResult
from flowlab.evaluation.trials import Trial
from flowlab.json_lines import append_line, read_lines

EPISODES = "episodes.jsonl"
_ADVICE = "delete the line, and the episode is tried again"
_UNWRITABLE = "what was kept before is whole; make room, then give the same command again"


def append_result(path: Path, result: EpisodeResult) -> None:
    """Add a line to a file that processes may share. Raises :class:`DataError` where it cannot be written."""
    append_line(path, result.model_dump(mode="json", exclude_defaults=True), _UNWRITABLE)


def read_results(path: Path) -> dict[Trial, EpisodeResult]:
    """How the episodes of a file went; none where there is no file.

    A last line that a kill cut off is left out; of two lines on one trial the later counts.

    Raises:
        DataError: A line is damaged.
    """
    found = {}
    for number, values in read_lines(path, "how an episode went", _ADVICE):
        try:
            result = EpisodeResult.model_validate(migrate_episode(values))
        except ValidationError as error:
            raise DataError(f"{path}: line {number} is damaged ({explain(error, EpisodeResult)}); {_ADVICE}") from error
        found[result.trial] = result
    return found
