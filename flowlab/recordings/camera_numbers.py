"""Numbers that nothing uses and that may be a camera's, by shape and name: poses, intrinsics, distortion, a unit."""

import re

import numpy as np
from jaxtyping import Num

from flowlab.recordings.intrinsics import focal_lengths
from flowlab.recordings.recording_yaml import FILE_NAME, Metadata
from flowlab.recordings.unused_files import robot_numbers
from flowlab.text import cut

_POSES = re.compile(
    r"pose|trajectory|extrin|c2w|w2c|cam(era)?_?(to|2)_?(world|base|robot)|(world|base|robot)_?(to|2)_?cam|"
    r"(^|_)t_\w*cam|(^|_)t_?(wc|cw)($|_)|transforms|ground_?truth"
)
_MATRIX = re.compile(r"intrin|cam(era)?_?(k|mat)|^k($|_)")
_LENS = re.compile(r"dist(ort|_?coef|$|_)|(^|_)dist($|_)")
_UNIT = re.compile(r"depth_?(scale|unit|factor)|unit_?m")
_ROTATION = 1e-3
"""What is this far from a rotation is none."""
_SAME = 0.01
"""What differs from what is used by this share is the same."""


def called_poses(name: str) -> bool:
    """Whether something is called as poses of a camera are, and not as those of a robot's tool."""
    return _POSES.search(name.lower()) is not None and not _of_robot(name)


def camera_numbers(name: str, values: Num[np.ndarray, "..."], known: Metadata, posed: bool) -> str | None:
    """What is said of numbers that may be a camera's; None where they are not, or say what is used.

    Args:
        name: What they are called, without the ending of a file.
        values: The numbers.
        known: What is used.
        posed: Whether poses of a moving camera are used.
    """
    if values.dtype.kind not in "iuf" or not values.size or not np.isfinite(values).all():
        return None
    for says in (_lens(name, values, known), _unit(name, values, known), _intrinsics(name, values, known)):
        if says is not None:
            return says
    return None if posed or _of_robot(name) else _poses(name, values, known)


def _of_robot(name: str) -> bool:
    return any(robot_numbers(name, what) for what in ("state", "action"))


def _poses(name: str, values: np.ndarray, known: Metadata) -> str | None:
    """What is said of rigid transforms."""
    T = _rigid(values, called_poses(name))
    if T is None:
        return None
    if len(T) > 1 and not np.allclose(T, T[:1], rtol=0, atol=1e-6):
        return (f"it has {len(T)} rigid transforms that change; if they are the poses of a camera that moves, each "
                f"camera to world, write 'T_world_cam_file' into {FILE_NAME}")  # fmt: skip
    used = np.eye(4) if known.T_world_cam is None else np.array(known.T_world_cam)
    if np.allclose(T[0], used, rtol=0, atol=1e-3) or np.allclose(T[0], np.eye(4), rtol=0, atol=1e-6):
        return None
    other = "" if known.T_world_cam is None else ", which is not the T_world_cam that is used"
    return (f"it has a rigid transform{other}; if it is the pose of the camera, camera to world, write it as "
            f"'T_world_cam' into {FILE_NAME}")  # fmt: skip


def _rigid(values: np.ndarray, called: bool) -> np.ndarray | None:
    """Rigid transforms (N, 4, 4); also as rows of 16 or 12 numbers where they are called so."""
    shape = values.shape
    if called and len(shape) <= 2 and shape[-1] in (12, 16):
        values = values.reshape(-1, shape[-1] // 4, 4)
    if values.ndim not in (2, 3) or values.shape[-2:] not in ((4, 4), (3, 4)):
        return None
    T = np.tile(np.eye(4), (values.size // (values.shape[-1] * values.shape[-2]), 1, 1))
    T[:, : values.shape[-2]] = values.reshape(-1, *values.shape[-2:])
    R = T[:, :3, :3]
    off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max()
    return T if off < _ROTATION and np.allclose(T[:, 3], (0, 0, 0, 1)) else None


def _intrinsics(name: str, values: np.ndarray, known: Metadata) -> str | None:
    """What is said of camera matrices."""
    if values.ndim not in (2, 3) or values.shape[-2:] != (3, 3):
        return None
    every = values.reshape(-1, 3, 3).astype(np.float64)
    try:
        f = [focal_lengths(K) for K in (every[0], every[-1])]
    except ValueError:
        return "it is called as a camera's matrix and is none" if _MATRIX.search(name.lower()) else None
    at = np.array([[x["fx"], x["fy"], x["cx"], x["cy"]] for x in f])
    if (at[:, :2] <= 1).any() and (at[:, 2:] == 0).all():  # a rotation about the axis, or a scale
        return None
    if np.abs(every - every[0]).max() > _SAME * at[0, 0]:
        return ("it has camera matrices that change from step to step, and one camera is expected; cut the recording "
                f"where they change, with 'intrinsics' in {FILE_NAME}")  # fmt: skip
    mine = known.intrinsics
    if mine is None or np.abs(at[0] - [mine.fx, mine.fy, mine.cx, mine.cy]).max() > _SAME * max(at[0, 0], mine.fx):
        return (f"it has a camera matrix with fx {at[0, 0]:.5g}, cx {at[0, 2]:.5g}, cy {at[0, 3]:.5g}, which is not "
                f"the one that is used; if it is the color camera's, write it as "
                f"'intrinsics' into {FILE_NAME}")  # fmt: skip
    return None


def _lens(name: str, values: np.ndarray, known: Metadata) -> str | None:
    """What is said of coefficients of distortion."""
    if not _LENS.search(name.lower()) or values.size > 14 or not values.any():
        return None
    mine = () if known.intrinsics is None else known.intrinsics.distortion
    if len(mine) == values.size and np.allclose(mine, values.ravel(), atol=1e-6):
        return None
    some = cut(", ".join(f"{x:.4g}" for x in values.ravel().tolist()))
    return f"if it is the distortion of the color camera, write 'distortion: [{some}]' in 'intrinsics' in {FILE_NAME}"


def _unit(name: str, values: np.ndarray, known: Metadata) -> str | None:
    """What is said of a unit of depth, in meters a count or counts a meter."""
    if not _UNIT.search(name.lower()) or values.size != 1 or values.item() <= 0:
        return None
    unit = values.item() if values.item() <= 1 else 1 / values.item()
    if known.depth_unit_m is not None and abs(unit / known.depth_unit_m - 1) < _SAME:
        return None
    return (
        f"it says {unit:g} m a count, which is not used; if that is the unit of depth, write 'depth_unit_m: {unit:g}'"
    )
