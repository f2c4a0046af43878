"""Whether several datasets say the same of themselves, so that they can be one."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np

from flowlab.errors import DataError
from flowlab.provenance import Provenance
from flowlab.storage.dataset import Dataset
from flowlab.storage.manifest import differences
from flowlab.storage.shard import Shard
from flowlab.text import counted, cut

ALIKE = ("kind", "world_frame", "camera", "state", "action", "action_limits", "observer", "queries")
"""What datasets must say alike of themselves to be trained on together."""
_TRAINING = "trained on together with"
_SHOWN = 300
"""Letters of the first difference."""
_TIMED = 8
"""So many episodes tell how far apart in time the rows of a dataset are."""
_RATES_DIFFER = 1.05
"""Clocks of cameras differ by less; what is farther apart was recorded at another rate."""


def check_alike(datasets: Sequence[Dataset], doing: str = _TRAINING, said: Sequence[str] = ALIKE) -> None:
    """Refuse datasets of which one is given twice, or that differ in what must be alike.

    Args:
        datasets: Those that are to be one; each holds episodes.
        doing: What is to be done with them, in words: ``trained on together with``.
        said: The fields of their provenance that must be the same.

    Raises:
        DataError: They do not fit each other; says in what, with both values.
    """
    first = datasets[0]
    for other in datasets[1:]:
        if other.path.resolve() in {d.path.resolve() for d in datasets if d is not other}:
            raise DataError(f"{other.path}: is given twice; leave one out")
        old, new = ({k: d.provenance.model_dump(mode="json")[k] for k in said} for d in (first, other))
        lines = [*differences(old, new, owners=(str(first.path), str(other.path)))]
        assert first.row_format is not None
        assert other.row_format is not None
        if problem := first.row_format.problem(other.row_format) or (cut(lines[0], _SHOWN) if lines else ""):
            raise DataError(f"{other.path}: cannot be {doing} {first.path}: {problem}")


def check_trained_together(datasets: Sequence[Dataset]) -> None:
    """The same of datasets that one policy is to learn from: they must also have one rate, and share no episode.

    Raises:
        DataError: They do not fit each other; says in what, with both values.
    """
    check_alike(datasets)
    check_rates(datasets)
    for k, other in enumerate(datasets[1:], 1):
        mine = {ref.digest for ref in other.refs}
        for first in datasets[:k]:
            if shared := sum(ref.digest in mine for ref in first.refs):
                raise DataError(
                    f"{other.path}: {shared} of its {counted(len(other), 'episode')} are in {first.path}, too, and "
                    f"would count twice; 'flowlab merge {first.path} {other.path} --out OUT' keeps each once"
                )


def known_scenes(dataset: Dataset) -> Mapping[tuple[str, int], str]:
    """What the scenes of episodes are known by in other datasets, by task and seed: the seed of a simulated one, the
    content of a recording. What is not known is left out."""
    if dataset.provenance.is_simulated:
        return {(ref.task, ref.seed): str(ref.seed) for ref in dataset.refs}
    content = {(r.task, r.seed): r.content for r in dataset.manifest.recordings if r.content}
    return {key: content[key] for ref in dataset.refs if (key := (ref.task, ref.seed)) in content}


def check_rates(datasets: Sequence[Dataset], doing: str = _TRAINING) -> None:
    """Refuse datasets of other rates: a step of an action, and of flow, takes another time in each.

    Raises:
        DataError: Any two differ by more than clocks do.
    """
    timed = [(d, period) for d in datasets if (period := _row_period_s(d)) is not None]
    for (first, expected), (other, period) in combinations(timed, 2):
        if not 1 / _RATES_DIFFER < period / expected < _RATES_DIFFER:
            raise DataError(
                f"{other.path}: cannot be {doing} {first.path}: time: a step takes {period:.4g} s in "
                f"{other.path}, and {expected:.4g} s in {first.path}; make the quicker one again of fewer frames "
                "(track-real --set recording.every=3), or take one of them alone"
            )


def unsaid_meaning(about: Provenance, paths: Sequence[Path]) -> str:
    """That datasets which say alike that they are ``about`` may have nothing in common but how many numbers their rows
    have; empty where they say what these mean."""
    unsaid = " and ".join(name for name in ("state", "action") if getattr(about, name) is None)
    if not unsaid:
        return ""
    return (
        f"{paths[0]}: does not say what the numbers of its {unsaid} mean, nor does {', '.join(map(str, paths[1:]))}; "
        "they are taken to mean the same, since there are as many"
    )


def _row_period_s(dataset: Dataset) -> float | None:
    """How far apart in time the rows are, in the median of some episodes; None where no episode has two."""
    steps = np.concatenate([np.empty(0), *_steps_s(dataset)])
    return float(np.median(steps)) if len(steps) and np.median(steps) > 0 else None


def _steps_s(dataset: Dataset) -> Iterator[np.ndarray]:
    for ref in dataset.refs[:: -(-len(dataset) // _TIMED)]:
        shard = Shard(dataset.path / ref.shard)
        yield np.diff(shard.array("data/time", shard.rows()[ref.position]))
