"""Whether the pose of the camera can be what it is said to be: a table is level, and is seen from above."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from flowlab.errors import DataError
from flowlab.recordings.lens import undistorted_rays
from flowlab.recordings.pose_readings import READINGS
from flowlab.recordings.verdicts import Check, Verdict

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording

_FAR_M = (5.0, 20.0)
"""A camera this far from the world's origin is doubtful, and refused."""
_BASELINE_M = (0.3, 1.0)
"""Likewise, of how far the depth camera is from the color camera."""
_MOST_M = 1e3
"""Points beyond this are of wrong numbers."""
_PLANE_SHARE = 0.3
"""A plane that so many of the points lie on is one of the scene."""
_SURE_SHARE = 0.4
"""One with so many is surely one, and no fit to things in between."""
_LEVEL_DEG = 8.0
"""A table is level to within this."""
_TILTED_DEG = 20.0
"""A plane that is tilted by more against every axis of the world is neither a table nor a wall."""
_TRIES = 150
_UNITS = {"centimeters": 100.0, "millimeters": 1000.0}
_NEAR_M = (0.2, 5.0)
"""A camera is this far from the world's origin in the unit that is meant."""


@dataclass(frozen=True, slots=True)
class _Plane:
    """The plane that most points lie on, as the camera sees it."""

    normal: Float64[np.ndarray, "3"]
    """Towards the camera."""
    distance_m: float
    """Of the camera."""
    share: float
    """Of the points, those that lie on it."""


def check_world(source: "ParsedRecording") -> Iterator[Check]:
    """Where the camera stands and looks, and whether that agrees with a plane in the cloud."""
    T_color_depth = source.metadata.T_color_depth
    if T_color_depth is not None:
        yield from _baseline(float(np.linalg.norm(np.array(T_color_depth)[:3, 3])), source.write_to)
    poses, seen = source.streams.poses, source.frame_check.T_world_cam
    if source.metadata.T_world_cam is None and seen is None:
        says = "T_world_cam is not given, so the world is the camera's own frame: x right, y down, z forward"
        yield Check("world", Verdict.ASSUMED, says)
        return
    T = np.array(source.metadata.T_world_cam, float) if seen is None else seen[0]
    if np.allclose(T[:3, :3], np.eye(3), atol=1e-6):
        what = "T_world_cam" if seen is None else "the first pose"
        says = f"{what} turns nothing, so the world has the camera's axes: x right, y down, z forward"
        yield Check("world", Verdict.ASSUMED, says)
        return
    stands = f"{_stands(T)}, from {source.origin.get('T_world_cam', '') if poses is None else poses.name}"
    far = float(np.linalg.norm(T[:3, 3]))
    if far > _FAR_M[0] and poses is None:
        verdict = Verdict.REFUSED if far > _FAR_M[1] else Verdict.DOUBTFUL
        units = [unit for unit, n in _UNITS.items() if _NEAR_M[0] < far / n < _NEAR_M[1]]
        says = (f"{stands}: {far:.4g} m from the world's origin{', as if in ' if units else ''}{' or '.join(units)}; "
                f"write 'T_world_cam' in {source.write_to} in meters")  # fmt: skip
        yield Check("world", verdict, says)
        return
    plane = _dominant_plane(_cloud(source))
    judged = _judged(T, plane, stands, source.write_to)
    if poses is not None and judged.verdict is not Verdict.OK:  # the world of tracked cameras has any axes
        yield Check("world", Verdict.ASSUMED, f"at first {stands}; {_any_axes(T, plane)}")
        return
    yield judged


def _any_axes(T: np.ndarray, plane: _Plane | None) -> str:
    """How the world of a tracked camera lies, which may have any axes."""
    if plane is None:
        return "no plane in the cloud tells which way is up"
    if _tilt(T, plane) > 180 - _LEVEL_DEG:
        return (f"the plane with {plane.share:.0%} of the points is seen from below, so the world's z axis may point "
                "down")  # fmt: skip
    return (f"the plane with {plane.share:.0%} of the points is tilted by {_tilt(T, plane):.0f} degrees against the "
            "world's xy-plane, so it may be a wall, or the world has another up")  # fmt: skip


def _baseline(far: float, write_to: str) -> Iterator[Check]:
    if far > _BASELINE_M[0]:
        verdict = Verdict.REFUSED if far > _BASELINE_M[1] else Verdict.DOUBTFUL
        yield Check("T_color_depth", verdict, f"the depth camera is {far:.4g} m from the color camera; it must be "
                    "in meters, and map coordinates of the depth camera to the color camera; "
                    f"correct it in {write_to}")  # fmt: skip


def _stands(T: np.ndarray) -> str:
    """Where a camera is and looks, in words and numbers."""
    x, y, z = T[:3, 3]
    down = np.degrees(np.arcsin(np.clip(-T[2, 2], -1, 1)))
    tilt = f"{abs(down):.0f} degrees {'down' if down >= 0 else 'up'}"
    ahead = "" if abs(down) > 80 else f" towards ({T[0, 2]:.2f}, {T[1, 2]:.2f}, {T[2, 2]:.2f})"
    return f"the camera is at ({x:.3g}, {y:.3g}, {z:.3g}) m and looks {tilt}{ahead}"


def _judged(T: np.ndarray, plane: _Plane | None, stands: str, write_to: str) -> Check:
    """Whether the plane is a table that is seen from above, and whether it is one only by another reading of T."""
    if plane is None:
        return Check("world", Verdict.ASSUMED, f"{stands}; no plane in the cloud tells whether that is so")
    stands = f"{stands}; the plane with {plane.share:.0%} of the points, {plane.distance_m:.2f} m from the camera,"
    better = [(how, other) for how, read in READINGS.items() if _tilt(other := read(T), plane) < _LEVEL_DEG]
    if _tilt(T, plane) >= _LEVEL_DEG:
        return _tilted(T, plane, stands, [how for how, _ in better], write_to)
    height = T[2, 3] - plane.distance_m * float(T[2, :3] @ plane.normal)
    says = f"{stands} is level and seen from above, at the height {height:.2f} m"
    same = [how for how, other in better if not np.allclose(other, T, atol=0.02)]
    if same:
        return Check("world", Verdict.ASSUMED, f"{says}; it would be so as {same[0]}, too")
    return Check("world", Verdict.OK, says)


def _tilted(T: np.ndarray, plane: _Plane, stands: str, better: list[str], write_to: str) -> Check:
    """What is said of a plane that is no table as T says: a wall, or the pose is meant otherwise, or wrong."""
    tilt, axis, below = _tilt(T, plane), _off_axes(T, plane), _tilt(T, plane) > 180 - _LEVEL_DEG
    says = f"{stands} is tilted by {tilt:.0f} degrees against the world's xy-plane"
    if axis < _LEVEL_DEG and not below:
        return Check("world", Verdict.ASSUMED, f"{says}, so it may be a wall, or the world has another up")
    if below:
        says = f"{stands} is level, but seen from below, as if the world's z axis pointed down"
    sure = below or axis > _TILTED_DEG or tilt > 90
    if better:
        says += f", and seen from above if T_world_cam were {better[0]}"
    elif sure and plane.share >= _SURE_SHARE:
        says += _rolled(T, plane)
    else:
        return Check("world", Verdict.ASSUMED, f"{says}: look whether that is so")
    says += "; it must map coordinates of the camera (x right, y down, z forward) to the world's (z up): correct it in "
    return Check("world", Verdict.REFUSED if better and sure else Verdict.DOUBTFUL, f"{says}{write_to}")


def _rolled(T: np.ndarray, plane: _Plane) -> str:
    """Whether the plane would be level if the camera were turned about where it looks."""
    for angle in (180, 90, -90):
        c, s = round(np.cos(np.radians(angle))), round(np.sin(np.radians(angle)))
        turned = T @ np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        if _tilt(turned, plane) < _LEVEL_DEG:
            return f", and level if the camera were turned by {angle} degrees about where it looks"
    return ", so it is neither a table nor a wall"


def _tilt(T: np.ndarray, plane: _Plane) -> float:
    """Angle between the plane's normal and the world's z axis [degrees]; 180 for a ceiling."""
    return float(np.degrees(np.arccos(np.clip(T[2, :3] @ plane.normal, -1, 1))))


def _off_axes(T: np.ndarray, plane: _Plane) -> float:
    """Angle between the plane's normal and the nearest axis of the world [degrees]."""
    return float(np.degrees(np.arccos(np.clip(np.abs(T[:3, :3] @ plane.normal).max(), -1, 1))))


def _cloud(source: "ParsedRecording") -> Float64[np.ndarray, "N 3"]:
    """Points of one frame as the camera that took depth sees them [m]; none where cameras are not known."""
    known, sample = source.metadata, source.frame_check.samples[0]
    camera = known.depth_intrinsics or known.intrinsics
    if camera is None or known.depth_unit_m is None:
        return np.empty((0, 3))
    v, u = np.nonzero(np.isfinite(sample.depth) & (sample.depth > 0))
    z = sample.depth[v, u].astype(float) * known.depth_unit_m
    pixels = np.stack([u, v], -1) * sample.depth_factor + (sample.depth_factor - 1) // 2
    try:
        rays = undistorted_rays(camera.lens, camera.K, camera.distortion, pixels)
    except DataError:  # of a lens that is refused
        return np.empty((0, 3))
    cloud = np.concatenate([rays, np.ones((len(rays), 1))], 1) * z[:, None]
    T = known.T_color_depth
    return cloud if T is None or known.depth_intrinsics is None else cloud @ np.array(T)[:3, :3].T + np.array(T)[:3, 3]


def _dominant_plane(cloud: Float64[np.ndarray, "N 3"]) -> _Plane | None:
    """The plane with most points, by trying planes through three of them; None where none has enough."""
    cloud = cloud[(np.abs(cloud) < _MOST_M).all(1)]  # which what is not finite is not
    if len(cloud) < 200:
        return None
    rng = np.random.default_rng(0)
    some = cloud[rng.choice(len(cloud), min(len(cloud), 1500), replace=False)]
    corners = some[rng.integers(0, len(some), (_TRIES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 1e-9)
    offsets = np.einsum("ij,ij->i", normals, corners[:, 0])
    near = np.maximum(0.008, 0.008 * some[:, 2] ** 2)
    on = (np.abs(some @ normals.T - offsets) < near[:, None]) & (length[:, 0] > 1e-9)
    inside = some[on[:, on.sum(0).argmax()]]
    if len(inside) < _PLANE_SHARE * len(some):
        return None
    middle = inside.mean(0)
    normal = np.linalg.svd(inside - middle, full_matrices=False)[2][2]
    normal = normal if normal @ middle < 0 else -normal
    return _Plane(normal, float(-normal @ middle), len(inside) / len(some))
