"""Datasets in the layout of other tools."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numcodecs import Blosc

from flowlab.errors import DataError
from flowlab.storage.dataset import Dataset


def export_dp3(dataset: Dataset, path: Path, task: str | None = None) -> int:
    """Write the zarr v2 store DP3's own loader reads; returns the number of episodes.

    ``data/{state, action, point_cloud}`` float32 over all steps and ``meta/episode_ends`` int64, in chunks
    of 100 steps with Blosc zstd, as DP3's demonstration script writes them. The color channels DP3 stores
    behind xyz are absent: its policy drops them.
    """
    if path.exists():
        raise DataError(f"{path}: exists already; remove it or choose another --out")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{path}: cannot be written ({error.strerror}); choose another --out") from error
    chosen = [ref for ref in dataset.refs if task in (None, ref.task)]
    if not chosen:
        raise DataError(f"{dataset.path}: no episodes of '{task}'; it has {', '.join(dataset.manifest.requested)}")
    ends = np.cumsum([ref.frames for ref in chosen], dtype=np.int64)
    temporary = path.with_name(f".tmp-{path.name}")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        group = zarr.create_group(temporary, zarr_format=2)
        position = {(ref.task, ref.seed): end - ref.frames for ref, end in zip(chosen, ends, strict=True)}
        for episode in dataset.episodes():
            start = position.get((episode.task, episode.seed))
            if start is None:
                continue
            for name in ("state", "action", "point_cloud"):
                values = getattr(episode, name)
                key = f"data/{name}"
                if key not in group:
                    _create(group, key, (int(ends[-1]), *values.shape[1:]), "float32")
                array = group[key]
                assert isinstance(array, zarr.Array)
                array[start : start + len(episode)] = values
        _create(group, "meta/episode_ends", ends.shape, "int64")[...] = ends
        temporary.rename(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return len(chosen)


def _create(group: zarr.Group, key: str, shape: tuple[int, ...], dtype: str) -> "zarr.Array[Any]":
    compressor = Blosc(cname="zstd", clevel=3, shuffle=Blosc.SHUFFLE)
    return group.create_array(
        key, shape=shape, chunks=(min(100, shape[0]), *shape[1:]), dtype=dtype, compressors=compressor
    )
