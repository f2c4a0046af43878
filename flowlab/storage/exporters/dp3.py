"""The zarr v2 store that 3D Diffusion Policy trains on."""

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import zarr
from numcodecs import Blosc

from flowlab.errors import DataError
from flowlab.files import new_folder
from flowlab.storage.dataset import Dataset
from flowlab.storage.exporters.base import Exporter, select_episodes
from flowlab.storage.trainable import missing_actions

_ARRAYS = ("state", "action", "point_cloud")
_ROWS_TO_A_CHUNK = 100


class DP3Exporter(Exporter):
    """Writes the store that DP3's own loader reads.

    ``data/{state, action, point_cloud}`` float32 over all steps and ``meta/episode_ends`` int64, in chunks
    of 100 steps with Blosc zstd, as DP3's demonstration script writes them. The color channels DP3 stores
    behind xyz are absent: its policy drops them.
    """

    name: ClassVar[str] = "dp3"
    writes: ClassVar[str] = "the zarr v2 store that 3D-Diffusion-Policy's MetaworldDataset loads"

    def export(self, dataset: Dataset, path: Path, task: str | None = None) -> int:
        """Write the store; see :class:`~flowlab.storage.exporters.base.Exporter`."""
        chosen = select_episodes(dataset, path, task)
        if problem := missing_actions(dataset):
            raise DataError(f"{dataset.path}: {problem}")
        ends = np.cumsum([ref.frames for ref in chosen], dtype=np.int64)
        start = {(ref.task, ref.seed): int(end) - ref.frames for ref, end in zip(chosen, ends, strict=True)}
        with new_folder(path) as temporary:
            group = zarr.create_group(temporary, zarr_format=2)
            _write_steps(group, dataset, start, int(ends[-1]))
            _create(group, "meta/episode_ends", ends.shape, "int64")[...] = ends
        return len(chosen)


def _write_steps(group: zarr.Group, dataset: Dataset, start: dict[tuple[str, int], int], rows: int) -> None:
    """Every chosen episode at its rows, whatever the order in which shards hold them."""
    for episode in dataset.episodes():
        row = start.get((episode.task, episode.seed))
        if row is None:
            continue
        for name in _ARRAYS:
            values, key = getattr(episode, name), f"data/{name}"
            if key not in group:
                _create(group, key, (rows, *values.shape[1:]), "float32")
            array = group[key]
            assert isinstance(array, zarr.Array)
            array[row : row + len(episode)] = values


def _create(group: zarr.Group, key: str, shape: tuple[int, ...], dtype: str) -> "zarr.Array[Any]":
    """An array as DP3's script makes it."""
    compressor = Blosc(cname="zstd", clevel=3, shuffle=Blosc.SHUFFLE)
    chunks = (min(_ROWS_TO_A_CHUNK, shape[0]), *shape[1:])
    return group.create_array(key, shape=shape, chunks=chunks, dtype=dtype, compressors=compressor)
