"""The whole fit: from pictures to the few rigid motions that explain them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from flowlab.tracking.trackers.rigid_bodies.alignment import Body, follow
from flowlab.tracking.trackers.rigid_bodies.features import ClipFeatures
from flowlab.tracking.trackers.rigid_bodies.labels import Labels, label, needed, point_costs
from flowlab.tracking.trackers.rigid_bodies.motion import RigidMotion
from flowlab.tracking.trackers.rigid_bodies.seeds import Proposal, follow_seeds, propose
from flowlab.tracking.trackers.rigid_bodies.segments import STEP, Grid, divide

_MOST_BODIES = 20
_ROUNDS = 3
_LEAST_CELLS = 6
_MERGE_SLACK = 0.04


@dataclass(frozen=True, slots=True)
class Fit:
    """What explains a clip; motion k of the labels is body k - 1, and 0 is stillness."""

    pictures: ClipFeatures
    grid: Grid
    bodies: tuple[Body, ...]
    labels: Labels

    @property
    def motions(self) -> list[RigidMotion]:
        """Stillness, then the motion of every body."""
        return [RigidMotion.still(len(self.pictures)), *(b.motion for b in self.bodies)]


def fit(pictures: ClipFeatures, seed: int) -> Fit:
    """Find the rigid bodies of a clip, their motions and which pixels are theirs."""
    rng = np.random.default_rng(seed)
    grid = divide(pictures)
    pixels = grid.pixels(grid.valid & ~grid.still & ~grid.edge)
    proposals = propose(pictures, follow_seeds(pictures, pixels, rng), 10, rng)
    bodies = follow(pictures, [*_small_things(pictures, grid), *map(_from_proposal, proposals)], rng)
    for k in range(_ROUNDS):
        state = _prune(_labeled(pictures, grid, bodies))
        bodies = _refit(state, rng)
        if k < _ROUNDS - 1:
            labels = label(pictures, grid, bodies)
            unexplained = grid.moved & (labels.cost.min(0) > 0.42)
            room = max(_MOST_BODIES - len(bodies), 0)
            parts = [m for m in grid.components(unexplained) if m.sum() >= 7][: min(6, room)]
            bodies += follow(pictures, [_from_region(pictures, grid, m) for m in parts], rng)
    state = _prune(_labeled(pictures, grid, bodies))
    for _ in range(2):
        merged = _merge(state, rng)
        if merged is None:
            break
        state = merged
    return _prune(_labeled(pictures, grid, _refit(state, rng)))


def _from_proposal(proposal: Proposal) -> Body:
    return Body(proposal.pixels, proposal.motion, proposal.known)


def _from_region(pictures: ClipFeatures, grid: Grid, region: np.ndarray) -> Body:
    frames = len(pictures)
    return Body(_pixels_of(pictures, grid, region), RigidMotion.still(frames), np.zeros(frames, bool), region)


def _pixels_of(pictures: ClipFeatures, grid: Grid, region: np.ndarray) -> np.ndarray:
    """Pixels of a region of cells; without depth edges if enough remains, and all of them if it is small."""
    inner = region & ~grid.edge
    pixels = grid.pixels(inner if inner.sum() >= 10 else region)
    if len(pixels) >= 150:
        return pixels
    height, width = pictures.depth.shape[1:]
    within = np.array([(x, y) for x in range(STEP) for y in range(STEP)])
    near = np.minimum((pixels[:, None] + within).reshape(-1, 2), [width - 1, height - 1])
    z = np.repeat(pictures.depth[0, pixels[:, 1], pixels[:, 0]], len(within))
    d = pictures.depth[0, near[:, 1], near[:, 0]]
    return near[(d > 0) & (np.abs(d - z) < 0.02)]


def _small_things(pictures: ClipFeatures, grid: Grid) -> list[Body]:
    """Small connected things that moved are rigid bodies to begin with, with and without undecided cells around."""
    parts = [m for m in grid.components(grid.moved) if 7 <= m.sum() <= 900][:6]
    for whole in grid.components(grid.valid & ~grid.still)[:12]:
        moved = (whole & grid.moved).sum()
        if moved >= 7 and 1.25 * moved < whole.sum() <= 1200:
            parts.append(whole)
    return [_from_region(pictures, grid, m) for m in parts[:9]]


def _labeled(pictures: ClipFeatures, grid: Grid, bodies: Sequence[Body]) -> Fit:
    return Fit(pictures, grid, tuple(bodies), label(pictures, grid, bodies))


def _prune(state: Fit) -> Fit:
    kept = needed(state.labels)
    return replace(state, bodies=tuple(state.bodies[k - 1] for k in kept[1:]), labels=state.labels.keep(kept))


def _refit(state: Fit, rng: np.random.Generator) -> list[Body]:
    """Every body on the largest connected part of the cells it won; followed anew where they changed."""
    owner, kept, changed = state.labels.of_cell, [], []
    for k, body in enumerate(state.bodies):
        parts = state.grid.components(owner == k + 1)
        if not parts or parts[0].sum() < _LEAST_CELLS:
            continue
        region = parts[0]
        same = body.region is not None and (body.region & region).sum() >= 0.8 * (body.region | region).sum()
        if same:
            kept.append(replace(body, region=region))
        else:
            pixels = _pixels_of(state.pictures, state.grid, region)
            changed.append(Body(pixels, body.motion, np.ones(len(state.pictures), bool), region))
    return [*kept, *follow(state.pictures, changed, rng)]


def _merge(state: Fit, rng: np.random.Generator) -> Fit | None:
    """Neighboring bodies tried as one, and made one where that explains their pixels almost as well.

    Fewer, larger bodies have better conditioned poses. None if there is nothing to merge.
    """
    pictures, grid, owner = state.pictures, state.grid, state.labels.of_cell
    pairs = _neighbors(state, owner)[:10]
    trials = []
    for a, b in pairs:
        region = (owner == a) | (owner == b)
        larger = a if (owner == a).sum() >= (owner == b).sum() else b
        pixels = _pixels_of(pictures, grid, region)
        trials.append(Body(pixels, state.bodies[larger - 1].motion, np.ones(len(pictures), bool), region))
    merits = []
    trials = follow(pictures, trials, rng)
    for (a, b), trial in zip(pairs, trials, strict=True):
        region = (owner == a) | (owner == b)
        uv = grid.pixels(region)
        xyz = pictures.unproject(uv.astype(float), grid.depth[region].astype(float))
        motions = [state.bodies[a - 1].motion, state.bodies[b - 1].motion, trial.motion]
        cost = point_costs(pictures, motions, uv, xyz, price=0)
        merits.append(float((np.where(owner[region] == a, cost[0], cost[1]) - cost[2]).mean()))
    done: set[int] = set()
    accepted = []
    for k in np.argsort(merits)[::-1]:
        a, b = pairs[k]
        sizes = (owner == a).sum(), (owner == b).sum()
        slack = _MERGE_SLACK if min(sizes) < 40 and sum(sizes) < 160 else 0.4 * _MERGE_SLACK
        if merits[k] >= -slack and not {a, b} & done:
            done |= {a, b}
            accepted.append(trials[k])
    if not accepted:
        return None
    bodies = [*(b for k, b in enumerate(state.bodies) if k + 1 not in done), *accepted]
    return _prune(_labeled(pictures, grid, bodies))


def _neighbors(state: Fit, owner: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of bodies that touch and move alike where they do, those with the longest border first."""
    count = len(state.bodies) + 1
    border = np.zeros((count, count), int)
    z = state.grid.depth
    for near, far in (np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1]):
        a, b = owner[near], owner[far]
        touch = (a > 0) & (b > 0) & (a != b) & (np.abs(z[near] - z[far]) < 0.03)
        np.add.at(border, (a[touch], b[touch]), 1)
    border = np.triu(border + border.T)
    pairs = [(int(a), int(b)) for a, b in np.argwhere(border >= 2) if _alike(state, owner, a, b)]
    return sorted(pairs, key=lambda p: -border[p])


def _alike(state: Fit, owner: np.ndarray, a: int, b: int) -> bool:
    """Whether two bodies' motions differ by less than 4 cm on the seam between them."""
    seam = cv2.dilate((owner == a).astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool) & (owner == b)
    if not seam.any():
        return False
    uv = state.grid.pixels(seam).astype(float)
    xyz = state.pictures.unproject(uv, state.grid.depth[seam].astype(float))
    one, other = (state.bodies[k - 1].motion.carry(xyz) for k in (a, b))
    return bool(np.linalg.norm(one - other, axis=-1).mean() < 0.04)
