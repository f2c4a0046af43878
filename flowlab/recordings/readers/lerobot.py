"""Datasets of LeRobot, v3.0 and v2.x: one camera with depth, and the robot, of every episode."""

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from flowlab.errors import DataError
from flowlab.limits import MAX_WIDTH
from flowlab.recordings.base import SampleStream, Streams
from flowlab.recordings.harmless_files import why_harmless
from flowlab.recordings.parts import split_path
from flowlab.recordings.poses import check_poses, pose_stream
from flowlab.recordings.readers.lerobot_camera import choose_camera, is_registered, known_calibration
from flowlab.recordings.readers.lerobot_episodes import (
    LeRobotEpisode,
    is_dataset,
    meta_files,
    one_episode,
    read_episodes,
)
from flowlab.recordings.readers.lerobot_pictures import NEAREST, picture_files, read_pictures
from flowlab.recordings.readers.lerobot_process import ask
from flowlab.recordings.readers.lerobot_tasks import COLUMN, rows_of, task_checks, tasks_of
from flowlab.recordings.recording_yaml import Metadata
from flowlab.recordings.sample_files import to_float32
from flowlab.recordings.stamps import Timing
from flowlab.recordings.unused_files import is_ignored, some_of
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import shown

STATE, ACTION, SUCCESS = "observation.state", "action", "next.success"
TIME, POSES = "observation.time", "observation.T_world_cam"
"""When a step truly was [s], and where the camera was: columns that flowlab's own exporter writes."""
_COUNTS = ("timestamp", "frame_index", "episode_index", "index", COLUMN)


class LeRobotReader:
    """Reads one camera, and the robot, from an episode of a LeRobot dataset."""

    name = "lerobot"
    expects = "a LeRobot dataset with depth (meta/info.json with codebase_version)"
    fallback = False

    def probe(self, path: Path) -> bool:
        """Whether it is a dataset, by its ``meta/info.json``, or a part of one."""
        return is_dataset(split_path(path)[0])

    def episodes(self, path: Path, given: Metadata) -> Sequence[str]:
        """The episodes of a dataset."""
        return list(read_episodes(path))

    def files(self, path: Path) -> Sequence[Path]:
        """The files that an episode is made of."""
        folder, part = split_path(path)
        one = one_episode(path, folder, part)
        return [*meta_files(folder), one.data, *picture_files(one)]

    def task(self, path: Path) -> str | None:
        """What the dataset says is done in an episode."""
        return next(iter(tasks_of(one_episode(path, *split_path(path)))), None)

    def read(self, path: Path, given: Metadata) -> Streams:
        """The streams of an episode."""
        one = one_episode(path, *split_path(path))
        camera = choose_camera(one, given.camera)
        first, last = rows_of(one)
        numbers = _numbers(one, first, last)
        stamps = _stamps(one, numbers)
        time_s = np.ascontiguousarray(numbers.get(TIME, stamps).reshape(-1), np.float64)
        color, depth = (read_pictures(one, f, first, time_s, stamps) for f in (camera.color, camera.depth))
        timing = Timing("the timestamps")
        state, action = (_stream(one, name, numbers, time_s, timing) for name in (STATE, ACTION))
        unread = _unread(one, {camera.color.name, camera.depth.name, *numbers})
        return Streams(
            color.stream,
            depth.stream,
            state=state,
            action=action,
            known=(*known_calibration(one, camera), *depth.known, *_told(one, numbers)),
            registered=is_registered(camera),
            poses=_poses(one, numbers, time_s, timing),
            checks=(*camera.checks, *depth.checks, *task_checks(one), _left_out(unread, given)),
            used=("meta", "data", "videos"),
            unread=unread,
        )


def _numbers(one: LeRobotEpisode, first: int, last: int) -> dict[str, np.ndarray]:
    """The columns of numbers that are used, of the rows of an episode."""
    own = [n for n in (TIME, POSES) if (f := one.info.features.get(n)) is not None and "meaning" in f.info]
    wanted = [STATE, ACTION, SUCCESS, *own, "timestamp", "frame_index"]
    lacking = [n for n in (STATE, ACTION) if n in one.info.features and n not in ask(one.data, "names")]
    if lacking:
        raise DataError(f"{one.data}: has no column {lacking[0]}, which meta/info.json says there is")
    found: dict[str, np.ndarray] = ask(one.data, "columns", wanted, first, last - first)
    for name, values in found.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            row = int(np.argwhere(~np.isfinite(values))[0][0])
            raise DataError(f"{one.data}: {name} holds a value that is not finite in step {row} of {one.where.name}")
    return found


def _stamps(one: LeRobotEpisode, numbers: dict[str, np.ndarray]) -> Float64[np.ndarray, "N"]:
    """Where every step is in the video of its episode: its number over the rate; ``timestamp`` must agree."""
    expected = np.arange(one.length) / one.info.fps
    for name, per_s in (("timestamp", 1.0), ("frame_index", one.info.fps)):
        said = numbers.get(name)
        if said is None:
            continue
        off = np.abs(said.reshape(-1).astype(np.float64) / per_s - expected) if said.size == one.length else expected
        if said.size != one.length or off.max() > NEAREST / one.info.fps:
            k = int(np.argmax(off > NEAREST / one.info.fps)) if said.size == one.length else 0
            found = shown(said.reshape(-1)[k].item())
            raise DataError(f"{one.data}: {name} is {found} in step {k} of {one.where.name}, and at "
                            f"{one.info.fps:g} pictures a second it would be {expected[k] * per_s:.6g}")  # fmt: skip
    return expected


def _stream(
    one: LeRobotEpisode, name: str, numbers: dict[str, np.ndarray], time_s: np.ndarray, timing: Timing
) -> tuple[SampleStream, ...]:
    """The robot's numbers; nothing where there are none."""
    values, feature = numbers.get(name), one.info.features.get(name)
    if values is None or feature is None:
        return ()
    rows = to_float32(values.reshape(len(values), -1))
    width = int(np.prod(feature.shape or (1,)))
    if rows.shape[1] != width or not 0 < width <= MAX_WIDTH:
        raise DataError(f"{one.data}: {name} has {rows.shape[1]} numbers a step, and meta/info.json gives it the shape "
                        f"{list(feature.shape)}; expected 1 to {MAX_WIDTH:,}, as many in both")  # fmt: skip
    return (SampleStream(name, time_s, rows, timing, columns=feature.names),)


def _poses(
    one: LeRobotEpisode, numbers: dict[str, np.ndarray], time_s: np.ndarray, timing: Timing
) -> SampleStream | None:
    """Where a camera was that moves."""
    if POSES not in numbers:
        return None
    T = numbers[POSES].astype(np.float64)
    if T.size != 16 * len(time_s):
        raise DataError(f"{one.data}: {POSES} has the shape {T.shape}, expected a pose (4, 4) for each step")
    return pose_stream(POSES, time_s, check_poses(f"{one.data}: {POSES}", T.reshape(-1, 4, 4)), timing)


def _told(one: LeRobotEpisode, numbers: dict[str, np.ndarray]) -> Iterator[tuple[str, Metadata]]:
    """Rate, task and success, as far as the dataset tells."""
    known: dict[str, Any] = {} if TIME in numbers else {"fps": one.info.fps}
    yield one.info.place.name, Metadata(**known)
    if tasks := tasks_of(one):
        yield "meta/tasks", Metadata(task=tasks[0])
    success = one.said.get("success")
    if success is not None:
        yield "success of meta/episodes", Metadata(success=_truth(f"{one.where}: success of meta/episodes", success))
    elif SUCCESS in numbers:
        place = f"{one.data}: {SUCCESS}"
        yield SUCCESS, Metadata(success=any(_truth(place, x) for x in np.unique(numbers[SUCCESS]).tolist()))


def _truth(where: str, value: Any) -> bool:
    """A value as true or false. Raises :class:`DataError` where it is neither: a number between may mean anything."""
    if not isinstance(value, bool | int | float) or value not in (0, 1):
        raise DataError(f"{where} is {shown(value)}, expected true or false, or 1 or 0")
    return bool(value)


def _unread(one: LeRobotEpisode, used: Collection[str]) -> tuple[str, ...]:
    """Features that nothing uses."""
    return tuple(shown(name)[1:-1] for name in one.info.features if name not in used and name not in _COUNTS)


def _left_out(unread: Sequence[str], given: Metadata) -> Check:
    """What is not used, but for what the user says is not to be used."""
    told = [name for name in unread if why_harmless(name.replace(".", "_"), None) is None]
    asked = [name for name in told if not is_ignored(name, given.ignore)]
    if not asked:
        rest = f"all but {some_of(unread)}, which count what was achieved" if unread else "every feature"
        return Check("left out", Verdict.OK, "all else, as 'ignore' says" if told else f"{rest} is used")
    return Check("left out", Verdict.ASSUMED, f"not used: {some_of(asked)}; 'ignore: [...]' says that this is right")
