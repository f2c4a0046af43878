"""Whether films and labeled demonstrations fit each other."""

import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from flowlab.actions.robot import RobotLayout, Stated, layout_of
from flowlab.actions.sight import sharpest
from flowlab.data.channels import infer_channels
from flowlab.data.replay_buffer import load_buffer
from flowlab.data.source import source_of
from flowlab.errors import DataError
from flowlab.geometry.camera import Camera
from flowlab.provenance import Channels
from flowlab.records import Episode
from flowlab.storage.dataset import Dataset
from flowlab.storage.manifest import differences
from flowlab.text import counted, cut

_LEAST_DEMONSTRATIONS = 2


def fitting_problem(films: Dataset, labeled: Dataset) -> str:
    """What keeps films from being labeled by demonstrations, in one sentence; empty where nothing does."""
    if not len(films):
        return f"{films.path}: holds no films yet; run the command that makes the dataset again"
    theirs, mine = films.row_format, labeled.row_format
    if theirs is not None and theirs.action:
        return (
            f"{films.path}: its episodes have actions already, {theirs.action} numbers each; nothing is to be labeled"
        )
    if mine is None or not mine.action or not mine.state:
        lacks = "episodes" if mine is None else "actions" if not mine.action else "state"
        return f"{labeled.path}: has no {lacks}, and --from must be demonstrations with state and actions"
    if labeled.provenance.inferred is not None:
        return f"{labeled.path}: its actions were inferred themselves; give the demonstrations that taught them"
    if theirs is not None and theirs.state not in (0, mine.state):
        return (
            f"{films.path}: a state has {theirs.state} numbers, and {mine.state} in {labeled.path}; make the films "
            "without state, or with the same numbers"
        )
    count, wanted = Counter(ref.task for ref in labeled.refs), sorted({ref.task for ref in films.refs})
    for task in wanted:
        if count[task] < _LEAST_DEMONSTRATIONS:
            there = cut(", ".join(f"{n} of '{t}'" for t, n in sorted(count.items())))
            return (
                f"{labeled.path}: has {counted(count[task], 'demonstration')} of '{task}', of which "
                f"there are films; at least "
                f"{_LEAST_DEMONSTRATIONS} are needed, since how far off inferred actions are is measured on one that "
                f"is left out; it has {there}"
            )
    return _frame_problem(films, labeled, with_state=bool(theirs and theirs.state))


def _frame_problem(films: Dataset, labeled: Dataset, *, with_state: bool) -> str:
    """In what the clouds, or what numbers mean, differ."""
    compared = ["kind", "world_frame", "camera", "observer", *(["state"] if with_state else [])]
    found = [d.provenance.model_dump(mode="json") for d in (films, labeled)]
    old, new = ({k: values[k] for k in compared} for values in found)
    lines = [*differences(new, old, owners=("it", "the dataset of films"))]
    if not lines:
        return ""
    more = f", and {len(lines) - 1} more" if len(lines) > 1 else ""
    return (
        f"{labeled.path}: was not made as the films of {films.path} were ({cut(lines[0], 240)}{more}); make both with "
        "the same camera, frame and settings"
    )


def labeled_layout(labeled: Dataset) -> Callable[[Sequence[Episode]], RobotLayout]:
    """What the numbers of labeled demonstrations are, once some of them are given.

    Raises:
        DataError: They do not tell where the gripper is.
    """
    with tempfile.TemporaryDirectory() as place:
        source = source_of(labeled)
        buffer = load_buffer(source, Path(place))
        channels = infer_channels(source, buffer)
        about = source.provenance
        stated = Stated(_rotation(about.state), _rotation(about.action))
        layout = layout_of(channels, np.asarray(buffer.state), np.asarray(buffer.action), stated=stated)
    if layout is None:
        raise DataError(
            f"{labeled.path}: does not tell where the gripper is in the frame of its clouds: the provenance must name "
            "a position of the state in the frame 'world', or tracks must move with the state's first three numbers"
        )
    return lambda demos: sharpest(demos, layout)


def _rotation(channels: tuple[Channels, ...] | None) -> tuple[int, ...] | None:
    """The numbers that are said to be a rotation; empty where all is said and none is, None where nothing is said."""
    if channels is None:
        return None
    return next((c.index for c in channels if c.kind == "rotation"), ())


def misfit_of_camera(camera: Camera, known: Sequence[Camera], far_m: float) -> str:
    """Why clouds of a camera are not like those of others; empty where they are."""
    apart = []
    for other in known:
        T, U = (np.asarray(c.T_world_cam, float) for c in (camera, other))
        angle = float(np.arccos(np.clip((np.trace(T[:3, :3].T @ U[:3, :3]) - 1) / 2, -1, 1)))
        apart.append((float(np.linalg.norm(T[:3, 3] - U[:3, 3])), angle))
    distance, angle = min(apart, key=lambda x: x[0] + 2 * far_m * x[1])
    if distance <= far_m and angle <= 2 * far_m:
        return ""
    return (
        f"its camera is {distance * 100:.1f} cm and {np.degrees(angle):.1f} degrees away from the nearest of the "
        f"demonstrations, at most {far_m * 100:g} cm and {np.degrees(2 * far_m):.1f} degrees are asked for (camera_m); "
        "it shows other sides of the gripper"
    )
