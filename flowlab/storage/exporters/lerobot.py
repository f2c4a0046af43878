"""LeRobotDataset v3.0."""

import json
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from flowlab.config import PlainName
from flowlab.files import new_folder
from flowlab.records import Episode
from flowlab.storage.dataset import Dataset
from flowlab.storage.episodes import EpisodeRef
from flowlab.storage.exporters.base import Exporter, select_episodes
from flowlab.storage.exporters.lerobot_features import ExportPlan, calibration, make_plan, said_of_episode
from flowlab.storage.exporters.lerobot_pictures import picture_features
from flowlab.storage.exporters.lerobot_stats import FeatureStats, flattened
from flowlab.storage.exporters.lerobot_tables import (
    FILES_TO_CHUNK,
    TableWriter,
    as_column,
    place_of,
    write_table,
    write_tasks,
)
from flowlab.version import __version__

_LOG = logging.getLogger(__name__)
_DATA_MB, _VIDEO_MB = 100, 200
_OWN = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
"""Columns that every dataset of LeRobot has."""
_PATHS = {
    "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
}
_CARD = """---
tags: [LeRobot, 3d-flow]
configs:
- config_name: default
  data_files: data/*/*.parquet
---
# {name}

{episodes} episodes, {frames} steps, {fps} a second, exported by flowlab {version} as LeRobotDataset v3.0. What the
numbers mean and where they come from is in `meta/flowlab.json`; what each feature holds is in its `info` in
`meta/info.json`.

{clock}Not written: {left_out}.
"""
_CLOCK_ERROR = 0.01
"""LeRobot's timestamps may be off by such a share of an episode before that is said."""


class LeRobotExporter(Exporter):
    """Writes the folder that LeRobot's own class opens, and robots' policies are trained from.

    Clouds and tracks are features of points; the camera's calibration is in the ``info`` of its pictures, and for each
    episode in the columns ``camera/K`` and ``camera/T_world_cam`` of ``meta/episodes``.
    """

    name: ClassVar[str] = "lerobot"
    writes: ClassVar[str] = "a LeRobotDataset v3.0 with pictures, depth, clouds, tracks and calibration"

    flat: bool = False
    """Write clouds and tracks as one row of numbers for each step: windows are read four times as fast."""
    rgb: Literal["video", "image"] = "video"
    """Color as H.264, or as PNG without loss."""
    crf: int = Field(default=18, ge=0, le=51)
    """Quality of the video: 0 is without loss of detail, higher is smaller."""
    depth: Literal["mm", "m", "video"] = "mm"
    """Depth as PNG of whole millimeters, as TIFF of meters bit by bit, or as LeRobot's 12-bit HEVC, in which a pixel
    without a reading looks like one at 1 cm."""
    camera: PlainName = "main"
    """What the camera is called in the names of features."""

    def export(self, dataset: Dataset, path: Path, task: str | None = None) -> int:
        """Write the folder; see :class:`~flowlab.storage.exporters.base.Exporter`."""
        chosen = select_episodes(dataset, path, task)
        plan = make_plan(dataset, chosen, flat=self.flat)
        with new_folder(path) as folder:
            export = _Export(self, dataset, chosen, plan, folder)
            export.write()
            (folder / "README.md").write_text(_card(dataset.path.name, chosen, plan))
        if plan.clock_error > _CLOCK_ERROR:
            _LOG.warning("flowlab: %s: %s", path, _clock(plan))
        if plan.left_out:
            _LOG.warning(
                "flowlab: %s: not written, as LeRobot has no features for it: %s",
                path,
                ", ".join(sorted(plan.left_out)),
            )
        return len(chosen)


def _clock(plan: ExportPlan) -> str:
    """What is said where steps are not as regular as LeRobot wants them."""
    return (
        f"steps are written as {plan.fps} a second, as LeRobot wants a whole number and regular ones; its timestamps "
        f"are off by up to {plan.clock_error:.1%} of an episode, and the true times are in observation.time"
    )


def _card(name: str, chosen: Sequence[EpisodeRef], plan: ExportPlan) -> str:
    left_out = "; ".join(f"`{array}` ({meaning})" for array, meaning in plan.left_out.items()) or "nothing"
    frames = sum(ref.frames for ref in chosen)
    return _CARD.format(
        name=name,
        episodes=len(chosen),
        frames=frames,
        fps=plan.fps,
        version=__version__,
        left_out=left_out,
        clock=f"\nThe {_clock(plan)}.\n" if plan.clock_error > _CLOCK_ERROR else "",
    )


class _Export:
    """One export at work."""

    def __init__(
        self, how: LeRobotExporter, dataset: Dataset, chosen: Sequence[EpisodeRef], plan: ExportPlan, folder: Path
    ) -> None:
        self._dataset, self._chosen, self._plan, self._folder = dataset, chosen, plan, folder
        self._tasks = list(dict.fromkeys(ref.task for ref in chosen))
        self._table = TableWriter(folder / "data", _DATA_MB << 20)
        self._pictures = picture_features(plan, folder, camera=how.camera, rgb=how.rgb, depth=how.depth, crf=how.crf,
                                          most_bytes=_VIDEO_MB << 20)  # fmt: skip
        own = {name: FeatureStats((1,)) for name in _OWN}
        made = {f.name: FeatureStats((3,) if f.by_axis and len(f.shape) > 1 else f.shape) for f in plan.features}
        self._stats = {**own, **made, **{p.name: FeatureStats((p.channels, 1, 1)) for p in self._pictures}}
        self._cameras: list[dict[str, Any]] = []

    def write(self) -> None:
        """Write everything."""
        about, first = [], 0
        for k, ref in enumerate(self._numbered()):
            about.append(self._episode(k, first, ref[1]))
            first += len(ref[1])
        self._table.close()
        for picture in self._pictures:
            picture.close()
        columns = {key: [row[key] for row in about] for key in about[0]}
        write_table(self._folder / "meta/episodes/chunk-000/file-000.parquet", columns)
        write_tasks(self._folder / "meta/tasks.parquet", self._tasks)
        _write_json(self._folder / "meta/stats.json", {name: stats.to_json() for name, stats in self._stats.items()})
        _write_json(self._folder / "meta/info.json", self._info(first))
        _write_json(self._folder / "meta/flowlab.json", self._origin())

    def _numbered(self) -> Iterator[tuple[EpisodeRef, Episode]]:
        """The chosen episodes, in the dataset's order."""
        wanted = {(ref.task, ref.seed) for ref in self._chosen}
        for k, ref in enumerate(self._dataset.refs):
            if (ref.task, ref.seed) in wanted:
                yield ref, self._dataset.episode(k)

    def _episode(self, k: int, first: int, episode: Episode) -> dict[str, Any]:
        """Write an episode; what ``meta/episodes`` says of it."""
        count = len(episode)
        steps = np.arange(count)
        own: dict[str, np.ndarray] = {"timestamp": (steps / self._plan.fps).astype(np.float32), "frame_index": steps,
               "episode_index": np.full(count, k), "index": first + steps,
               "task_index": np.full(count, self._tasks.index(episode.task))}  # fmt: skip
        values = {name: x.astype(_OWN[name])[:, None] for name, x in own.items()}
        values |= {f.name: f.of(episode) for f in self._plan.features}
        axes = {f.name for f in self._plan.features if f.by_axis and len(f.shape) > 1}
        stats = {name: self._stats[name].add(x.reshape(-1, 3) if name in axes else x.reshape(count, -1), count)
                 for name, x in values.items()}  # fmt: skip
        columns = {name: as_column(x) for name, x in values.items()}
        videos: dict[str, Any] = {}
        for picture in self._pictures:
            column, part = picture.write(episode, k)
            columns |= {} if column is None else {picture.name: column}
            videos |= {} if part is None else {f"videos/{picture.name}/{key}": value for key, value in part.items()}
            stats[picture.name] = self._stats[picture.name].add(picture.sample(episode), count)
        self._cameras.append(calibration(episode))
        said = {"episode_index": k, "tasks": [episode.task], "length": count,
                **_place(self._table.add(columns), "data/"),
                "dataset_from_index": first, "dataset_to_index": first + count, **videos,
                **_place(0, "meta/episodes/"), **said_of_episode(episode)}  # fmt: skip
        flat = {f"stats/{name}/{key}": value for name, s in stats.items() for key, value in flattened(s).items()}
        return said | flat

    def _info(self, frames: int) -> dict[str, Any]:
        """``meta/info.json``."""
        shared = self._shared_camera or {}
        own: dict[str, Any] = {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in _OWN.items()}
        features = (
            {p.name: p.to_json(shared) for p in self._pictures}
            | {f.name: f.to_json() for f in self._plan.features}
            | own
        )
        return {
            "codebase_version": "v3.0",
            "robot_type": None,
            "total_episodes": len(self._chosen),
            "total_frames": frames,
            "total_tasks": len(self._tasks),
            "chunks_size": FILES_TO_CHUNK,
            "data_files_size_in_mb": _DATA_MB,
            "video_files_size_in_mb": _VIDEO_MB,
            "fps": self._plan.fps,
            "splits": {"train": f"0:{len(self._chosen)}"},
            "data_path": _PATHS["data_path"],
            "video_path": _PATHS["video_path"] if any(p.is_video for p in self._pictures) else None,
            "features": features,
        }

    @property
    def _shared_camera(self) -> dict[str, Any] | None:
        """The calibration of all episodes; None where they differ."""
        first = self._cameras[0]
        return first if all(camera == first for camera in self._cameras) else None

    def _origin(self) -> dict[str, Any]:
        """``meta/flowlab.json``: where the episodes come from, and what LeRobot has no place for."""
        return {
            "flowlab": __version__,
            "fingerprint": self._dataset.fingerprint,
            "units": dict(self._dataset.manifest.units),
            "provenance": json.loads(self._dataset.provenance.model_dump_json()),
            "camera": self._shared_camera or "by episode: meta/episodes",
            "left_out": dict(self._plan.left_out),
        }


def _place(file: int, of: str) -> dict[str, int]:
    return {f"{of}{key}": number for key, number in place_of(file).items()}


def _write_json(path: Path, values: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values, indent=4) + "\n")
