"""What can be trained on: a flowlab dataset, or a store in DP3's layout."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowlab.errors import DataError
from flowlab.records import Episode
from flowlab.storage import stats
from flowlab.storage.dataset import Dataset
from flowlab.storage.importers.dp3 import DP3Store


@dataclass(frozen=True, slots=True)
class TrainingSource:
    """Demonstrations on disk, and what is known of how they were made."""

    path: Path
    fingerprint: str
    frames: int
    episodes: Callable[[], Iterator[Episode]]
    statistics: Mapping[str, Any]
    """As :func:`flowlab.storage.stats.describe` gives them."""
    settings: Mapping[str, Any]
    """Of every stage, by stage name; empty where they are not known."""

    @property
    def observer(self) -> Mapping[str, Any] | None:
        """Settings of the Observer; None where they are not known."""
        return self.settings.get("observer")

    @property
    def queries(self) -> Mapping[str, Any]:
        """Settings of the query points."""
        return self.settings.get("queries", {})


def open_training_source(path: Path) -> TrainingSource:
    """Open a dataset, or a DP3-layout store.

    Raises :class:`DataError` where the folder is neither, or holds no episodes.
    """
    if DP3Store.looks_like(path):
        store = DP3Store(path)
        described = stats.describe(stats.summarize(store.episodes()))
        return TrainingSource(path, store.fingerprint, sum(store.frames), store.episodes, described, {})
    dataset = Dataset(path)
    if not len(dataset):
        raise DataError(f"{path}: there are no episodes to train on yet; run the command that makes the dataset again")
    frames = sum(ref.frames for ref in dataset.refs)
    return TrainingSource(path, dataset.fingerprint, frames, dataset.episodes, dataset.stats, dataset.manifest.settings)
