"""How badly a motion explains pictures: zero where it is right, and as bad as it says where it is not."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rigid_body_scenes import FRAMES, two_plates
from scipy.spatial.transform import Rotation
from thoroughness import examples

from flowlab.tracking.trackers.rigid_bodies import _costs, _energies, _readings, _surfaces
from flowlab.tracking.trackers.rigid_bodies.assignment import frame_costs, looked_at, motion_costs
from flowlab.tracking.trackers.rigid_bodies.motion_segmentation import segment_motion
from flowlab.tracking.trackers.rigid_bodies.recovery import LOST_ENERGY

rng = np.random.default_rng(0)
_OFFSET = np.array([_costs.BLACK, -_costs.GRAY, -_costs.GRAY])
FEATURE = rng.integers(0, 256, (20, 30, 4), np.uint8)


@settings(deadline=None)
@given(u=st.floats(0, 28.9), v=st.floats(0, 18.9))
def test_features_are_interpolated(u: float, v: float) -> None:
    (found,) = _costs.features_at(FEATURE, np.array([[u, v]], np.float32))
    u, v = np.float32(u), np.float32(v)
    j, i = int(u), int(v)
    across = (1 - (u - j)) * FEATURE[i : i + 2, j].astype(float) + (u - j) * FEATURE[i : i + 2, j + 1]
    np.testing.assert_allclose(found, (1 - (v - i)) * across[0] + (v - i) * across[1], atol=1e-3)
    assert _costs.color_cost(FEATURE, float(u), float(v), found) < 1e-3


def test_a_difference_of_color_costs_what_its_channels_say_and_at_most_1() -> None:
    at = FEATURE[5, 7].astype(np.float32)
    one = _costs.color_cost(FEATURE, 7.0, 5.0, at + np.float32([0, 7, 0, 0]))
    assert one == pytest.approx(7 * _costs.L)
    all_four = _costs.color_cost(FEATURE, 7.0, 5.0, at + np.float32([4, -7, 3, -3]))
    assert all_four == pytest.approx(4 * _costs.LCN + 7 * _costs.L + 3 * _costs.A + 3 * _costs.B)
    assert _costs.color_cost(FEATURE, 7.0, 5.0, at + 1000) == 1


@pytest.mark.parametrize("light", [0.2, 0.35, 0.6])
@pytest.mark.parametrize("color", [(200, 60, 40), (60, 160, 90), (70, 90, 210), (180, 180, 175)])
def test_what_is_in_shadow_is_known_again_and_another_color_as_dark_is_not(color: tuple, light: float) -> None:
    linear = np.array(color) / 255
    dark = tuple(255 * (linear**2.2 * light) ** (1 / 2.2))  # as a camera shows what is lit by this share
    alike = _cost_between(color, dark)
    assert alike < _costs.SHADED + 0.2
    other = _lab(dark)[[0, 2, 1]] + np.uint8([0, 30, 226])  # as dark, of another hue
    assert _costs.color_cost(_picture(other), 3.0, 3.0, _features(color), _costs.SHADED) > alike + 0.2


def test_a_point_that_goes_through_shadow_is_not_taken_for_hidden_but_nothing_else_trusts_shadow() -> None:
    scene, t = two_plates(), 10
    dark = scene.pictures.feature.astype(float)
    dark[1:, ..., 1:] = 0.6 * (dark[1:, ..., 1:] + _OFFSET) - _OFFSET
    pictures = replace(scene.pictures, feature=dark.clip(0, 255).astype(np.uint8))
    uv, motion = scene.some_pixels(1, 200), scene.motion(1)
    cost = motion_costs(pictures, segment_motion(scene.pictures), [motion], uv, scene.points(uv))
    assert np.median(cost) < 0.6  # what it costs to be hidden
    features = _costs.features_at(pictures.feature[0], uv.astype(np.float32))
    pose = motion.R[None, None, t], motion.t[None, None, t]
    seen = pictures.depth[t], pictures.feature[t], pictures.K, 1, np.zeros((1, 1)), False
    assert _energies.energies(scene.points(uv)[None], features[None], *pose, *seen)[0] > LOST_ENERGY
    path = motion.apply(scene.points(uv))
    residual = _costs.residuals(pictures.depth, pictures.feature, features, pictures.project(path), path[..., 2])
    assert np.median(residual[t]) > 0.6  # by which errors are stated: what is in shadow may be something else


def test_another_light_never_costs_less_than_the_same_and_darkness_is_no_shadow() -> None:
    assert _cost_between((200, 60, 40), (200, 60, 40)) < 1e-6
    assert _cost_between((200, 60, 40), (195, 62, 40)) < _costs.SHADED
    assert _cost_between((200, 200, 200), (20, 20, 20)) == 1


def _cost_between(first: tuple, now: tuple) -> float:
    """What a pixel that had one color (R, G, B) costs where a plain picture has another."""
    return float(_costs.color_cost(_picture(_lab(now)), 3.0, 3.0, _features(first), _costs.SHADED))


def _picture(lab: np.ndarray) -> np.ndarray:
    return np.tile(np.append(128, lab).astype(np.uint8), (7, 7, 1))


def _features(color: tuple) -> np.ndarray:
    return np.append(128, _lab(color)).astype(np.float32)


def _lab(color: tuple) -> np.ndarray:
    """OpenCV's own L, a and b of a color (R, G, B)."""
    return cv2.cvtColor(np.uint8([[color]]), cv2.COLOR_RGB2LAB)[0, 0]


def test_the_nearest_reading_is_that_of_the_layer_meant() -> None:
    depth = np.zeros((5, 5), np.float32)
    depth[1, 1], depth[2, 3], depth[3, 3] = 0.7, 0.9, 1.2
    off, least, greatest = _readings.nearest_reading(depth, 2.0, 2.0, 1.25)
    assert (off, least, greatest) == pytest.approx((0.05, 0.7, 1.2))
    depth[2, 2] = 1.0
    assert _readings.nearest_reading(depth, 2.2, 1.9, 0.97)[0] == pytest.approx(0.03)  # the center's own counts too
    assert _readings.nearest_reading(np.zeros((5, 5), np.float32), 2.0, 2.0, 1.0)[2] == 0


def test_energy_is_least_where_the_body_is_and_tells_free_space_from_what_hides() -> None:
    scene, t = two_plates(), 10
    uv = scene.some_pixels(1, 200)
    features = _costs.features_at(scene.pictures.feature[0], uv.astype(np.float32))
    motion, points = scene.motion(1), scene.points(uv)
    near, far = (points + np.array([0, 0, z]) for z in (-0.15, 0.15))
    R = np.stack([motion.R[t], motion.R[t], np.eye(3)])
    s = np.stack([motion.t[t], motion.t[t] + np.array([0.02, 0, 0]), np.zeros(3)])
    p = scene.pictures

    def energies(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        shown = p.depth[t], p.feature[t], p.K, 1, np.zeros((1, len(R))), False
        energy, seen = _energies.energies(xyz[None], features[None], R[None], s[None], *shown)
        return energy[0], seen[0]

    energy, seen = energies(points)
    assert energy.argmin() == 0
    assert energy[0] < 0.25
    assert seen[0] > 0.95
    assert energies(near)[0][0] == pytest.approx(_energies.SEEN_BEHIND), "the camera looks through where it would be"
    assert energies(far)[0][0] == pytest.approx(_energies.HIDDEN), "the plate hides where it would be"
    assert energies(near)[1][0] == energies(far)[1][0] == 0
    behind, _ = energies(points - [0, 0, 5.0])
    np.testing.assert_allclose(behind, _energies.HIDDEN)


def test_every_nth_point_may_be_looked_at() -> None:
    scene, t = two_plates(), 10
    uv = scene.some_pixels(1, 300)
    points, p = scene.points(uv), scene.pictures
    features = _costs.features_at(p.feature[0], uv.astype(np.float32))
    R, s, shown = np.eye(3)[None, None], np.zeros((1, 1, 3)), (p.depth[t], p.feature[t], p.K)
    thinned = _energies.energies(points[None], features[None], R, s, *shown, 3, np.zeros((1, 1)), False)
    chosen = _energies.energies(points[None, ::3], features[None, ::3], R, s, *shown, 1, np.zeros((1, 1)), False)
    np.testing.assert_allclose(thinned, chosen, rtol=1e-6)


@settings(max_examples=examples(20), deadline=None, derandomize=True)
@given(seed=st.integers(0, 999), reach=st.sampled_from([0.002, 0.02, 0.2]), every=st.sampled_from([1, 3]))
def test_where_only_the_best_pose_is_wanted_it_is_found_with_its_energy(seed: int, reach: float, every: int) -> None:
    scene, t, rng = two_plates(), 10, np.random.default_rng(seed)
    uv, p, motion = scene.some_pixels(1, 150), scene.pictures, scene.motion(1)
    points, features = scene.points(uv), _costs.features_at(p.feature[0], uv.astype(np.float32))
    R = motion.R[t] @ Rotation.from_rotvec(rng.normal(0, 3 * reach, (1, 30, 3)).reshape(-1, 3)).as_matrix()
    poses = R[None], motion.t[t] + rng.normal(0, reach, (1, 30, 3))
    base = rng.choice([0.0, 0.5, 10.0], (1, 30))
    shown = p.depth[t], p.feature[t], p.K, every
    none, all_of_them = (
        _energies.energies(points[None], features[None], *poses, *shown, b, False) for b in (0 * base, base)
    )
    np.testing.assert_allclose(all_of_them[0], none[0] + base, rtol=1e-9)
    energy, seen = _energies.energies(points[None], features[None], *poses, *shown, base, True)
    best = all_of_them[0].argmin()
    assert energy.argmin() == best
    assert energy[0, best] == all_of_them[0][0, best]
    assert seen[0, best] == all_of_them[1][0, best]
    assert (energy >= energy[0, best]).all()
    assert (energy <= all_of_them[0] + 1e-12).all()


@settings(deadline=None)
@given(hnp.arrays(np.float32, (5, 6), elements=st.sampled_from([0.0, 0.5, 0.75, 1.0, 3.0])))
def test_what_is_around_all_pixels_is_what_is_around_each(depth: np.ndarray) -> None:
    around = np.empty((2, 5, 6), np.float32)
    _readings.extremes(depth, around)
    there = np.where(depth > 0, depth, np.float32(99))
    np.testing.assert_array_equal(around[0], cv2.erode(there, np.ones((3, 3), np.uint8)))
    np.testing.assert_array_equal(around[1], cv2.dilate(depth, np.ones((3, 3), np.uint8)))
    for i, j in np.ndindex(5, 6):
        _, nearest, farthest = _readings.nearest_reading(depth, float(j), float(i), 1.0)
        assert (nearest, farthest) == (around[0, i, j], around[1, i, j])


def test_many_points_cost_what_few_of_them_do() -> None:
    """Of many, what is around a pixel is looked up."""
    scene = two_plates()
    grid, uv = segment_motion(scene.pictures), scene.pixels(1)
    motions = [scene.motion(k) for k in range(3)] * (1 + scene.owner.size // len(uv) // 3)
    assert len(motions) * len(uv) > scene.owner.size
    many = motion_costs(scene.pictures, grid, motions, uv, scene.points(uv))
    few = motion_costs(scene.pictures, grid, motions[:3], uv[:40], scene.points(uv[:40]))
    np.testing.assert_array_equal(many[:3, :40], few)


@settings(deadline=None, derandomize=True)
@given(rotvec=st.lists(st.floats(-3, 3), min_size=3, max_size=3), flat=st.booleans())
def test_a_surface_faces_the_camera_where_its_normal_does(rotvec: list[float], flat: bool) -> None:
    rng = np.random.default_rng(0)
    points, normals = rng.normal([0, 0, 1], 0.1, (40, 3)), rng.normal(size=(40, 3))
    normals *= 0.0 if flat else 1 / np.linalg.norm(normals, axis=1, keepdims=True)
    R, s = Rotation.from_rotvec(rotvec).as_matrix(), np.array([0.1, 0.0, 2.0])
    toward_camera = -(points @ R.T + s)
    cosine = (normals @ R.T * toward_camera).sum(1) / np.linalg.norm(toward_camera, axis=1)
    clear = np.abs(cosine - 0.3) > 1e-9
    np.testing.assert_array_equal(_energies.facing(points, normals, R, s, 0.3)[clear], ((cosine > 0.3) | flat)[clear])


def test_a_motions_cost_is_least_for_the_points_that_follow_it() -> None:
    scene = two_plates()
    motions = [scene.motion(k) for k in range(3)]
    R, t = np.stack([m.R for m in motions]), np.stack([m.t for m in motions])
    p, frames, static = scene.pictures, np.arange(1, FRAMES), scene.owner == 0
    for k in range(3):
        uv = scene.some_pixels(k, 100)
        features = _costs.features_at(p.feature[0], uv.astype(np.float32))
        cost, moved, through = _costs.motion_costs(
            scene.points(uv), features, frames, np.zeros(3, int), R, t, R[0], t[0], static, p.depth, p.feature, p.K
        )
        assert (cost.argmin(0) == k).mean() > 0.9, k
        assert through[k].max() < 0.1
        path = np.stack([m.apply(scene.points(uv)) for m in motions])
        away = np.linalg.norm(path[:, 1:] - path[:, :1], axis=-1) > 0.01
        np.testing.assert_allclose(moved, away.mean(1), atol=1.01 / len(frames))  # at the limit, rounding decides


def test_another_color_at_a_moved_point_costs_what_being_hidden_does_at_most() -> None:
    """A finger on a thing is less than a centimeter thick, so that depth alone does not tell that it hides it."""
    scene, penalty = two_plates(), 0.0
    feature = scene.pictures.feature.copy()
    feature[4:] = 255 - feature[4:]
    pictures, grid = replace(scene.pictures, feature=feature), segment_motion(scene.pictures)
    uv, rests = scene.some_pixels(1, 100), scene.some_pixels(0, 100)
    covered = motion_costs(pictures, grid, [scene.motion(1)], uv, scene.points(uv), penalty)
    assert 0.3 < np.median(covered) <= _costs.UNSEEN
    other = motion_costs(pictures, grid, [scene.motion(0)], rests, scene.points(rests), penalty)
    assert np.median(other) > np.median(covered)


def test_the_cost_of_a_frame_is_that_of_all_of_them_in_the_mean() -> None:
    scene = two_plates()
    uv, motions, grid = scene.some_pixels(1, 50), [scene.motion(k) for k in range(3)], segment_motion(scene.pictures)
    frames = looked_at(scene.pictures)
    every = frame_costs(scene.pictures, grid, motions, uv, scene.points(uv), frames)
    assert every.shape == (3, len(frames))
    R, t = np.stack([m.R for m in motions]), np.stack([m.t for m in motions])
    features = _costs.features_at(scene.pictures.feature[0], uv.astype(np.float32))
    shown = scene.pictures.depth, scene.pictures.feature, scene.pictures.K
    still = scene.pictures.stillness
    static = grid.in_pixels(grid.static, scene.owner.shape)
    from_first = np.zeros(3, int)
    of = scene.points(uv), features, frames, from_first, R, t, still.R, still.t, static
    cost, *_ = _costs.motion_costs(*of, *shown)
    np.testing.assert_allclose(every[1:].mean(1), cost[1:].mean(1), atol=1e-5)
    # A covered point that rests costs more where it was last seen badly, which a single frame does not know.
    assert every[0].mean() <= cost[0].mean() + 1e-5
    since = np.array([0, 7, FRAMES])
    later = frame_costs(scene.pictures, grid, motions, uv, scene.points(uv), frames, since)
    np.testing.assert_array_equal(later, np.where(frames > since[:, None], every, 0))


def test_what_fits_leaves_no_residual_and_without_depth_none_is_known() -> None:
    scene = two_plates()
    uv = scene.some_pixels(1, 100)
    path = scene.motion(1).apply(scene.points(uv))
    p = scene.pictures
    features = _costs.features_at(p.feature[0], uv.astype(np.float32))
    pixels, z = p.project(path), path[..., 2]
    found = _costs.residuals(p.depth, p.feature, features, pixels, z)
    assert np.median(found) < 0.2
    off = _costs.residuals(p.depth, p.feature, features, pixels, z + 0.1)
    np.testing.assert_allclose(off - found, 0.3, atol=0.16)
    none = _costs.residuals(np.zeros_like(p.depth), p.feature, features, pixels, z)
    np.testing.assert_array_equal(none, -1)


def test_inliers_are_counted_over_known_frames() -> None:
    start = rng.normal(size=(5, 3))
    R = Rotation.from_rotvec(rng.normal(size=(8, 3))).as_matrix()
    t = rng.normal(size=(8, 3))
    path = np.einsum("fij,nj->fni", R, start) + t[:, None]
    known = np.ones((8, 5), bool)
    path[:4, 1] += 0.02  # off in half of the frames
    path[:, 2] += 0.02
    known[4:, 2] = known[:, 3] = False
    path[2, 4] += 0.02
    known[2, 4] = False
    found = _costs.inlier_shares(R, t, start, path, known, np.full((8, 5), 0.01))
    np.testing.assert_allclose(found, [1, 0.5, 0, 0, 1])


def test_a_point_is_seen_where_its_depth_is_read_or_nothing_is() -> None:
    depth = np.full((1, 20, 30), 1.0, np.float32)
    depth[0, :, 15:] = 0.7
    depth[0, 10:, :] = 0
    uv = np.array([[[5.0, 5], [5, 5], [20, 5], [15, 5], [14, 5], [5, 15], [-1, 5]]])
    z = np.array([[1.005, 1.05, 1.0, 1.0, 1.0, 1.0, 1.0]])
    #             here,  behind, hidden, hidden at the border of what covers it, beside that, a hole, out of the picture
    np.testing.assert_array_equal(_surfaces.is_seen(depth, uv, z), [[True, False, False, False, True, True, False]])


def test_how_far_beyond_points_the_surface_is_read() -> None:
    depth = np.full((1, 20, 30), 1.0, np.float32)
    depth[0, :, 15:] = 0.7
    uv, z = np.array([[[5.0, 5], [14, 5], [20, 5]]]), np.array([[0.997, 0.998, 1.0]])
    found = _surfaces.depth_offsets(depth, uv, z)
    np.testing.assert_allclose(found[0, :2], [0.003, 0.002], atol=1e-6)
    assert np.isnan(found[0, 2])


def test_costs_are_averaged_over_neighbors_that_look_alike_only() -> None:
    h, w = 12, 16
    cost = rng.random((2, h, w)).astype(np.float32)
    depth, feature = np.full((h, w), 1.0, np.float32), np.zeros((h, w, 4), np.uint8)
    depth[:, 8:] = 1.5
    feature[6:, :, 1] = 255
    valid, wanted = np.ones((h, w), bool), np.ones((h, w), bool)
    valid[0, 0] = wanted[1, 1] = False
    out = _surfaces.aggregate(cost, wanted, valid, depth, feature, 3, 0.01, 0.35, 2.0)
    assert np.isinf(out[:, 0, 0]).all()
    np.testing.assert_array_equal(out[:, 1, 1], cost[:, 1, 1])
    far = cost.copy()
    far[:, :, 8:] += 5
    far[:, 6:] += 7
    again = _surfaces.aggregate(far, wanted, valid, depth, feature, 3, 0.01, 0.35, 2.0)
    np.testing.assert_allclose(again[:, 1:6, :8], out[:, 1:6, :8], atol=0.02)
    assert out[:, 2:6, :8].std() < 0.5 * cost[:, 2:6, :8].std()
    same = _surfaces.aggregate(np.full_like(cost, 0.4), wanted, valid, depth, feature, 3, 0.01, 0.35, 2.0)
    np.testing.assert_allclose(same[:, valid], 0.4, rtol=1e-6)
