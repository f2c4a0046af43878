"""The gripper's shape, gathered in its own frame from demonstrations, and found again in other clouds."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from flowlab.actions.robot import GripperPath
from flowlab.geometry.sampling import farthest_points

_REACH_M = 0.15
"""What is farther from the gripper's position is no part of its shape."""
_CELL_M = 0.012
"""Cells in which its surface is gathered."""
_SEEN_SHARE = 0.35
"""A cell is the gripper's where it is filled at so many of the places where the gripper was, compared with the fullest
cells, in every third of the demonstrations: the rest of the scene moves past a gripper that moves, and what it holds it
does not hold from beginning to end."""
_PHASES, _FEWEST = 3, 4
"""A third with fewer places tells nothing."""
_PLACES, _APART_M = 40, 0.015
"""Places of each third that are looked at: so many, at least so far apart, for where a demonstration dwells the scene
stands still."""
_NEIGHBORS = 32
"""Points that a normal is fitted to."""
_NEAR_M = (0.03, 0.02, 0.012, 0.008, 0.006, 0.006, 0.006, 0.006)
"""Points farther from the shape than this are left out, round by round."""
_STARTS = 24
"""First guesses: so many places where the gripper was in demonstrations, and so many points of the cloud."""
_LOST = 0.6
"""Where less than this share of what is usual fits, the gripper is looked for everywhere."""
_LEAST = 10
"""Points that a pose is fitted to."""


@dataclass(frozen=True, slots=True)
class GripperShape:
    """Points of the gripper's surface in its frame, and where it was when they were gathered."""

    xyz: Float[np.ndarray, "S 3"]
    """[m]"""
    normal: Float[np.ndarray, "S 3"]
    tree: cKDTree
    starts: GripperPath
    """Poses to begin with."""
    cells: int
    """How many cells it fills: of the same points, fewer are a sharper shape."""
    usual: float = 1.0
    """Points that lie on it where its pose is known."""


@dataclass(frozen=True, slots=True)
class FoundGripper:
    """Where the gripper was found in every frame, by its cloud alone."""

    path: GripperPath
    fit: Float[np.ndarray, "T"]
    """1 where as much fits as is usual; below 0.6 it is not it."""


def gather_shape(
    clouds: Sequence[Float[np.ndarray, "N 3"]], path: GripperPath, progress: Float[np.ndarray, "F"]
) -> GripperShape | None:
    """The shape that recurs around the gripper in many frames.

    Args:
        clouds: One of every frame [m].
        path: The gripper's pose in each.
        progress: How far each is through its demonstration, from 0 to 1.

    Returns:
        The shape; None where nothing recurs, as where the clouds do not show the gripper.
    """
    phase = np.minimum((progress * _PHASES).astype(int), _PHASES - 1)
    phases = [_places(path, np.flatnonzero(phase == n)) for n in range(_PHASES)]
    places = [k for frames in phases for k in frames]
    local = [path.to_gripper(np.asarray(clouds[k], float), k) for k in places]
    local = [x[np.linalg.norm(x, axis=1) < _REACH_M] for x in local]
    filled = dict(zip(places, ({tuple(c) for c in _cells(x).tolist()} for x in local), strict=True))
    often = _common([_often([filled[k] for k in frames]) for frames in phases if len(frames) >= _FEWEST])
    if not often:
        return None
    points = np.concatenate(local)
    points = points[[tuple(k) in often for k in _cells(points).tolist()]]
    if len(points) < _NEIGHBORS:
        return None
    tree = cKDTree(points)
    near = points[tree.query(points, k=_NEIGHBORS)[1]]
    near -= near.mean(1, keepdims=True)
    normal = np.linalg.eigh(np.swapaxes(near, 1, 2) @ near)[1][:, :, 0]
    chosen = farthest_points(path.position.astype(np.float32), min(_STARTS, len(path)))
    shape = GripperShape(points, normal, tree, path.rows(chosen), len(often))
    used = [_lay(shape, clouds[k], path.rows(np.array([k])))[1] for k in places]
    return GripperShape(points, normal, tree, shape.starts, len(often), max(float(np.median(used)), 1.0))


def _often(filled: Sequence[set[tuple[int, ...]]]) -> set[tuple[int, ...]]:
    """The cells that are filled nearly as often as the fullest ones."""
    count = Counter(cell for cells in filled for cell in cells)
    if not count:
        return set()
    least = max(2.0, _SEEN_SHARE * float(np.quantile(list(count.values()), 0.98)))
    return {cell for cell, n in count.items() if n >= least}


def _common(parts: Sequence[set[tuple[int, ...]]]) -> set[tuple[int, ...]]:
    return set.intersection(*parts) if parts else set()


def _places(path: GripperPath, frames: Int[np.ndarray, "n"]) -> list[int]:
    """Those of some frames in which the gripper was at different places."""
    if not len(frames):
        return []
    order = farthest_points(path.position[frames].astype(np.float32), min(_PLACES, len(frames)))
    chosen: list[int] = []
    for k in frames[order].tolist():
        if all(np.linalg.norm(path.position[k] - path.position[j]) > _APART_M for j in chosen):
            chosen.append(k)
    return chosen


def _cells(xyz: np.ndarray) -> np.ndarray:
    return np.round(xyz / _CELL_M).astype(int)


def find_gripper(shape: GripperShape, clouds: Sequence[Float[np.ndarray, "N 3"]]) -> FoundGripper:
    """Where the gripper is in every cloud: followed from frame to frame, and looked for where it is lost.

    Args:
        shape: What it looks like.
        clouds: One of every frame, in their order [m].
    """
    poses: list[GripperPath] = []
    fits: list[float] = []
    for cloud in clouds:
        pose, fit = (poses[-1], 0.0) if poses else (shape.starts.rows(np.array([0])), 0.0)
        if poses:
            pose, fit = _lay_once(shape, cloud, pose)
        if fit < _LOST:
            tried = [_lay_once(shape, cloud, start) for start in _guesses(shape, cloud)]
            pose, fit = max([*tried, (pose, fit)], key=lambda found: found[1])
        poses.append(pose)
        fits.append(fit)
    return FoundGripper(GripperPath.join(poses), np.array(fits))


def _guesses(shape: GripperShape, cloud: np.ndarray) -> list[GripperPath]:
    """Poses of demonstrations, and the same rotations at places of the cloud."""
    known = [shape.starts.rows(np.array([k])) for k in range(len(shape.starts))]
    places = cloud[farthest_points(cloud.astype(np.float32), min(_STARTS, len(cloud)))].astype(float)
    nearest = np.asarray(cKDTree(shape.starts.position).query(places)[1])
    return known + [known[k].moved_to(place[None]) for k, place in zip(nearest, places, strict=True)]


def _lay_once(shape: GripperShape, cloud: np.ndarray, start: GripperPath) -> tuple[GripperPath, float]:
    pose, used, share = _lay(shape, cloud, start)
    return pose, min(1.0, used / shape.usual) * min(1.0, share * 1.5)


def _lay(shape: GripperShape, cloud: np.ndarray, pose: GripperPath) -> tuple[GripperPath, float, float]:
    """A pose brought to where the shape lies on a cloud (point to plane, Chen and Medioni 1992); how many points lie on
    it then, and which share that is of those within reach."""
    position, R = pose.position[0].copy(), None if pose.R is None else pose.R[0].copy()
    near = cloud[np.linalg.norm(cloud - position, axis=1) < _REACH_M + 2 * _NEAR_M[0]].astype(float)
    used = np.zeros(len(near), bool)
    for limit in _NEAR_M:
        x = near - position if R is None else (near - position) @ R
        distance, index = map(np.asarray, shape.tree.query(x, distance_upper_bound=limit))
        used = np.isfinite(distance)
        if used.sum() < _LEAST:
            return pose, 0.0, 0.0
        n, a = shape.normal[index[used]], x[used]
        off = (n * (shape.xyz[index[used]] - a)).sum(1)
        J = n if R is None else np.concatenate([n, np.cross(a, n) / _REACH_M], 1)
        step = -np.linalg.solve(J.T @ J + 1e-3 * len(J) * np.eye(J.shape[1]), J.T @ off)
        position = position + (step[:3] if R is None else R @ step[:3])
        if R is not None:
            R = R @ Rotation.from_rotvec(step[3:] / _REACH_M).as_matrix()
    within = np.linalg.norm(near - position, axis=1) < _REACH_M
    return (
        GripperPath(position[None], None if R is None else R[None]),
        float(used.sum()),
        float(used.sum() / max(within.sum(), 1)),
    )
