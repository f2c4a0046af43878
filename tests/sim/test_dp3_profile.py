"""The `metaworld-dp3` recipe against DP3's own formulas, written out in plain numpy."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from flowlab.geometry.transforms import apply
from flowlab.perception.observer import Observer
from flowlab.pipeline.recipe import load_recipe
from flowlab.pipeline.stage import EpisodeRequest
from flowlab.pipeline.stages.simulation import ExpertStage, ObserverStage
from flowlab.records import Cloud, Frame
from flowlab.sim.recorder import Rollout

EYE = np.array([0.6, 0.295, 0.8])
WR = np.array([[-0.636681, -0.771127, -0.000942], [0.771085, -0.636658, 0.009703], [-0.008082, 0.005451, 0.999952]])
"""MuJoCo's world to DP3's frame, as measured from DP3's code."""


def turn(a: float, b: float) -> np.ndarray:
    """DP3's T = A(a) B(b), in degrees."""
    (ca, cb), (sa, sb) = np.cos(np.deg2rad([a, b])), np.sin(np.deg2rad([a, b]))
    A = np.array([[1, 0, 0], [0, ca, sa], [0, -sa, ca]])
    B = np.array([[cb, 0, sb], [0, 1, 0], [-sb, 0, cb]])
    return A @ B


def dp3_cloud(depth: np.ndarray, shift: float = 0.0) -> np.ndarray:
    """DP3's cropped cloud (P, 3): integer pixels, cx = cy = W / 2, OpenGL's camera frame turned by constants."""
    f = 64 / np.tan(np.deg2rad(30))
    v, u = np.mgrid[:128, :128] + shift
    z = depth.astype(float)
    right, down = (u - 64) * z / f, (v - 64) * z / f
    xyz = np.stack([right, -down, -z], -1)[z > 0] @ turn(61.4, -7).T
    low, high = [-0.5, -1.5, -0.795], [1, -0.4, 100]
    return np.asarray(xyz[((xyz > low) & (xyz < high)).all(-1)])


@pytest.fixture(scope="module")
def stages() -> tuple[ExpertStage, ObserverStage]:
    # The labels do not depend on how long the expert goes on; ten steps are enough.
    expert, observer, *_ = load_recipe("metaworld-dp3", ["expert.max_steps=10"]).stages
    assert isinstance(expert, ExpertStage)
    assert isinstance(observer, ObserverStage)
    return expert, observer


@pytest.fixture(scope="module", params=["assembly", "hammer"])
def seen(request: pytest.FixtureRequest, stages: Any) -> tuple[Rollout, Frame, Cloud]:
    expert, observer = stages
    rollout = expert.process(EpisodeRequest(task=request.param, seed=0))
    frame = rollout.frame(5)
    return rollout, frame, Observer(observer, request.param).cloud(frame)


def test_the_cloud_is_the_one_of_dp3s_formulas(seen: tuple[Rollout, Frame, Cloud]) -> None:
    _, frame, cloud = seen
    expected = dp3_cloud(frame.depth)
    # A point within rounding of the crop's face may fall on either side.
    assert abs(len(expected) - len(cloud.xyz_world)) <= 2
    assert len(expected) > 1000
    for points, others in ((expected, cloud.xyz_world), (cloud.xyz_world, expected)):
        distance, _ = cKDTree(others).query(points)
        assert np.sort(distance)[:-2].max() < 1e-5


def test_the_comparison_can_tell_half_a_pixel(seen: tuple[Rollout, Frame, Cloud]) -> None:
    _, frame, cloud = seen
    right_pixels = dp3_cloud(frame.depth, shift=0.5)
    distance, _ = cKDTree(right_pixels).query(cloud.xyz_world)
    assert np.median(distance) > 5e-4
    assert abs(len(right_pixels) - len(cloud.xyz_world)) > 100


def test_the_net_map_from_the_world_is_the_published_one(seen: tuple[Rollout, Frame, Cloud]) -> None:
    rollout, _, _ = seen
    T = rollout.T_world_sim
    np.testing.assert_allclose(T[:3, :3], WR, atol=1e-5)
    np.testing.assert_allclose(apply(T, EYE), 0, atol=1e-5)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-5)


def test_the_table_lies_about_its_height_in_dp3s_frame(seen: tuple[Rollout, Frame, Cloud]) -> None:
    """z' > -0.795 is about 5 mm above the table, which the tilt spreads over -0.801 to -0.786."""
    rollout, _, _ = seen
    corners = np.array([[x, y, 0.0] for x in (-0.5, 0.5) for y in (0.3, 0.97)])
    height = (corners - EYE) @ WR[2]
    np.testing.assert_allclose(apply(rollout.T_world_sim[None], corners)[:, 2], height, atol=1e-5)
    assert -0.81 < height.min() < height.max() < -0.78


def test_dp3s_table_is_kept_its_missing_wall_is_not_drawn(seen: tuple[Rollout, Frame, Cloud]) -> None:
    _, frame, cloud = seen
    assert frame.owner is not None
    bodies = {e.body for i, e in enumerate(frame.entities) if i in np.unique(frame.owner)}
    assert "RetainingWall" not in bodies
    assert "tablelink" in bodies
    assert cloud.owner is not None
    assert (cloud.owner == -1).sum() == 0


def test_the_profile_records_dp3s_200_steps_and_pads_with_zeros() -> None:
    expert, observer, *_ = load_recipe("metaworld-dp3").stages
    assert isinstance(expert, ExpertStage)
    assert isinstance(observer, ObserverStage)
    assert (expert.stop, expert.max_steps) == ("full", 200)
    few = Observer(observer, "hammer").sample(Cloud(np.ones((3, 3), np.float32), np.arange(3, dtype=np.int32)))
    assert few.points_world.shape == (1024, 3)
    assert (few.points_world[3:] == 0).all()


def test_tracks_and_object_pose_are_given_in_dp3s_frame(stages: Any) -> None:
    dp3 = load_recipe("metaworld-dp3", ["expert.max_steps=10", "accept.success_steps=0"]).pipeline()
    ours = load_recipe("metaworld", ["expert.max_steps=10", "accept.success_steps=0"]).pipeline()
    theirs, plain = (p.run(EpisodeRequest(task="hammer", seed=0)) for p in (dp3, ours))
    assert theirs.object_pose is not None
    assert plain.object_pose is not None
    np.testing.assert_allclose(theirs.object_pose[:, :3], (plain.object_pose[:, :3] - EYE) @ WR.T, atol=1e-5)
    for first in (3, 6):  # the two columns of the rotation
        expected = plain.object_pose[:, first : first + 3] @ WR.T
        np.testing.assert_allclose(theirs.object_pose[:, first : first + 3], expected, atol=1e-5)
    np.testing.assert_array_equal(theirs.state, plain.state)
    np.testing.assert_allclose(theirs.tracks.xyz_world[0], theirs.queries.xyz_world, atol=3e-6)
    distance, _ = cKDTree(theirs.point_cloud[0]).query(theirs.queries.xyz_world)
    assert np.max(distance) < 1e-6
