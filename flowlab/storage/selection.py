"""Datasets of some episodes of another one: a subset, or a split into training and validation."""

import hashlib
import logging
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from flowlab.arguments import check_count, check_counts, check_names, check_path, parse_numbers, position
from flowlab.errors import DataError, UsageError, unknown_name
from flowlab.storage.dataset import Dataset
from flowlab.storage.derived import manifest_of
from flowlab.storage.episodes import EpisodeRef
from flowlab.storage.receipts import check_row_formats
from flowlab.storage.transfer import check_out, choose, write_datasets
from flowlab.text import cut

_LOG = logging.getLogger(__name__)


def subset(
    dataset: Dataset | Path | str,
    out: Path | str,
    *,
    tasks: str | Iterable[str] | None = None,
    episodes: str | slice | int | Iterable[int] | None = None,
) -> Dataset:
    """Make a dataset of some episodes of another one, as ``flowlab subset`` does.

    Args:
        dataset: The dataset, which stays as it is.
        out: Folder of the new dataset, which is not there yet.
        tasks: Names of tasks; None for all.
        episodes: Positions among the episodes of these tasks, in order of task and seed, from 0: ``"0:50,70"``, as in
            a slice, so that the last is not in it and negative numbers count from the end; a slice; or numbers. None
            for all, and then what was kept out of these tasks goes over, too.

    Returns:
        The new dataset.

    Raises:
        UsageError: There is no such task or episode, nothing is chosen, or ``out`` is the dataset itself.
        DataError: The dataset is damaged, or something is at ``out`` already.
    """
    source, place = _opened(dataset), check_path(out, "out")
    names = None if tasks is None else check_names(tasks, "tasks")
    if names is None and episodes is None:
        raise UsageError(f"{source.path}: nothing is chosen from it; give tasks, or episodes as in 0:50")
    check_out(place, [source])
    known = {r.task for r in source.receipts if r.accepted or episodes is None}
    for name in names or ():
        if name not in known:
            raise unknown_name(f"task in {source.path}", name, known)
    chosen = [ref for ref in source.refs if names is None or ref.task in names]
    told: dict[str, object] = {"of": str(source.path), "fingerprint": source.fingerprint}
    if names is not None:
        told["tasks"] = sorted({*names})
    if episodes is not None:
        picked = _positions(episodes, len(chosen), "episodes")
        chosen, told["episodes"] = [chosen[k] for k in picked], _ranges(picked)
        _warn_of_rejects(source)
    if not chosen:
        raise UsageError(f"{source.path}: no episode is chosen; give other tasks or episodes")
    parts = choose(source, chosen, () if episodes is not None else known if names is None else {*names})
    return write_datasets({place: (manifest_of(source.manifest, parts, "subset", told), parts)})[0]


def split(
    dataset: Dataset | Path | str, out: Path | str | None = None, *, val: float = 0.1, seed: int = 0
) -> tuple[Dataset, Dataset]:
    """Make two datasets of one, to train on and to validate on, as ``flowlab split`` does.

    Of every task the same share is drawn at random, at least one episode; of a task that has a single one, none.

    Args:
        dataset: The dataset, which stays as it is.
        out: What the names of the new folders begin with; ``-train`` and ``-val`` are added. None for the dataset's.
        val: The share of episodes to validate on, between 0 and 1.
        seed: Of the draw; the same one draws the same episodes.

    Returns:
        The dataset to train on, and the one to validate on.

    Raises:
        UsageError: The share or the seed is none.
        DataError: No task has two episodes, the dataset is damaged, or something is there already.
    """
    source = _opened(dataset)
    if isinstance(val, bool) or not isinstance(val, int | float) or not 0 < val < 1:
        raise UsageError(f"val: must be a share between 0 and 1, as 0.1; found {cut(repr(val))}")
    check_count(seed, "seed", 0)
    base = source.path.resolve() if out is None else check_path(out, "out")
    places = [base.with_name(f"{base.name}-{part}") for part in ("train", "val")]
    for place in places:
        check_out(place, [source])
    held = [ref for task in source.tasks for ref in _drawn(source.task(task).refs, task, val, seed)]
    if not held:
        raise DataError(f"{source.path}: no task has two episodes, so that none can be left out to validate on")
    if alone := [task for task in source.tasks if len(source.task(task)) == 1]:
        _LOG.warning("flowlab: %s: has a single episode of %s; it is trained on", source.path, cut(", ".join(alone)))
    _warn_of_rejects(source)
    left_out = {(ref.task, ref.seed) for ref in held}
    chosen = [ref for ref in source.refs if (ref.task, ref.seed) not in left_out], held
    wanted = {}
    for place, refs, part in zip(places, chosen, ("train", "val"), strict=True):
        told = {"of": str(source.path), "fingerprint": source.fingerprint, "val": val, "seed": seed, "part": part}
        parts = choose(source, refs)
        wanted[place] = manifest_of(source.manifest, parts, "split", told), parts
    train, validation = write_datasets(wanted)
    return train, validation


def _opened(dataset: Dataset | Path | str) -> Dataset:
    source = dataset if isinstance(dataset, Dataset) else Dataset(check_path(dataset, "dataset"))
    if not len(source):
        raise DataError(f"{source.path}: holds no episodes; run the command that makes the dataset again")
    check_row_formats(source.path, source.receipts)
    if source.reservation:
        _LOG.warning("flowlab: %s", source.reservation)
    return source


def _warn_of_rejects(source: Dataset) -> None:
    if source.rejects:
        _LOG.warning("flowlab: %s: the %d that were kept out of it stay behind", source.path, len(source.rejects))


def _drawn(refs: Sequence[EpisodeRef], task: str, share: float, seed: int) -> list[EpisodeRef]:
    """The episodes of a task that are left out of training; which, depends on no other task."""
    count = min(max(math.floor(share * len(refs) + 0.5), 1), len(refs) - 1)
    named = int.from_bytes(hashlib.sha256(task.encode()).digest()[:8])
    order = np.random.default_rng([seed, named]).permutation(len(refs))
    return [refs[k] for k in sorted(order[:count].tolist())]


def _positions(episodes: str | slice | int | Iterable[int], count: int, name: str) -> list[int]:
    """Positions among ``count`` episodes, in order, each once. Raises :class:`UsageError` where one is not there."""
    if isinstance(episodes, str):
        found = parse_numbers(episodes, name, count)
    elif isinstance(episodes, slice):
        try:
            found = list(range(count))[episodes]
        except (TypeError, ValueError) as error:
            raise UsageError(f"{name}: {episodes} is no slice of numbers ({error})") from error
    else:
        found = [position(k, count, name) for k in check_counts(episodes, name, None)]
    return sorted({*found})


def _ranges(positions: Sequence[int]) -> str:
    """Positions in order as they are typed: ``0:50,70``."""
    ends = [k for k, p in enumerate(positions) if k + 1 == len(positions) or positions[k + 1] != p + 1]
    starts = [0, *(k + 1 for k in ends)]
    found = [(positions[a], positions[b]) for a, b in zip(starts, ends, strict=False)]
    return ",".join(f"{a}" if a == b else f"{a}:{b + 1}" for a, b in found)
