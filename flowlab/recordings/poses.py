"""Poses of a camera that moves: read from files, and known at every picture."""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float64

from flowlab.array_files import load_array
from flowlab.errors import DataError
from flowlab.geometry.camera import pose_fault
from flowlab.geometry.transforms import rigid
from flowlab.recordings.base import ImageStream, SampleStream
from flowlab.recordings.columns import base_and_unit
from flowlab.recordings.sample_files import check_times, load_times
from flowlab.recordings.stamps import Timing
from flowlab.recordings.sync import GAP, sampling_rate
from flowlab.recordings.tables import SampleTable, plain_name, read_table
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import cut

ABOUT = "poses"
"""What checks of them are about."""
AT_ONCE_S = 1e-3
"""A pose that was measured this near to a picture [s] is that of the picture."""
_FARTHEST_M = 1e4
_UNIT_TOLERANCE = 0.02
"""So much may the length of a quaternion differ from 1."""
_NAMES = {
    "tx": "tx", "ty": "ty", "tz": "tz", "x": "tx", "y": "ty", "z": "tz", "px": "tx", "py": "ty", "pz": "tz",
    "positionx": "tx", "positiony": "ty", "positionz": "tz", "translationx": "tx", "translationy": "ty",
    "translationz": "tz", "qx": "qx", "qy": "qy", "qz": "qz", "qw": "qw", "orientationx": "qx", "orientationy": "qy",
    "orientationz": "qz", "orientationw": "qw", "rotationx": "qx", "rotationy": "qy", "rotationz": "qz",
    "rotationw": "qw",
}  # fmt: skip
"""What columns are called, by their letters and digits."""
_WORDS = re.compile(
    r"(p|pos|position|t|trans|translation|q|quat|quaternion|rot|rotation|orientation)[\W_](?:.*[\W_])?([wxyz])"
)
"""Names of columns with frames between the quantity and the axis, as ``p_RS_R_x [m]``."""
_PARTS = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")
LAYOUTS = (
    "an array (N, 4, 4); or rows of 'timestamp tx ty tz qx qy qz qw' as in TUM's ground truth, of 16 or 12 numbers "
    "(the matrix row by row, with or without its last row), or of 17 or 13 with a timestamp before them"
)


def pose_stream(
    source: str, time_s: Float64[np.ndarray, "N"], T: Float64[np.ndarray, "N 4 4"], timing: Timing
) -> SampleStream:
    """Poses as a stream with the name of their source, whose rows are the matrices row by row."""
    return SampleStream(source, time_s, T.reshape(-1, 16), timing)


def matrices(poses: SampleStream) -> Float64[np.ndarray, "N 4 4"]:
    """The poses of a stream."""
    return np.asarray(poses.values, np.float64).reshape(-1, 4, 4)


def load_poses(path: Path, times: Path | None, color: ImageStream) -> SampleStream:
    """The poses of a file: with times of their own, in it or in another file, else one for each color picture.

    Args:
        path: An array (N, 4, 4), or a table.
        times: A file with the time of each.
        color: The color pictures.

    Raises:
        DataError: The file holds no poses, or another number of them than there are times or pictures.
    """
    own, T = read_poses(path)
    if times is not None and own is not None:
        raise DataError(f"{path}: has times of its own; leave out 'T_world_cam_times'")
    stamps, timing = load_times(times) if times is not None else own or (color.time_s, color.timing)
    if len(stamps) != len(T):
        of = f"color pictures; name a file with the time of each in 'T_world_cam_times', or write {LAYOUTS}"
        raise DataError(f"{path}: has {len(T)} poses for {len(stamps)} {of if times is None else 'times'}")
    return pose_stream(path.name, stamps, T, timing)


def read_poses(path: Path) -> tuple[tuple[Float64[np.ndarray, "N"], Timing] | None, Float64[np.ndarray, "N 4 4"]]:
    """The poses of a file and their times, where it has these. Raises :class:`DataError` where it holds none."""
    if path.suffix.lower() == ".npy" and (values := load_array(path)).ndim == 3:
        return None, check_poses(str(path), values)
    table = read_table(path)
    time, values = _columns(table)
    T = check_poses(str(path), values)
    if time is None:
        return None, T
    unit = base_and_unit(table.names[0])[1] if table.names else None
    own = table.values[:, time] * (unit or 1.0)
    return check_times(path, own, not (own % 1).any(), unit is not None), T


def _columns(table: SampleTable) -> tuple[int | None, np.ndarray]:
    """Which column is the time, and the numbers of the poses."""
    parts = [_part(name) for name in table.names]
    named = {part: k for k, part in enumerate(parts)}
    width = table.values.shape[1]
    if all(parts.count(part) == 1 for part in _PARTS):
        rest = [k for k in range(width) if k not in [named[p] for p in _PARTS]]
        return (rest[0] if rest else None), table.values[:, [named[p] for p in _PARTS]]
    if width == 4 and len(table.values) % 4 == 0:
        return None, table.values.reshape(-1, 16)
    if width in (12, 16):
        return None, table.values
    if width in (13, 17) or (width == 8 and not table.names):
        return 0, table.values[:, 1:]
    have = ""
    if table.names:
        odd = [name for name, part in zip(table.names, parts, strict=True) if part is None]
        have = f" ({cut(', '.join(table.names))}), of which {cut(', '.join(odd)) or 'none'} is not known"
    how = f"{LAYOUTS}; columns with names are called {', '.join(_PARTS)}, in meters"
    raise DataError(f"{table.path}: has {width} numbers a line{have}, expected poses: {how}")


def _part(name: str) -> str | None:
    """Which number of a pose a column is by its name, in meters; None where that is not known."""
    found = re.fullmatch(r"(.*?)[\s_.]*(?:\[\s*m?\s*\])?\s*", name.strip().lower())
    base = plain_name(found[1]) if found else plain_name(name)
    base = base.removeprefix("field").removeprefix("pose")
    if base in _NAMES:
        return _NAMES[base]
    words = _WORDS.fullmatch(found[1] if found else "")
    return None if words is None else ("t" if words[1][0] in "pt" else "q") + words[2]


def check_poses(where: str, values: Float[np.ndarray, "N ..."]) -> Float64[np.ndarray, "N 4 4"]:
    """Rows of numbers as poses.

    Args:
        where: The file and what of it, for messages.
        values: (N, 4, 4), (N, 3, 4), or rows of 16, of 12, or of 7: position and quaternion, w last.

    Raises:
        DataError: They are of another shape, or one of them is no rigid transform.
    """
    if values.dtype.kind not in "iuf" or not len(values) or values.shape[1:] not in (
        (4, 4), (3, 4), (16,), (12,), (7,),
    ):  # fmt: skip
        raise DataError(f"{where}: is {cut(str(values.dtype))} {cut(str(values.shape))}, expected poses: {LAYOUTS}")
    values = values.astype(np.float64)
    finite = np.isfinite(values.reshape(len(values), -1)).all(1)
    if not finite.all():
        raise DataError(f"{where}: pose {int(np.argmin(finite)) + 1} holds what is no number; take such rows out")
    if values.shape[1:] == (7,):
        length = np.linalg.norm(values[:, 3:], axis=1)
        if (wrong := np.abs(length - 1) > _UNIT_TOLERANCE).any():
            k = int(np.argmax(wrong))
            raise DataError(f"{where}: the rotation of pose {k + 1} is no unit quaternion (its length is {length[k]:.3g}), "  # noqa: E501
                            "expected qx qy qz qw of length 1")  # fmt: skip
        T = rigid(rotations(values[:, 3:]), values[:, :3])
    else:
        T = np.tile(np.eye(4), (len(values), 1, 1))
        rows = 3 if values[0].size == 12 else 4
        T[:, :rows] = values.reshape(-1, rows, 4)
    for k, one in enumerate(T):
        fault = pose_fault(one) or ("" if np.abs(one).max() < _FARTHEST_M else "is too far away to be in meters")
        if fault:
            raise DataError(f"{where}: pose {k + 1} {fault}; each must be a rigid transform that maps coordinates of the "  # noqa: E501
                            "camera to the world's [m]")  # fmt: skip
    return T


def rotations(q: Float64[np.ndarray, "N 4"]) -> Float64[np.ndarray, "N 3 3"]:
    """Rotation matrices of quaternions, w last."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_quat(q).as_matrix())


def poses_at(
    poses: SampleStream, clock: Float64[np.ndarray, "F"], most_apart_s: float
) -> tuple[Float64[np.ndarray, "F 4 4"], Bool[np.ndarray, "F"]]:
    """The pose at every instant, between the two neighbors in time; and whether it is known there.

    Args:
        poses: In the order of time.
        clock: The instants [s].
        most_apart_s: Neighbors that are farther apart [s] tell nothing of what was between them.
    """
    from scipy.spatial.transform import Rotation, Slerp

    time_s, first = np.unique(poses.time_s, return_index=True)
    T = matrices(poses)[first]
    if len(time_s) == 1:
        return np.repeat(T, len(clock), axis=0), np.abs(clock - time_s[0]) <= AT_ONCE_S
    after = np.searchsorted(time_s, clock).clip(1, len(time_s) - 1)
    inside = clock.clip(time_s[0], time_s[-1])
    part = (inside - time_s[after - 1]) / (time_s[after] - time_s[after - 1])
    between = (time_s[after] - time_s[after - 1] <= most_apart_s) & (np.abs(inside - clock) <= AT_ONCE_S)
    at = np.minimum(np.abs(clock - time_s[after - 1]), np.abs(clock - time_s[after])) <= AT_ONCE_S
    t = T[after - 1, :3, 3] + part[:, None] * (T[after, :3, 3] - T[after - 1, :3, 3])
    return rigid(Slerp(time_s, Rotation.from_matrix(T[:, :3, :3]))(inside).as_matrix(), t), between | at


def most_apart_s(color: ImageStream, stated: float | None) -> float:
    """How far apart two poses may be for what is between them to be known [s]: as stated, else a frame's period, with
    its jitter."""
    rate = sampling_rate(color.time_s)
    return stated if stated is not None else GAP / rate if 0 < rate < np.inf else 0.0


def check_known(poses: SampleStream, known: Bool[np.ndarray, "F"], apart_s: float) -> Check:
    """In how many frames the pose is known, and by which poses."""
    says = (f"{len(poses.time_s)} from {poses.name}, {sampling_rate(poses.time_s):.3g} a second, tell where the "
            f"camera is in {known.sum()} of {len(known)} frames, "
            f"between poses at most {1000 * apart_s:.0f} ms apart")  # fmt: skip
    if known.all():
        return Check(ABOUT, Verdict.OK, says)
    says += "; the others are left out: 'T_world_cam_gap_s' says how far apart poses may be"
    return Check(ABOUT, Verdict.DOUBTFUL, says)
