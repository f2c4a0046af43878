"""Which motions of a robot could explain how things move: those that some of their steps suggest."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float64

from flowlab.recordings.pose_pairs import rotation_between
from flowlab.recordings.robot_motion import BALL_M, FEWEST, SeenMotion, SeenSteps, nearness_of, steps_off, tolerance_of

_TRIPLES, _KEPT, _MIDDLES = 10000, 100, 5
"""Triples of points that are tried, of which so many are looked at closer, and so many closest."""
_SCALES = (0.05, 20.0)
_SCALE_STEPS = 41
"""Scales that are tried, each 16 % above the one before."""


def search(seen: SeenSteps, *, scaled: bool) -> Iterator[SeenMotion]:
    """Motions that triples of points suggest, those with most points that go along first; of no scale or of any."""
    if len(seen) < 3 or len(np.unique(seen.pair)) < 3:
        return
    rng = np.random.default_rng(0)
    triples: np.ndarray = rng.integers(0, len(seen.pair), (_TRIPLES, 3))
    pairs = seen.pair[triples]
    triples = triples[(pairs[:, 0] != pairs[:, 1]) & (pairs[:, 1] != pairs[:, 2]) & (pairs[:, 0] != pairs[:, 2])]
    step, way = seen.step[triples], seen.way[seen.pair[triples]]
    scale = _scales(step, way) if scaled else np.ones((len(triples), 3))
    fine = np.isfinite(scale).all(1) & (scale > _SCALES[0]).all(1) & (scale < _SCALES[1]).all(1)
    fine &= _alike(step / scale[:, None], way, tolerance_of(seen)[triples])
    triples, step, way, scale = (x[fine] for x in (triples, step, way, scale))
    if not len(triples):
        return
    R = rotation_between(way, step / scale[:, None])
    off = np.linalg.norm(step / scale[:, None] - np.einsum("nij,nkj->nki", R, way), axis=-1)
    at = np.einsum("nij,nkj->nki", R, seen.at[seen.pair[triples]])
    middles = seen.start[triples] / scale[:, None] - at
    apart = np.linalg.norm(middles - middles.mean(1, keepdims=True), axis=-1).max(1)
    fine = (off < tolerance_of(seen)[triples]).all(1) & (apart < BALL_M)
    kept = np.flatnonzero(fine)[:_KEPT].tolist()
    found = [SeenMotion(R[k], float(scale[k, 0]), float(scale[k, 2])) for k in kept]
    counted = sorted(found, key=lambda m: -_count(seen, m))
    yield from counted[:_MIDDLES]


def _count(seen: SeenSteps, motion: SeenMotion) -> float:
    """Pairs in which some points go along, however far apart, by how near the second of them is."""
    near = nearness_of(seen, steps_off(seen, motion.matrix)[0])
    return float(np.minimum(np.bincount(seen.pair, near, minlength=len(seen)), FEWEST).sum())


def search_scales(seen: SeenSteps, R_cam_base: Float64[np.ndarray, "3 3"]) -> list[SeenMotion]:
    """Motions of a rotation that is known and any scale, those with most points that go along first."""
    scales = np.geomspace(*_SCALES, _SCALE_STEPS)
    found = [SeenMotion(R_cam_base, a, b) for a in scales.tolist() for b in scales.tolist() if 0.2 < a / b < 5]
    return sorted(found, key=lambda m: -_count(seen, m))[:_MIDDLES]


def _scales(step: np.ndarray, way: np.ndarray) -> np.ndarray:
    """What triples of steps (n, 3, 3) must be scaled by for lengths and angles of the ways; nan where that cannot be.

    A step (u, v, w) of a way x has ``(u u + v v) / across**2 + w w / along**2 = x x``, and likewise of any two.
    """
    one, other = np.triu_indices(3)
    flat = (step[:, one, :2] * step[:, other, :2]).sum(-1)
    deep, said = step[:, one, 2] * step[:, other, 2], (way[:, one] * way[:, other]).sum(-1)
    ff, fd, dd = (flat * flat).sum(1), (flat * deep).sum(1), (deep * deep).sum(1)
    fs, ds = (flat * said).sum(1), (deep * said).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        det = ff * dd - fd**2
        a, b = (dd * fs - fd * ds) / det, (ff * ds - fd * fs) / det
        across, along = 1 / np.sqrt(a), 1 / np.sqrt(b)
    return np.stack([across, across, along], -1)


def _alike(step: np.ndarray, way: np.ndarray, tolerance: np.ndarray) -> np.ndarray:
    """Whether steps are as long as ways, and as far from one another, as turning them alike leaves them."""
    fine = (np.abs(np.linalg.norm(step, axis=-1) - np.linalg.norm(way, axis=-1)) < tolerance).all(1)
    for one, other in ((0, 1), (1, 2), (0, 2)):
        apart = [np.linalg.norm(x[:, one] - x[:, other], axis=-1) for x in (step, way)]
        fine &= np.abs(apart[0] - apart[1]) < tolerance[:, one] + tolerance[:, other]
    return np.asarray(fine)
