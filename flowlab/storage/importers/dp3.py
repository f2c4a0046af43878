"""Stores in the layout of DP3, read as demonstrations without tracks."""

import hashlib
import math
import os
from collections.abc import Iterator
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from jaxtyping import Float32, Int32

from flowlab.errors import DataError, first_line
from flowlab.geometry.camera import Camera
from flowlab.limits import MAX_LOADED_BYTES
from flowlab.records import Episode, Queries, Tracks3D
from flowlab.storage.importers.zarr_claims import ArrayClaim, check_attributes
from flowlab.text import cut

_DATA = {"data/state": 2, "data/action": 2, "data/point_cloud": 3}
"""Arrays with a row for each step, and how many dimensions they have."""
_ENDS = "meta/episode_ends"
_ROWS_AT_ONCE = 200
"""A cloud of 1024 points with colors takes 24 kB: so many are read at a time."""
_REDO = "write the store anew, or copy it again from where it is whole"


class DP3Store:
    """A zarr v2 store as DP3's scripts and ``flowlab export`` write it, opened for reading.

    ``data/{state, action, point_cloud}`` hold the steps of all episodes, one behind the other, and
    ``meta/episode_ends`` the row after each episode's last. Whatever else a store holds is not read.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.task = Path(os.path.abspath(self.path)).stem
        """A store does not say which task it shows; its folder usually does."""
        group = self._open_group()
        self._claims = {name: self._claim(name) for name in (*_DATA, _ENDS)}
        self._arrays = {name: self._open(group, name) for name in (*_DATA, _ENDS)}
        self._check_shapes()
        self._ends = self._read_ends()

    @staticmethod
    def looks_like(path: Path) -> bool:
        """Whether a folder is a zarr v2 group with ``data`` or ``meta``, as DP3's stores are."""
        return (path / ".zgroup").is_file() and ((path / "data").is_dir() or (path / "meta").is_dir())

    def __len__(self) -> int:
        return len(self._ends)

    @property
    def frames(self) -> tuple[int, ...]:
        """The number of steps of each episode."""
        return tuple(np.diff(self._ends, prepend=0).tolist())

    @cached_property
    def fingerprint(self) -> str:
        """Identifies the content of the arrays, however they are cut into chunks and compressed."""
        digest = hashlib.sha256()
        for name, array in self._arrays.items():
            digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
            rows = -(-_ROWS_AT_ONCE // array.chunks[0]) * array.chunks[0]  # whole chunks, to decode each once
            for start in range(0, array.shape[0], rows):
                digest.update(np.ascontiguousarray(self._read(name, start, start + rows)).data)
        return digest.hexdigest()[:16]

    def episodes(self) -> Iterator[Episode]:
        """Every episode, read when it is its turn; its ``seed`` is its place in the store.

        A store lacks much of what an episode tells. There are no query points, and no step counts as success. The
        rate is unknown: ``time_s`` counts steps as if each took a second. So is the camera: a picture of one pixel
        at the origin stands for it, which makes the frame of the points, whatever it is, the camera's own.
        """
        for k, (start, stop) in enumerate(pairwise([0, *self._ends])):
            yield self._episode(k, start, stop)

    def _episode(self, k: int, start: int, stop: int) -> Episode:
        """The k-th episode, whose rows are known."""
        state, action, point_cloud = (self._numbers(name, k, start, stop) for name in _DATA)
        steps = stop - start
        nowhere = np.zeros((0, 3), np.float32)
        return Episode(
            task=self.task,
            seed=k,
            camera=Camera(1, 1, np.eye(3), np.eye(4)),
            time_s=np.arange(steps, dtype=np.float64),
            point_cloud=point_cloud,
            point_count=count_points(point_cloud),
            state=state,
            action=action,
            success=np.zeros(steps, bool),
            queries=Queries(nowhere, np.zeros(0, np.int16), 0),
            tracks=Tracks3D(
                np.zeros((steps, 0, 3), np.float32), np.zeros((steps, 0), bool), association_distance=nowhere[:, 0]
            ),
        )

    def _numbers(self, name: str, episode: int, start: int, stop: int) -> np.ndarray:
        """Rows of an array as float32, of points xyz only, none of them infinite or NaN."""
        values = self._read(name, start, stop)[..., : 3 if name == "data/point_cloud" else None]
        with np.errstate(over="ignore"):
            values = np.ascontiguousarray(values, np.float32)
        broken = ~np.isfinite(values.reshape(len(values), -1)).all(1)
        if broken.any():
            raise DataError(
                f"{self.path}/{name}: {broken.sum()} of the {len(values)} steps of episode {episode} have values that "
                f"are not finite, the first in row {start + int(broken.argmax())}; leave such episodes out of the store"
            )
        return values

    def _read(self, name: str, start: int, stop: int) -> np.ndarray:
        """Rows of an array; a damaged chunk is a :class:`DataError`."""
        array = self._arrays[name]
        size = (stop - start) * math.prod(array.shape[1:]) * array.dtype.itemsize
        if size > MAX_LOADED_BYTES:
            raise DataError(
                f"{self.path}/{name}: rows {start} to {stop} have {size:,} bytes, expected at most {MAX_LOADED_BYTES:,}"
            )
        self._claims[name].check_chunks(start, stop)
        try:
            return np.asarray(array[start:stop])
        except Exception as error:  # zarr and the codecs raise many kinds
            raise DataError(f"{self.path}/{name}: damaged ({first_line(error)}); {_REDO}") from error

    def _open_group(self) -> zarr.Group:
        """The group of the store."""
        check_attributes(self.path)
        try:
            return zarr.open_group(self.path, mode="r", zarr_format=2, use_consolidated=False)
        except FileNotFoundError as error:
            raise DataError(f"{self.path}: there is no zarr v2 store here") from error
        except Exception as error:  # zarr lets through what the metadata lead it to
            raise DataError(f"{self.path}: not a readable zarr v2 store ({first_line(error)}); {_REDO}") from error

    def _open(self, group: zarr.Group, name: str) -> "zarr.Array[Any]":
        """An array, its values unread."""
        try:
            array = group[name]
        except Exception as error:  # zarr lets through what the metadata lead it to
            raise DataError(f"{self.path}/{name}: damaged ({first_line(error)}); {_REDO}") from error
        if not isinstance(array, zarr.Array):
            raise DataError(f"{self.path}/{name}: a group, expected an array")
        return array

    def _claim(self, name: str) -> ArrayClaim:
        """What an array claims; all that can be told without zarr is checked."""
        folder = self.path / name
        if not (folder / ".zarray").exists():
            if (folder / ".zgroup").exists():
                raise DataError(f"{folder}: a group, expected an array")
            raise DataError(
                f"{self.path}: the array {name} is missing, there are: {', '.join(self._existing()) or 'none'}; "
                f"a store in DP3's layout has {', '.join((*_DATA, _ENDS))}"
            )
        return ArrayClaim.read(folder)

    def _existing(self) -> list[str]:
        """The arrays that the store has, as far as folders tell."""
        return sorted(cut(str(f.parent.relative_to(self.path))) for f in self.path.glob("*/*/.zarray"))

    def _check_shapes(self) -> None:
        """Refuse arrays that are not of one set of steps."""
        for name, dimensions in _DATA.items():
            shape = self._arrays[name].shape
            if len(shape) != dimensions or 0 in shape[1:]:
                raise DataError(f"{self.path}/{name}: the shape is {shape}, expected {dimensions} dimensions, none 0")
        points = self._arrays["data/point_cloud"]
        if points.shape[2] < 3:
            raise DataError(f"{self.path}/data/point_cloud: points of {points.shape[2]} numbers, expected xyz first")
        missing = points.nchunks - points.nchunks_initialized
        if missing:  # zarr reads them as zeros, and some writers leave zeros out; but nobody sees only zeros
            raise DataError(f"{self.path}/data/point_cloud: {missing} of {points.nchunks} chunks missing; {_REDO}")
        rows = {name: self._arrays[name].shape[0] for name in _DATA}
        if len(set(rows.values())) > 1:
            found = ", ".join(f"{name} {n}" for name, n in rows.items())
            raise DataError(f"{self.path}: the arrays differ in their number of steps ({found}); {_REDO}")

    def _read_ends(self) -> list[int]:
        """The row after each episode's last."""
        array, rows, place = self._arrays[_ENDS], self._arrays["data/state"].shape[0], f"{self.path}/{_ENDS}"
        shape = array.shape
        if len(shape) != 1 or shape[0] == 0 or array.dtype.kind not in "iu":
            raise DataError(
                f"{place}: {array.dtype} of shape {shape}, expected a row number for each of at least one episode"
            )
        ends: list[int] = self._read(_ENDS, 0, shape[0]).tolist()
        for k, (start, stop) in enumerate(pairwise([0, *ends])):
            if stop <= start:
                raise DataError(
                    f"{place}: episode {k} starts at row {start} and ends at row {stop}, expected ends that increase; "
                    f"{_REDO}"
                )
        if ends[-1] != rows:
            raise DataError(f"{place}: the last episode ends at row {ends[-1]}, and the data at row {rows}; {_REDO}")
        return ends


def count_points(point_cloud: Float32[np.ndarray, "T N 3"]) -> Int32[np.ndarray, "T"]:
    """How many points of each cloud come before the (0, 0, 0) that DP3 fills small clouds up with; at least 1.

    Points that are repeated, as flowlab fills up its own, count.
    """
    padding = (point_cloud == 0).all(-1)[:, ::-1]
    trailing = np.where(padding.all(1), padding.shape[1], padding.argmin(1))
    return np.maximum(padding.shape[1] - trailing, 1).astype(np.int32)
