"""The demonstrations as training reads them: decoded once, then mapped into memory."""

import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Int

from flowlab.data.source import TrainingSource
from flowlab.errors import DataError
from flowlab.files import locked, read_json, remove_leftovers, temporary_path, write_json
from flowlab.records import Episode

_DONE = "corpus.json"
"""Written last: a folder that has it is whole."""
_FORMAT = 1


@dataclass(frozen=True, slots=True)
class EpisodeSlice:
    """Where a demonstration lies in the arrays of a corpus."""

    task: str
    seed: int
    start: int
    stop: int
    """Its rows are ``start`` to ``stop - 1``."""

    def __len__(self) -> int:
        return self.stop - self.start


@dataclass(frozen=True, slots=True)
class ReplayBuffer:
    """All demonstrations of a dataset, one behind the other: F frames, D demonstrations, Q query points."""

    demos: tuple[EpisodeSlice, ...]
    """In order of task and seed."""
    points: Float32[np.ndarray, "F N 3"]
    """World frame [m]."""
    state: Float32[np.ndarray, "F S"]
    action: Float32[np.ndarray, "F A"]
    tracks: Float32[np.ndarray, "F Q 3"]
    """World frame [m]."""
    visible: Bool[np.ndarray, "F Q"]
    sigma: Float32[np.ndarray, "F Q"]
    """Stated error [m]; 0 for exact tracks."""
    object_pose: Float32[np.ndarray, "F P"]
    """P is 9, or 0 where it is not known."""
    queries: Float32[np.ndarray, "D Q 3"]
    query_role: Int[np.ndarray, "D Q"]
    query_count: Int[np.ndarray, "D 1"]

    @property
    def tasks(self) -> tuple[str, ...]:
        """Names of the tasks, sorted."""
        return tuple(sorted({d.task for d in self.demos}))

    def split(self, demonstrations: int | None, held_out: int) -> tuple[list[int], list[int]]:
        """Which demonstrations to train on, and which to validate on; see :class:`DataSettings`."""
        train, held = [], []
        for task in self.tasks:
            of_task = [k for k, d in enumerate(self.demos) if d.task == task]
            last = len(of_task) - min(held_out, len(of_task) // 3)
            train += of_task[:last][:demonstrations]
            held += of_task[last:]
        return train, held


def load_buffer(source: TrainingSource, fallback: Path) -> ReplayBuffer:
    """The corpus of a source, decoded into ``cache`` below it, or into ``fallback`` where that cannot be written.

    Decoded once for each content of the dataset; later calls only map the files.
    """
    name = f"{source.fingerprint}-{_FORMAT}"
    places = [source.path / "cache" / name, fallback / "cache" / name]
    for place in places:
        if (place / _DONE).exists():
            return _open(place)
    folder = next((p for p in places if _writable(p.parent)), None)
    if folder is None:
        raise DataError(f"{fallback}: cannot be written; choose another --out")
    with locked(folder.parent):
        if not (folder / _DONE).exists():
            remove_leftovers(folder.parent)
            temporary = temporary_path(folder)
            try:
                _decode(source, temporary)
                for outdated in folder.parent.glob("*"):
                    if outdated != temporary:
                        shutil.rmtree(outdated, ignore_errors=True)
                os.replace(temporary, folder)
            except OSError as error:
                raise DataError(f"{folder}: cannot be written ({error.strerror}); make room there") from error
            finally:
                shutil.rmtree(temporary, ignore_errors=True)
    return _open(folder)


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


def _open(folder: Path) -> ReplayBuffer:
    values = read_json(folder / _DONE)
    arrays = {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in values["arrays"]}
    return ReplayBuffer(demos=tuple(EpisodeSlice(**d) for d in values["demos"]), **arrays)


def _decode(source: TrainingSource, folder: Path) -> None:
    """Write every array of the corpus, episode by episode."""
    folder.mkdir()
    arrays: dict[str, np.ndarray] = {}
    demos: list[EpisodeSlice] = []
    queries: list[dict[str, np.ndarray]] = []
    row = 0
    for episode in source.episodes():
        demo = EpisodeSlice(episode.task, episode.seed, row, row + len(episode))
        for name, values in _per_frame(episode).items():
            if name not in arrays:
                arrays[name] = _create(folder / f"{name}.npy", values.dtype, (source.frames, *values.shape[1:]))
            if values.shape[1:] != arrays[name].shape[1:]:
                raise DataError(
                    f"{source.path}: {demo.task} seed {demo.seed}: '{name}' is {values.shape[1:]} wide, in those "
                    f"before {arrays[name].shape[1:]}; train on one of them at a time"
                )
            arrays[name][demo.start : demo.stop] = values
        demos.append(demo)
        queries.append(_per_demo(episode))
        row = demo.stop
    order = sorted(range(len(demos)), key=lambda k: (demos[k].task, demos[k].seed))
    for name in queries[0]:
        np.save(folder / f"{name}.npy", np.stack([queries[k][name] for k in order]))
    for array in arrays.values():
        array.flush()  # type: ignore[attr-defined]
    names = [*arrays, *queries[0]]
    write_json(folder / _DONE, {"demos": [asdict(demos[k]) for k in order], "arrays": names})


def _create(path: Path, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    """A mapped array whose space on disk is taken: without that a full disk kills the process as it writes."""
    array = np.lib.format.open_memmap(path, "w+", dtype, shape)
    with path.open("r+b") as file:
        os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
    return array


def _per_frame(e: Episode) -> Mapping[str, np.ndarray]:
    tracks = e.tracks
    exact = np.zeros(tracks.visible.shape, np.float32)
    return {
        "points": e.point_cloud,
        "state": e.state,
        "action": e.action,
        "tracks": tracks.xyz_world,
        "visible": tracks.visible,
        "sigma": exact if tracks.quality is None else tracks.quality.sigma,
        "object_pose": np.zeros((len(e), 0), np.float32) if e.object_pose is None else e.object_pose,
    }


def _per_demo(e: Episode) -> dict[str, np.ndarray]:
    return {
        "queries": e.queries.xyz_world,
        "query_role": e.query_role.astype(np.int8),
        "query_count": np.array([e.queries.count]),
    }
