"""Windows of a dataset for anybody's own training loop: a map-style :class:`torch.utils.data.Dataset`."""

import operator
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from flowlab.data.cache import cached_part, open_part
from flowlab.data.replay_buffer import ARRAYS, arrays_of
from flowlab.data.source import TrainingSource, open_training_source, source_of
from flowlab.data.window_arguments import choose_episodes, finite_numbers, one_of, shown
from flowlab.data.window_pictures import Where, WindowPictures
from flowlab.data.window_stats import describe_rows
from flowlab.errors import DataError, UsageError, unknown_name
from flowlab.storage.dataset import Dataset
from flowlab.storage.episodes import EpisodeSequence
from flowlab.storage.importers.dp3 import DP3Store
from flowlab.storage.pictures import StoredPictures

_PER_EPISODE = ("queries", "query_role", "query_count", "estimated")
_UNKNOWN_IN_IMPORTS = ("success", "time")
"""What a store in DP3's layout does not tell."""


class Windows(torch.utils.data.Dataset[dict[str, Any]]):
    """Every frame of a dataset, each with the rows around it that are asked for.

    Item i is a dictionary:

    - ``KEY``: a tensor (T, ...) with a row for each of the T offsets of that key, in the dataset's units. Arrays keep
      their type (float32 but for ``visible``, ``success``: bool, ``time``: float64, ``point_count``: int32); ``rgb`` is
      (T, 3, height, width), float32 from 0 to 1, and ``depth`` (T, 1, height, width), z-depth [m], 0 where there is no
      reading. ``flow`` (T, M, 3) is how far every query point moves until the next row [m].
    - ``KEY_is_pad``: (T,) bool, whether that row lies outside of the episode; then the first or last row is repeated.
      ``flow_is_pad`` is True in the last row of an episode, too: how points move after it is not known, and 0 there.
    - ``task``: name of the task; ``episode_index`` and ``frame_index``: where the frame is, both from 0.

    It can be pickled, and every process maps the files anew, so that it works with the workers of a
    :class:`torch.utils.data.DataLoader`.

        windows = Windows("data/push", {"point_cloud": [-1, 0], "state": [-1, 0], "action": range(16)})
        loader = torch.utils.data.DataLoader(windows, batch_size=64, shuffle=True, num_workers=2)

    Args:
        data: A dataset, some of its episodes such as ``dataset.task("push")``, or the path of a dataset or of a store
            in DP3's layout.
        offsets: For every key that is wanted, its rows relative to the frame: ``[-1, 0]`` is the one before, and its
            own. Each must lie inside of an episode for some frame.
        delta_timestamps: The same in seconds; give either. The rows must be evenly spaced in time.
        episodes: Which episodes, by their position in ``data``, in order of task and seed; None is all of them.
        tolerance_s: How far a time may be from that of a row [s].
        cache: Folder for the decoded arrays where the user's cache folder cannot be written.
        pictures: ``stored`` reads pictures from the shards as windows are asked for, no others than theirs; ``decoded``
            decodes all of them first, into the cache folder, where they are large and read more quickly. None is
            ``stored``, but for datasets of earlier versions, which stored up to 256 pictures together.

    Raises:
        UsageError: A key, an offset or an episode does not exist, or a time is that of no row.
        DataError: The dataset cannot be read, has no pictures where some are asked for, or its rows are not evenly
            spaced in time where that matters.
    """

    def __init__(
        self,
        data: EpisodeSequence | Path | str,
        offsets: Mapping[str, Sequence[int]] | None = None,
        *,
        delta_timestamps: Mapping[str, Sequence[float]] | None = None,
        episodes: Sequence[int] | None = None,
        tolerance_s: float = 1e-4,
        cache: Path | str | None = None,
        pictures: Where | None = None,
    ) -> None:
        asked = one_of(offsets, delta_timestamps)
        source, dataset, among = _opened(data)
        fallback = None if cache is None else Path(cache)
        self.path = source.path
        self._folders = [cached_part(source, fallback, ARRAYS, arrays_of)]
        every, arrays = open_part(self._folders[0])
        self._all_ends = sorted(e["stop"] for e in every)
        self._pictures = WindowPictures(source, dataset, asked, pictures, fallback)
        self._folders += self._pictures.folders
        self.keys = self._known(arrays, source)
        """Names of everything that can be asked for."""
        for key in asked:
            if key not in self.keys:
                raise UsageError(f"{self.path}: {unknown_name('array', str(key), self.keys)}")
        self.episodes: tuple[int, ...] = choose_episodes(
            episodes, range(len(every)) if among is None else among, self.path
        )
        """Positions of the episodes in the dataset, in order of task and seed."""
        self._episodes = [every[k] for k in self.episodes]
        lengths = [e["stop"] - e["start"] for e in self._episodes]
        self._longest = max(lengths)
        self.episode_ends: Int[np.ndarray, E] = np.cumsum(lengths)
        """The index after the last of each episode."""
        self.offsets: dict[str, np.ndarray] = {
            key: self._rows(key, values, "iu", "offsets")
            if offsets is not None
            else self._times_to_rows(key, values, source, tolerance_s)
            for key, values in asked.items()
        }
        """Rows of every key, relative to the frame."""

    def __len__(self) -> int:
        return int(self.episode_ends[-1])

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not hasattr(index, "__index__"):
            raise UsageError(
                f"{self.path}: windows are numbered, as in windows[2], and found windows[{shown(index)}]; several are "
                "torch.utils.data.Subset(windows, range(2, 4))"
            )
        index = operator.index(index)
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.path}: there are {len(self)} windows, and no window {index}")
        index = index % len(self)
        k = int(np.searchsorted(self.episode_ends, index, side="right"))
        episode = self._episodes[k]
        frame = index - (int(self.episode_ends[k - 1]) if k else 0)
        item: dict[str, Any] = {"task": episode["task"], "episode_index": self.episodes[k], "frame_index": frame}
        for key, offsets in self.offsets.items():
            wanted = episode["start"] + frame + offsets
            rows = np.clip(wanted, episode["start"], episode["stop"] - 1)
            if key in self._pictures.stored:
                values = self._pictures.rows(key, self.episodes[k], rows - episode["start"])
            else:
                values = self._read(key, rows, episode["stop"] - 1)
            item[key] = _as_tensor(key, values)
            unknown = (wanted == episode["stop"] - 1) & (key == "flow")
            item[f"{key}_is_pad"] = torch.from_numpy((wanted != rows) | unknown)
        return item

    def __repr__(self) -> str:
        about = ", ".join(f"{key} {offsets.tolist()}" for key, offsets in self.offsets.items())
        return f"Windows({str(self.path)!r}: {len(self)} windows of {len(self.episodes)} episodes; {about})"

    def __getstate__(self) -> dict[str, Any]:
        """Without what is mapped into memory, which every process maps for itself."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_arrays", "stats")}

    @property
    def tasks(self) -> tuple[str, ...]:
        """Names of the tasks, sorted."""
        return tuple(sorted({e["task"] for e in self._episodes}))

    @cached_property
    def stats(self) -> dict[str, dict[str, Tensor]]:
        """``min``, ``max``, ``mean`` and ``std`` of every key that is asked for and is no yes or no, over all episodes
        of the dataset: per channel, so of shape (3,) for clouds, and of pictures as they are handed out."""
        arrays: dict[str, np.ndarray | StoredPictures] = {**self._arrays, **self._pictures.stored}
        about = {k: arrays["tracks" if k == "flow" else k] for k in self.offsets}
        return {k: describe_rows(k, values, self._all_ends) for k, values in about.items() if values.dtype != bool}

    @cached_property
    def _arrays(self) -> dict[str, np.ndarray]:
        return {name: array for folder in self._folders for name, array in open_part(folder)[1].items()}

    def _read(self, key: str, rows: Int[np.ndarray, "T"], last: int) -> np.ndarray:
        """Rows of what is mapped into memory; flow is that of an episode that ends with the row ``last``."""
        if key == "flow":
            tracks = self._arrays["tracks"]
            return tracks[np.minimum(rows + 1, last)] - tracks[rows]
        return np.array(self._arrays[key][rows])

    def _known(self, arrays: Mapping[str, np.ndarray], source: TrainingSource) -> tuple[str, ...]:
        """What can be asked for: arrays that are not empty, flow where there are tracks, and pictures that were
        found."""
        names = {n for n, a in arrays.items() if n not in _PER_EPISODE and 0 not in a.shape[1:]}
        names -= {"sigma"} if not arrays["estimated"].any() else set()
        names -= {"action_sigma"} if not arrays["action_sigma"].any() else set()
        names |= {"flow"} if "tracks" in names else set()
        names -= set(_UNKNOWN_IN_IMPORTS) if source.provenance.kind == "imported" else set()
        return tuple(sorted(names | set(self._pictures.kinds)))

    def _times_to_rows(
        self, key: str, times: Sequence[float], source: TrainingSource, tolerance_s: float
    ) -> Int[np.ndarray, "T"]:
        if not (isinstance(tolerance_s, int | float) and 0 <= tolerance_s < np.inf):
            raise UsageError(f"Windows: tolerance_s must be seconds, 0 or more, as in 0.0001; found {tolerance_s!r}")
        step = self._step_s(source, tolerance_s)
        seconds = finite_numbers(key, times, "iuf", "delta_timestamps")
        rows = self._rows(key, np.round(seconds / step), "f", "delta_timestamps")
        for time, row in zip(seconds, rows, strict=True):
            if abs(time - row * step) > tolerance_s:
                raise UsageError(
                    f"{self.path}: delta_timestamps of '{key}': {time:g} s is that of no row; the rows are {step:g} s "
                    f"apart, so the nearest is {row * step:g} s"
                )
        return rows

    def _rows(self, key: str, offsets: Any, kinds: str, what: str) -> Int[np.ndarray, "T"]:
        """Rows that lie inside of some episode for some frame."""
        rows = finite_numbers(key, offsets, kinds, what)
        outside = rows[(rows <= -self._longest) | (rows >= self._longest)]
        if len(outside):
            raise UsageError(
                f"{self.path}: {what} of '{key}': {outside[0]:.0f} rows off lies outside of every episode; the longest "
                f"has {self._longest} rows, so rows are {1 - self._longest} to {self._longest - 1} off"
            )
        return rows.astype(int)

    def _step_s(self, source: TrainingSource, tolerance_s: float) -> float:
        """Time from row to row [s]."""
        if source.provenance.kind == "imported":
            raise DataError(f"{self.path}: does not tell how far its rows are apart in time; give offsets in rows")
        time = self._arrays["time"]
        steps = np.concatenate([np.diff(time[e["start"] : e["stop"]]) for e in self._episodes])
        step = float(np.median(steps)) if len(steps) else 1.0
        if len(steps) and np.abs(steps - step).max() > tolerance_s:
            raise DataError(
                f"{self.path}: its rows are not evenly spaced in time: {steps.min():g} to {steps.max():g} s apart, and "
                f"tolerance_s is {tolerance_s:g}; give offsets in rows"
            )
        return step


def _as_tensor(key: str, values: np.ndarray) -> Tensor:
    """Rows as windows hand them out: of pictures the channels come first, and colors are from 0 to 1."""
    rows = torch.from_numpy(values)
    if key == "rgb":
        return rows.permute(0, 3, 1, 2).float() / 255
    return rows[:, None] if key == "depth" else rows


def _opened(data: EpisodeSequence | Path | str) -> tuple[TrainingSource, Dataset | None, list[int] | None]:
    """What is read, the dataset where it is one, and the positions in it of the episodes that were given; None is all
    of them."""
    if isinstance(data, Dataset):
        return source_of(data), data, None
    if isinstance(data, EpisodeSequence):
        dataset = Dataset(data.path)
        position = {ref: k for k, ref in enumerate(dataset.refs)}
        return source_of(dataset), dataset, [position[ref] for ref in data.refs]
    if not isinstance(data, str | Path):
        raise UsageError(f"Windows: data must be a dataset or its path, as in 'data/push'; found {shown(data)}")
    if DP3Store.looks_like(Path(data)):
        return open_training_source(Path(data)), None, None
    return _opened(Dataset(data))
