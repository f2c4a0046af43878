"""Episodes to be tried, and how they went."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowlab.config import Settings
from flowlab.errors import DataError, UsageError
from flowlab.files import write_atomically

SCENES_PER_SEED = 1_000_000
"""Seed s is evaluated on the layouts from ``(s + 1) * SCENES_PER_SEED`` on; demonstrations are numbered from 0."""
MOST_SEEDS = 4000
"""Beyond, layouts would have no numbers left: MetaWorld's generator takes 32 bits."""


@dataclass(frozen=True, slots=True, order=True)
class Trial:
    """One episode to be tried: the ``episode``-th of an evaluation seed, the same for every policy."""

    task: str
    seed: int
    episode: int

    @property
    def scene_seed(self) -> int:
        """Seed of the scene's layout, and of the policy's noise."""
        return (self.seed + 1) * SCENES_PER_SEED + self.episode


class RolloutFlowError(Settings):
    """Predicted flow against where the query points really went while the actions were executed.

    Of an episode, over its plans; a point is where it truly was when the plan was made. ``zero`` predicts that nothing
    moves. Points move if they get farther than ``MOVING_M`` while the plan is executed.
    """

    pairs: int
    """Moving points times steps."""
    ade_mm: float
    """Mean distance over these."""
    zero_ade_mm: float
    ends: int
    """Moving points, each counted once a plan."""
    fde_mm: float
    """Mean distance at the last executed step."""
    zero_fde_mm: float
    apd: float
    """TAPVid-3D's share within its limits, of the moving points; all count as visible."""
    zero_apd: float
    average_jaccard: float
    """TAPVid-3D's, likewise."""
    zero_average_jaccard: float
    still_pairs: int
    """Points that do not move, times steps."""
    still_mm: float
    """Mean distance over these."""


class EpisodeResult(Settings):
    """How one trial went: a line of ``episodes.jsonl``."""

    task: str
    seed: int
    episode: int
    scene_seed: int
    success: bool
    """Whether the task counted as solved after any step."""
    success_dp3: bool
    """Whether it did after one of the last two steps of some plan: all that DP3's runner looks at."""
    steps: int
    """Until it first did, or all."""
    note: str = ""
    """Why the episode ended early, if something broke down; it counts as failed."""
    flow: RolloutFlowError | None = None
    """None for policies that predict none, and where nothing moved."""

    @property
    def trial(self) -> Trial:
        """What was tried."""
        return Trial(self.task, self.seed, self.episode)


def trials(tasks: Sequence[str], seeds: Sequence[int], episodes: int) -> list[Trial]:
    """Every episode of an evaluation, task by task."""
    if bad := [s for s in seeds if not 0 <= s < MOST_SEEDS]:
        raise UsageError(f"seed {bad[0]}: evaluation seeds are from 0 to {MOST_SEEDS - 1}")
    if not 0 < episodes <= SCENES_PER_SEED:
        raise UsageError(f"{episodes} episodes: a seed has from 1 to {SCENES_PER_SEED:,}")
    return [Trial(task, seed, k) for task in tasks for seed in dict.fromkeys(seeds) for k in range(episodes)]


def check_unseen(wanted: Iterable[Trial], trained_on: Mapping[str, Sequence[int]], where: Path) -> None:
    """Refuse to evaluate on a layout that the policy's dataset holds."""
    for trial in wanted:
        if trial.scene_seed in trained_on.get(trial.task, ()):
            raise UsageError(
                f"{where}: its dataset holds the layout {trial.scene_seed} of {trial.task}, which evaluation seed "
                f"{trial.seed} would try; demonstrations belong below {SCENES_PER_SEED:,}: make them with another "
                "first_seed, or evaluate other --seeds"
            )


def append(path: Path, outcome: EpisodeResult) -> None:
    """Add an outcome to a file, in one write, so that processes may share it."""
    line = outcome.model_dump_json(exclude_defaults=True) + "\n"
    with path.open("ab", buffering=0) as file:
        file.write(line.encode())


def read(path: Path) -> dict[Trial, EpisodeResult]:
    """The outcomes in a file. A last line that a kill cut off is left out; later lines count."""
    return {outcome.trial: outcome for outcome in _lines(path)}


def repair_tail(path: Path) -> None:
    """Take off a last line that a kill cut off, so that others can be added."""
    text = path.read_bytes() if path.exists() else b""
    if text and not text.endswith(b"\n"):
        write_atomically(path, text[: text.rfind(b"\n") + 1].decode())


def _lines(path: Path) -> Iterator[EpisodeResult]:
    *whole, _ = (path.read_bytes() if path.exists() else b"").split(b"\n")
    for number, line in enumerate(whole, 1):
        try:
            values: Any = json.loads(line)
            yield EpisodeResult.model_validate(values)
        except ValueError as error:  # pydantic's too
            raise DataError(
                f"{path}: line {number} is damaged (expected how an episode went, found "
                f"{line[:60].decode(errors='replace')!r}); delete the line, and the episode is tried again"
            ) from error
