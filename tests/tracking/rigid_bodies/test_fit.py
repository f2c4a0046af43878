"""The whole fit, from pictures to motions."""

import numpy as np
import pytest
from rigid_body_scenes import Scene, two_plates

from flowlab.tracking.trackers.rigid_bodies.bodies import RigidBodyFit
from flowlab.tracking.trackers.rigid_bodies.fit import fit_bodies
from flowlab.tracking.trackers.rigid_bodies.motion_segmentation import MotionGrid


def check_plates(plates: Scene, fit: RigidBodyFit) -> None:
    """Each plate has a motion of its own, which is right."""
    best = fit.assignment.best_motion
    for k in (1, 2):
        inner = plates.some_pixels(k, 80)
        cells = best[inner[:, 1] // 2, inner[:, 0] // 2]
        mine = int(np.bincount(cells).argmax())
        assert mine > 0
        assert (cells == mine).mean() > 0.9, k
        points = plates.points(inner)
        off = np.linalg.norm(fit.motions[mine].apply(points) - plates.motion(k).apply(points), axis=-1)
        assert np.median(off, 1).max() < 0.006, k


@pytest.mark.parametrize("restarts", [0, 2])
def test_finds_the_plates_and_which_cells_are_theirs(restarts: int) -> None:
    plates = two_plates(0.002)
    fit = fit_bodies(plates.pictures, seed=0, restarts=restarts)
    assert len(fit.motions) == len(fit.bodies) + 1
    check_plates(plates, fit)
    assert isinstance(fit.grid, MotionGrid)


def test_what_several_searches_found_explains_no_less_than_what_the_first_did() -> None:
    plates = two_plates(0.004)
    others = 0
    for seed in range(2):
        one, more = (fit_bodies(plates.pictures, seed, restarts=n) for n in (0, 2))
        cost = [f.assignment.cost.min(0)[f.grid.undecided].mean() for f in (one, more)]
        assert cost[1] < cost[0] + 0.005, seed
        assert len(more.bodies) <= len(one.bodies) + 1, "what several found is one body"
        firsts = {b.motion.t.tobytes() for b in one.bodies}
        others += sum(b.motion.t.tobytes() not in firsts for b in more.bodies)
    assert others, "nothing of the other searches was taken in two fits"
