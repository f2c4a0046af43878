"""How far a point could move without being seen to: a plain cylinder that turns about its axis looks as if it stood.

Slippage analysis (Gelfand and Guibas 2004): the motions of a surface along itself are the eigenvectors of small
eigenvalues of its normals' point-to-plane covariance. Each is tried on the pictures, since color may still tell.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8

from flowlab.tracking.trackers.rigid_bodies import _costs, _slipping
from flowlab.tracking.trackers.rigid_bodies.bodies import RigidBodyFit
from flowlab.tracking.trackers.rigid_bodies.patches import JUMP, Patch, patches_beside, resting_planes, surface_patches
from flowlab.tracking.trackers.rigid_bodies.rigid_motion import RigidMotion
from flowlab.tracking.trackers.rigid_bodies.sliding import STEPS, SlidingSurface

_ALIKE = ((6, 25), (8, 60))
"""Neighbors are of one surface that differ by no more in color and in lightness [counts]: shaded, and with edges."""
_MIN_CELLS, _MIN_INNER, _CELLS, _FRAMES = 6, 12, 200, 8
_MIDDLE, _DARK = 100, 50
"""Lightness [counts] that colors are compared at, and below which there is too little to tell them."""
_NOTICED, _NOTICED_OF_ALL, _CELLS_OF_ALL = 0.1, 0.03, 600
"""A cost this much higher is seen; of all that stands still, where only what is beside its edges costs more."""


def slippage(fit: RigidBodyFit, xyz_cam: Float64[np.ndarray, "M 3"]) -> Float64[np.ndarray, "M"]:
    """How far [m] points could move, each with the surface around it, while the clip looked the same but for noise.

    Points of what others stand on are taken to rest where the camera's motion is known: most of a scene could slide
    along itself, and does not. Where it is not, all that stands still may have slid before the camera as one.

    Args:
        fit: The motions, and which pixels are whose.
        xyz_cam: The points at the first frame [m].
    """
    far = np.zeros(len(xyz_cam))
    compare, resting = _Comparison.of(fit), resting_planes(fit)
    rest = [Patch.of(fit, np.argwhere(resting))] if resting.any() else []
    for color, lightness in _ALIKE:
        slides = [p for p in surface_patches(fit, resting, color, lightness) if len(p.cells) >= _MIN_CELLS]
        for k, points in patches_beside(fit, [*slides, *rest], xyz_cam):
            if k < len(slides):
                far[points] = np.maximum(far[points], compare.unnoticed(slides[k], xyz_cam[points]))
    still = np.argwhere(fit.assignment.best_motion == 0)
    if fit.pictures.still_is_fitted and len(still):
        moving = np.argwhere(fit.assignment.best_motion > 0)
        room = Patch.of(fit, still)
        for k, points in patches_beside(fit, [room, *([Patch.of(fit, moving)] if len(moving) else [])], xyz_cam):
            if k == 0:
                far[points] = np.maximum(far[points], compare.unnoticed(room, xyz_cam[points], whole=True))
    return far


@dataclass(frozen=True, slots=True)
class _Comparison:
    """Some frames of a clip."""

    fit: RigidBodyFit
    frames: Int64[np.ndarray, "F"]
    depth: Float32[np.ndarray, "F H W"]
    """[m]."""
    lit: tuple[UInt8[np.ndarray, "F H W 4"], UInt8[np.ndarray, "H W 4"]]
    """Features of them, and of the first: a room takes its lamps along when it moves before the camera."""
    unlit: tuple[UInt8[np.ndarray, "F H W 4"], UInt8[np.ndarray, "H W 4"]]
    """The same without lightness: shading does not turn with what is turned."""

    @classmethod
    def of(cls, fit: RigidBodyFit) -> "_Comparison":
        last = len(fit.pictures) - 1
        frames = np.unique(np.linspace(1, last, min(last, _FRAMES)).round().astype(int))
        feature = fit.pictures.feature
        lit = feature[frames], feature[0]
        return cls(fit, frames, fit.pictures.depth[frames], lit, (_unshaded(lit[0]), _unshaded(lit[1])))

    def unnoticed(
        self, surface: Patch, points: Float[np.ndarray, "m 3"], whole: bool = False
    ) -> Float64[np.ndarray, "m"]:
        """How far [m] motions along a surface take points of it, each counted by how little of it would be seen.

        ``whole``: it is all that stands still. What is seen where its colors meet tells, little as that may be, and it
        does not hide itself.
        """
        some = np.arange(len(surface.cells)) if whole else _inner(surface.cells, self.fit.grid.valid.shape)
        some = np.random.default_rng(0).permutation(some)[: _CELLS_OF_ALL if whole else _CELLS]
        xyz, pixels = surface.xyz_cam[some], surface.pixels[some].astype(np.float32)
        own = self.fit.motions[self.fit.assignment.best_motion[tuple(surface.cells[0])]]
        slips, own_R, own_t = _slips(self.fit, surface), own.R[self.frames], own.t[self.frames]
        R = np.concatenate([own_R[None], own_R @ slips.R[:, None]])
        t = np.concatenate([own_t[None], (own_R @ slips.t[:, None, :, None])[..., 0] + own_t])
        pictures, first = self.lit if whole else self.unlit
        features, K = _costs.features_at(first, pixels), self.fit.pictures.K
        rise = _slipping.cost_rise(xyz, features, R, t, self.depth, pictures, K, not whole)
        distance = np.linalg.norm(slips.apply(points) - points, axis=-1)
        hidden = np.exp(-((np.maximum(rise, 0) / (_NOTICED_OF_ALL if whole else _NOTICED)) ** 4)).reshape(-1, STEPS)
        on_the_way = np.cumprod(hidden, axis=1)  # what is seen half the way is seen
        return np.asarray((distance * on_the_way.reshape(-1, 1)).max(0))


def _unshaded(feature: UInt8[np.ndarray, "*frames H W 4"]) -> UInt8[np.ndarray, "*frames H W 4"]:
    """Without lightness, and colors as they were at a middle one: what is in the shade has less color, too."""
    bright = _MIDDLE / np.maximum(feature[..., 1:2].astype(np.float32), _DARK)
    color = 128 + (feature[..., 2:].astype(np.float32) - 128) * bright
    return np.concatenate(
        [feature[..., :1], np.zeros_like(feature[..., :1]), color.round().clip(0, 255).astype(np.uint8)], -1
    )


def _inner(cells: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Indices of the cells whose features show nothing of what is beside them, if enough are left; else of all."""
    mask = np.zeros(shape, np.uint8)
    mask[tuple(cells.T)] = 1
    inner = np.flatnonzero(cv2.erode(mask, np.ones((5, 5), np.uint8), borderValue=1)[tuple(cells.T)])
    return inner if len(inner) >= _MIN_INNER else np.arange(len(cells))


def _slips(fit: RigidBodyFit, surface: Patch) -> RigidMotion:
    """Motions, each a frame of one, that may take a surface along itself, this way and back, ever farther."""
    center = surface.xyz_cam.mean(0)
    radius = np.sqrt(((surface.xyz_cam - center) ** 2).sum(1).mean()) + 1e-6
    known = np.linalg.norm(surface.normals, axis=1) > 0.5
    along = _covariance(surface.xyz_cam[known], surface.normals[known], center, radius)
    contour = _covariance(*_contour(fit, surface), center, radius)
    twists = np.stack([*np.linalg.eigh(along)[1][:, :3].T, np.linalg.eigh(along + contour)[1][:, 0]])
    both_ways = np.stack([twists, -twists], 1).reshape(-1, 6)
    sliding = SlidingSurface.of(surface.xyz_cam, surface.normals)
    return sliding.slides(both_ways[:, :3] / radius, both_ways[:, 3:], center)


def _covariance(xyz: np.ndarray, normals: np.ndarray, center: np.ndarray, radius: float) -> np.ndarray:
    """Mean square (6, 6) of what a turn about the center, in radians times the radius, and a shift do along normals."""
    rows = np.concatenate([np.cross(xyz - center, normals) / radius, normals], 1)
    return np.asarray(rows.T @ rows / max(len(rows), 1))


def _contour(fit: RigidBodyFit, surface: Patch) -> tuple[np.ndarray, np.ndarray]:
    """Points (k, 3) of a surface's own border, and what each coordinate shifts them across it in the picture."""
    mask = np.zeros(fit.grid.valid.shape, np.float32)
    mask[tuple(surface.cells.T)] = 1
    own = _own_border(fit, surface.cells, mask)
    blurred, at = cv2.GaussianBlur(mask, (0, 0), 2.5), tuple(surface.cells[own].T)
    across = np.stack([cv2.Sobel(blurred, cv2.CV_32F, 1, 0)[at], cv2.Sobel(blurred, cv2.CV_32F, 0, 1)[at]], 1)
    across = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-6)
    K = fit.pictures.K
    ray = (surface.pixels[own] - K[:2, 2]) / [K[0, 0], K[1, 1]]
    return surface.xyz_cam[own], np.concatenate([across, -(across * ray).sum(1, keepdims=True)], 1)


def _own_border(fit: RigidBodyFit, cells: np.ndarray, mask: np.ndarray) -> Bool[np.ndarray, "n"]:
    """Which cells are at the border of their surface, but for where something nearer covers it, or the picture ends."""
    depth, last = fit.grid.depth, np.array(mask.shape) - 1
    z, own = depth[tuple(cells.T)], np.zeros(len(cells), bool)
    for step in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        beside = cells + step
        inside, at = ((beside >= 0) & (beside <= last)).all(1), tuple(np.clip(beside, 0, last).T)
        covered = (depth[at] > 0) & (depth[at] < z - JUMP * np.maximum(1, z))
        own |= inside & (mask[at] == 0) & ~covered
    return own
