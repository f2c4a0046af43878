"""Pictures for windows: read from a dataset's shards as they are asked for, or decoded once, where that is quicker."""

from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from flowlab.data.cache import cached_part
from flowlab.data.replay_buffer import pictures_of
from flowlab.data.source import TrainingSource
from flowlab.errors import DataError, UsageError
from flowlab.limits import MAX_LOADED_BYTES
from flowlab.provenance import Provenance
from flowlab.storage.dataset import Dataset
from flowlab.storage.pictures import StoredPictures, kinds_of_pictures
from flowlab.storage.shard import PICTURES_PER_CHUNK_BYTES

PICTURES = ("rgb", "depth")
Where = Literal["stored", "decoded"]
_QUICK_BYTES = PICTURES_PER_CHUNK_BYTES
"""So much may be decoded for one picture, for it to be read from the shards."""
_NAMES = {"rgb": "color pictures", "depth": "depth pictures"}
_HOW = {
    ("simulated", "rgb"): "'flowlab extract-sim --set expert.scene.rgb=true --set expert.scene.renderer=gl' makes some",
    ("simulated", "depth"): "'flowlab extract-sim --set write.depth=true' keeps them",
    ("recorded", "rgb"): "'flowlab track-real --set write.rgb=true', as is the default, keeps those of the recordings",
    ("recorded", "depth"): "'flowlab track-real --set write.depth=true' keeps those of the recordings",
}


class WindowPictures:
    """Where the pictures lie that windows are made of.

    Args:
        source: What is read.
        dataset: The same, opened; None where it is no dataset of flowlab.
        asked: Names of what is wanted of it; others than of pictures do not matter.
        where: From where pictures are read; None leaves it to how much has to be decoded for one.
        fallback: Folder for decoded pictures where the user's cache folder cannot be written.

    Raises:
        UsageError: There is no such place.
        DataError: There are no such pictures, or not of all episodes.
    """

    def __init__(
        self,
        source: TrainingSource,
        dataset: Dataset | None,
        asked: Iterable[str],
        where: Where | None,
        fallback: Path | None,
    ) -> None:
        if where not in (None, "stored", "decoded"):
            raise UsageError(f"Windows: pictures must be 'stored', 'decoded' or None; found {where!r}")
        self.kinds = () if dataset is None else kinds_of_pictures(dataset)
        """Those that there are, asked for or not."""
        self.stored: dict[str, StoredPictures] = {}
        self.folders: list[Path] = []
        """Of decoded ones, for :func:`~flowlab.data.cache.open_part`."""
        for name in (name for name in PICTURES if name in {*asked}):
            if dataset is None or name not in self.kinds:
                raise DataError(_missing(source.path, source.provenance, name))
            found = StoredPictures(dataset, name)
            if where == "stored" and found.chunk_bytes > MAX_LOADED_BYTES:
                raise DataError(
                    f"{source.path}: '{name}' lies together in chunks of {found.chunk_bytes:,} bytes, of which at most "
                    f"{MAX_LOADED_BYTES:,} are read for one picture; give pictures='decoded'"
                )
            if where == "stored" or (where is None and found.is_quick(_QUICK_BYTES)):
                self.stored[name] = found
            else:
                self.folders.append(cached_part(source, fallback, name, partial(pictures_of, name=name)))

    def rows(self, name: str, episode: int, steps: np.ndarray) -> np.ndarray:
        """The stored pictures of some steps of an episode, which is named by its position in the dataset."""
        pictures = self.stored[name]
        return pictures[pictures.starts[episode] + steps]


def _missing(path: Path, about: Provenance, name: str) -> str:
    """That there are no such pictures, and how to get some."""
    how = _HOW.get((about.kind, name), "they are not among what it was made from")
    if about.inferred is not None:
        how = f"those of the films ({about.inferred.films}) would be here; {how}"
    return f"{path}: holds no {_NAMES[name]}, so there is no '{name}' in its windows; {how}"
