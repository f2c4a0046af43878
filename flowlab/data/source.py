"""What can be trained on: a flowlab dataset, or a store in DP3's layout."""

import hashlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

from flowlab.arguments import check_path
from flowlab.errors import DataError, UsageError
from flowlab.provenance import Provenance
from flowlab.records import Episode
from flowlab.storage.compatibility import check_alike, check_trained_together, known_scenes, unsaid_meaning
from flowlab.storage.dataset import Dataset
from flowlab.storage.episodes import DatasetView
from flowlab.storage.importers.dp3 import DP3Store
from flowlab.storage.trainable import training_problems

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class SourcePart:
    """One of the datasets that are trained on together."""

    path: Path
    fingerprint: str
    frames: int
    """Its episodes have so many rows."""
    scenes: Mapping[tuple[str, int], str]
    """What the scenes of its episodes are known by in the other datasets, by task and seed, as far as that is known."""
    hub: str
    """Where on the Hub it was pulled from, ``user/name@commit``; empty where it was not."""


@dataclass(frozen=True, slots=True)
class TrainingSource:
    """Demonstrations on disk, and what is known of where they come from."""

    path: Path
    fingerprint: str
    frames: int
    episodes: Callable[[], Iterator[Episode]]
    """Reads them all; what is not as the fingerprint says is a :class:`DataError`."""
    provenance: Provenance
    cache_key: str
    """Identifies what is read, the names of tasks too."""
    parts: tuple[SourcePart, ...] = field(default=(), kw_only=True)
    """The datasets, if there are several; their episodes are read one dataset after the other."""

    @property
    def paths(self) -> tuple[Path, ...]:
        """Where all of it is."""
        return tuple(part.path for part in self.parts) or (self.path,)


def open_training_source(path: Path, *more: Path, known: bool = False) -> TrainingSource:
    """Open a dataset, or a store in DP3's layout; or several datasets, to be trained on together.

    Args:
        path: Where it is.
        more: Where the other datasets are.
        known: A run was trained on them, perhaps by an earlier flowlab, which did not ask for their rates, nor whether
            they share episodes.

    Raises:
        DataError: A folder is neither, or holds no episodes, or the datasets do not fit each other.
    """
    if more:
        return _joined([_dataset_at(p) for p in (path, *more)], check_alike if known else check_trained_together)
    if DP3Store.looks_like(path):
        store = DP3Store(path)
        named = hashlib.sha256(f"{store.fingerprint} {store.task}".encode()).hexdigest()[:16]  # after the folder
        imported = Provenance(kind="imported")
        return TrainingSource(path, store.fingerprint, sum(store.frames), store.episodes, imported, named)
    return source_of(Dataset(path))


def _dataset_at(path: Path) -> Dataset:
    """One of several datasets."""
    if DP3Store.looks_like(path):
        raise DataError(
            f"{path}: a store in DP3's layout does not tell its frame, its camera or what its numbers mean, and "
            "datasets that are trained on together must agree in these; train on it alone"
        )
    return Dataset(path)


def _joined(datasets: Sequence[Dataset], check: Callable[[Sequence[Dataset]], None]) -> TrainingSource:
    """Several datasets as one. Where episodes come from, and what their numbers mean, must be the same."""
    first, sources = datasets[0], [source_of(d) for d in datasets]
    check(datasets)
    content = hashlib.sha256(" ".join(s.fingerprint for s in sources).encode()).hexdigest()[:16]
    parts = tuple(
        SourcePart(d.path, s.fingerprint, s.frames, known_scenes(d), s.provenance.hub)
        for d, s in zip(datasets, sources, strict=True)
    )
    return TrainingSource(
        first.path,
        content,
        sum(s.frames for s in sources),
        lambda: chain.from_iterable(s.episodes() for s in sources),
        first.provenance,
        content,
        parts=parts,
    )


def warn_of_what_is_unsaid(source: TrainingSource) -> None:
    """Warn of several datasets that may be alike in nothing but how many numbers their rows have."""
    if source.parts and (unsaid := unsaid_meaning(source.provenance, source.paths)):
        _LOG.warning("flowlab: %s", unsaid)


def warn_of_shared_scenes(parts: Sequence[SourcePart]) -> None:
    """Warn of datasets that show one scene in different episodes: films of it, say, or labels of another tracker."""
    owners: dict[tuple[str, str], Path] = {}
    for part in parts:
        scenes = [(task, scene) for (task, _), scene in part.scenes.items()]
        if shared := [scene for scene in scenes if scene in owners]:
            _LOG.warning(
                "flowlab: %s: %d of its scenes are in %s, too, as other episodes; where one of these is held out, the "
                "other is not trained on", part.path, len(shared), owners[shared[0]],
            )  # fmt: skip
        owners |= dict.fromkeys(scenes, part.path)


def path_of(data: Dataset | Path | str) -> Path:
    """Where what is to be trained on lies, opened or not.

    Raises:
        UsageError: It is some episodes of a dataset, or no path at all.
    """
    if isinstance(data, DatasetView):
        raise UsageError(
            f"data: these are {len(data)} episodes of {data.path}, and what is trained on is a dataset of its own; "
            "make one with flowlab.subset(dataset, 'data/some', episodes='0:50'), or give flowlab.data.Windows the "
            "dataset and episodes=[...]"
        )
    return data.path if isinstance(data, Dataset) else check_path(data, "data")


def paths_of(data: "Dataset | Path | str | Sequence[Dataset | Path | str]") -> tuple[Path, ...]:
    """The same of one or several. Raises :class:`UsageError` where there are none."""
    if isinstance(data, list | tuple):
        if not data:
            raise UsageError("data: must be a dataset or a list of them, and the list is empty")
        return tuple(map(path_of, data))
    return (path_of(data),)  # type: ignore[arg-type] # no other sequence is one


def source_of(dataset: Dataset) -> TrainingSource:
    """A dataset, to be trained on.

    Raises:
        DataError: It holds no episodes.
    """
    if not len(dataset):
        raise DataError(
            f"{dataset.path}: there are no episodes to train on yet; run the command that makes the dataset again"
        )
    if problem := next(training_problems(dataset), ""):
        raise DataError(f"{dataset.path}: {problem}")
    if dataset.reservation:
        _LOG.warning("flowlab: %s", dataset.reservation)
    frames = sum(ref.frames for ref in dataset.refs)
    return TrainingSource(
        dataset.path,
        dataset.fingerprint,
        frames,
        dataset.episodes,
        dataset.provenance,
        dataset.fingerprint,
    )
