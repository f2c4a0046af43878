"""Whether the tracker says so where its motions cannot be trusted."""

from dataclasses import replace

import moving_planes
import numpy as np
import pytest

from flowlab.records import Clip, PositionSource, Tracks2D, Tracks3D
from flowlab.tracking.chunking import ChunkSettings
from flowlab.tracking.labeling import label_clip
from flowlab.tracking.lifting import LiftSettings
from flowlab.tracking.trackers.rigid_bodies import RigidBodies
from flowlab.tracking.trackers.rigid_bodies.doubt import EVIDENCE, WEIGHTS, probability_far

FRAMES, SWAPPED = 16, 7
WALL = np.stack(np.meshgrid(np.arange(12, 60, 8), np.arange(12, 110, 12)), -1).reshape(-1, 2).astype(np.float32)
BOARD = np.stack(np.meshgrid(np.arange(100, 128, 5), np.arange(46, 75, 5)), -1).reshape(-1, 2).astype(np.float32)


def labeled(clip: Clip) -> tuple[Tracks2D, Tracks3D]:
    """Points of the wall, then those of the board."""
    return label_clip(clip, np.concatenate([WALL, BOARD]), RigidBodies(), ChunkSettings(), LiftSettings())


@pytest.fixture(scope="module")
def swapped() -> tuple[Clip, Clip]:
    """A board at rest before a wall; and the same, when it is exchanged for another at the same place."""
    still, one, other = (
        moving_planes.wall(1.2, FRAMES),
        *(
            moving_planes.moving((0.3, 0.3), (0.27, 0, 1.195), np.zeros(3), np.zeros(3), FRAMES, seed)
            for seed in (1, 2)
        ),
    )
    (kept, _), (after, _) = (moving_planes.film([still, board], noise=0.001) for board in (one, other))
    cut = replace(kept, rgb=np.concatenate([kept.rgb[:SWAPPED], after.rgb[SWAPPED:]]))
    return kept, cut


def test_what_changed_without_a_motion_that_explains_it_states_a_large_error(swapped: tuple[Clip, Clip]) -> None:
    (_, before), (tracks, after) = map(labeled, swapped)
    assert before.quality is not None
    assert after.quality is not None
    assert (before.quality.sigma < 0.02).mean() > 0.95
    sigma, board = after.quality.sigma, slice(len(WALL), None)
    assert (sigma[:, : len(WALL)] < 0.02).mean() > 0.95, "the wall has not changed"
    assert (sigma[1:SWAPPED, board] < 0.02).mean() > 0.9, "nor has the board, yet"
    modeled = after.quality.source[SWAPPED + 1 :, board] == PositionSource.MODEL
    assert modeled.any()
    assert (sigma[SWAPPED + 1 :, board][modeled] > 0.02).mean() > 0.9
    assert tracks.doubt is not None


def test_worse_evidence_is_more_doubt() -> None:
    rng = np.random.default_rng(0)
    evidence = rng.uniform(0, 1, (5, 7, len(EVIDENCE)))
    for k, weight in enumerate(WEIGHTS):
        more = evidence.copy()
        more[..., k] += 0.5
        assert (np.sign(probability_far(more) - probability_far(evidence)) == np.sign(weight)).all(), EVIDENCE[k]
    assert len(WEIGHTS) == len(EVIDENCE)
