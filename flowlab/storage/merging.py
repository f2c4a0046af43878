"""Several datasets made one."""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from flowlab.arguments import check_path
from flowlab.errors import DataError, UsageError
from flowlab.provenance import Provenance
from flowlab.storage.compatibility import check_alike, check_rates, unsaid_meaning
from flowlab.storage.dataset import Dataset
from flowlab.storage.derived import Part, manifest_of
from flowlab.storage.receipts import check_row_formats
from flowlab.storage.transfer import check_out, choose, write_datasets
from flowlab.text import cut

_LOG = logging.getLogger(__name__)
_MAY_DIFFER = ("license", "hub")
"""What datasets may say differently of themselves; it stands in the settings of the merged one."""
_MOST = 2**62
"""Numbers are stored in 64 bits."""


def merge(datasets: Iterable[Dataset | Path | str], out: Path | str) -> Dataset:
    """Make one dataset of several, as ``flowlab merge`` does.

    Shards go over as they are, byte for byte, unless their episodes need other numbers. Recordings whose numbers are
    taken get the next free ones; an episode that is there already is kept once; both is said as a warning.

    Args:
        datasets: Two or more; all that they say of where their episodes come from, and of what the numbers mean, is
            the same.
        out: Folder of the new dataset, which is not there yet.

    Returns:
        The new dataset.

    Raises:
        UsageError: There are fewer than two, or ``out`` is one of them.
        DataError: They do not fit each other, one is damaged, or something is at ``out`` already.
    """
    place = check_path(out, "out")
    if isinstance(datasets, str | Path | Dataset) or not isinstance(datasets, Iterable):
        raise UsageError(f"datasets: must be a list of datasets or paths; found {cut(repr(datasets))}")
    sources = [d if isinstance(d, Dataset) else Dataset(check_path(d, "datasets")) for d in datasets]
    if len(sources) < 2:
        raise UsageError(f"datasets: there are {len(sources)}, and merging takes at least two")
    check_out(place, sources)
    for source in sources:
        if not len(source):
            raise DataError(f"{source.path}: holds no episodes; leave it out")
        check_row_formats(source.path, source.receipts)
        if source.reservation:
            _LOG.warning("flowlab: %s", source.reservation)
    check_alike(sources, "merged with", tuple(name for name in Provenance.model_fields if name not in _MAY_DIFFER))
    check_rates(sources, "merged with")
    if unsaid := unsaid_meaning(sources[0].provenance, [s.path for s in sources]):
        _LOG.warning("flowlab: %s", unsaid)
    parts, about = _joined(sources)
    manifest = manifest_of(sources[0].manifest, parts, "merge", {"of": about})
    manifest = manifest.model_copy(
        update={"provenance": manifest.provenance.model_copy(update={"hub": "", "license": _license(sources)})}
    )
    return write_datasets({place: (manifest, parts)})[0]


def _license(sources: Sequence[Dataset]) -> str:
    """The license of all; of several it is nobody's to say but the user's."""
    found = {s.provenance.license: s.path for s in sources}
    if len(found) > 1:
        told = ", ".join(f"{path}: {name or 'not stated'}" for name, path in found.items())
        _LOG.warning("flowlab: licenses differ (%s); the merged dataset has none stated", told)
    return "" if len(found) > 1 else next(iter(found))


class _Taken:
    """What of the datasets so far goes over, and under which numbers."""

    def __init__(self) -> None:
        self._owners: dict[tuple[str, int], Path] = {}
        self._tried: set[tuple[str, int]] = set()
        self._numbers: set[int] = set()
        self._digests: set[str] = set()
        self._recordings: set[tuple[str, str]] = set()

    def add(self, source: Dataset, parts: Sequence[Part]) -> None:
        """Take what goes over of a dataset."""
        content = _contents(source)
        for part in parts:
            task = part.receipt.task
            accepted = [part.receipt.accepted[k] for k in part.positions]
            self._owners |= {(task, seed + part.shift): source.path for seed in accepted}
            self._tried |= {(task, seed) for seed in part.seeds}
            self._numbers |= {*part.seeds}
            self._digests |= {part.receipt.digests[k] for k in part.positions}
            self._recordings |= {content[task, seed] for seed in accepted if (task, seed) in content}

    def fresh(self, source: Dataset) -> list[Part]:
        """What of a dataset is not there yet."""
        twins = {key for key, recording in _contents(source).items() if recording in self._recordings}
        refs = [r for r in source.refs if (r.task, r.seed) not in twins and r.digest not in self._digests]
        if source.provenance.is_simulated:  # a seed that was rejected is so again
            twins |= self._tried
        parts = []
        for part in choose(source, refs, {r.task for r in source.receipts}):
            rejects = tuple(x for x in part.rejects if (x.task, x.seed) not in twins)
            if part.positions or rejects:
                parts.append(replace(part, rejects=rejects))
        return parts

    def shift(self, source: Dataset, parts: Sequence[Part]) -> int:
        """What is to be added to the numbers of a dataset so that none is taken.

        Raises:
            DataError: A number is taken and cannot change, since it decides a simulated scene.
        """
        if not source.provenance.is_simulated:
            taken = any(self._is_taken(source, p.receipt.task, s) for p in parts for s in p.seeds)
            shift = max(self._numbers) + 1 if taken else 0
            if shift + max((s for p in parts for s in p.seeds), default=0) > _MOST:
                raise DataError(f"{source.path}: its numbers would pass {_MOST:,}; make the datasets again, from 0")
            return shift
        keys = ((p.receipt.task, p.receipt.accepted[k]) for p in parts for k in p.positions)
        if task_seed := next((key for key in keys if key in self._owners), None):
            task, seed = task_seed
            raise DataError(
                f"{source.path}: {task} seed {seed} is another episode than in {self._owners[task_seed]}, and a "
                "simulated episode keeps its seed, which decides its scene; leave it out with 'flowlab subset', or "
                "make it with another --first-seed"
            )
        return 0

    def _is_taken(self, source: Dataset, task: str, seed: int) -> bool:
        """Recordings are numbered through all tasks."""
        return seed in self._numbers if source.manifest.recordings else (task, seed) in self._tried


def _contents(source: Dataset) -> dict[tuple[str, int], tuple[str, str]]:
    """What recordings are known by, each for its task, where that is known."""
    return {(r.task, r.seed): (r.task, r.content) for r in source.manifest.recordings if r.content}


def _joined(sources: Sequence[Dataset]) -> tuple[list[Part], list[dict[str, Any]]]:
    """What of all datasets goes over, and what is told about each."""
    taken, joined, about = _Taken(), list[Part](), list[dict[str, Any]]()
    for source in sources:
        parts = taken.fresh(source)
        shift = taken.shift(source, parts)
        parts = [replace(p, shift=shift) for p in parts]
        episodes = sum(len(p.positions) for p in parts)
        if episodes < len(source):
            _LOG.warning(
                "flowlab: %s: %d of its %d episodes are in the datasets before it, too; they are kept once",
                source.path, len(source) - episodes, len(source),
            )  # fmt: skip
        if shift:
            _LOG.warning(
                "flowlab: %s: its numbers are taken; %d is added to each, so that 0 becomes %d",
                source.path, shift, shift,
            )  # fmt: skip
        told = {"dataset": str(source.path), "fingerprint": source.fingerprint, "episodes": episodes}
        told |= {"added_to_numbers": shift} if shift else {}
        told |= {name: value for name in _MAY_DIFFER if (value := getattr(source.provenance, name))}
        if source.manifest.settings_digest != sources[0].manifest.settings_digest:
            told["settings"] = source.manifest.model_dump(mode="json")["settings"]
            _LOG.warning(
                "flowlab: %s: made with other settings than %s; the merged dataset says so in flowlab.json, under "
                "settings.merge", source.path, sources[0].path,
            )  # fmt: skip
        about.append(told)
        taken.add(source, parts)
        joined += parts
    return joined, about
