"""What can be trained on: a flowlab dataset, or a store in DP3's layout."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowlab.errors import DataError
from flowlab.provenance import Provenance
from flowlab.records import Episode
from flowlab.storage import stats
from flowlab.storage.dataset import Dataset
from flowlab.storage.importers.dp3 import DP3Store


@dataclass(frozen=True, slots=True)
class TrainingSource:
    """Demonstrations on disk, and what is known of where they come from."""

    path: Path
    fingerprint: str
    frames: int
    episodes: Callable[[], Iterator[Episode]]
    statistics: Mapping[str, Any]
    """As :func:`flowlab.storage.stats.describe` gives them."""
    provenance: Provenance


def open_training_source(path: Path) -> TrainingSource:
    """Open a dataset, or a store in DP3's layout.

    Raises:
        DataError: The folder is neither, or holds no episodes.
    """
    if DP3Store.looks_like(path):
        store = DP3Store(path)
        described = stats.describe(stats.summarize(store.episodes()))
        imported = Provenance(kind="imported")
        return TrainingSource(path, store.fingerprint, sum(store.frames), store.episodes, described, imported)
    return source_of(Dataset(path))


def source_of(dataset: Dataset) -> TrainingSource:
    """A dataset, to be trained on.

    Raises:
        DataError: It holds no episodes.
    """
    if not len(dataset):
        raise DataError(
            f"{dataset.path}: there are no episodes to train on yet; run the command that makes the dataset again"
        )
    frames = sum(ref.frames for ref in dataset.refs)
    return TrainingSource(
        dataset.path, dataset.fingerprint, frames, dataset.episodes, dataset.stats, dataset.manifest.provenance
    )
