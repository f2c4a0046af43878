"""Metrics against figures worked out by hand, a slow TAPVid-3D in plain loops, and what must hold for any tracks."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.stats import spearmanr
from thoroughness import examples

from flowlab.geometry.camera import Camera
from flowlab.grading.calibration import SIGMA_EDGES_MM, calibrate, confidently_wrong, rank_correlation
from flowlab.grading.ground_truth import GroundTruth
from flowlab.grading.metrics import CURVE_MM, EstimatedTracks, TrackErrors, TrackMetrics, average, measure
from flowlab.grading.tapvid import MetricSettings
from flowlab.records import Role

CAMERA = Camera(320, 240, np.array([[300.0, 0, 160], [0, 270, 120], [0, 0, 1]]), np.eye(4))
PROTOTYPE_RULES = MetricSettings(image_side="width", count_query_frame=False)


def make_truth(seed: int = 0, steps: int = 12, points: int = 9) -> GroundTruth:
    """Points that wander about 1 m before the camera, some out of sight now and then, of all roles."""
    rng = np.random.default_rng(seed)
    step = rng.normal(0, 0.01, (steps, points, 3)) * (np.arange(points) % 3)[:, None]
    tracks = rng.uniform([-0.3, -0.3, 0.6], [0.3, 0.3, 1.5], (points, 3)) + np.cumsum(step, 0)
    role = rng.permutation(np.arange(points) % 3).astype(np.int8)
    visible = rng.random((steps, points)) < 0.8
    visible[0] = True
    return GroundTruth(np.zeros((points, 2), np.float32), tracks.astype(np.float32), visible, role)


def make_estimate(truth: GroundTruth, seed: int = 0, scale_m: float = 0.02) -> EstimatedTracks:
    """Errors of all sizes, wrong visibility here and there, some answers missing."""
    rng = np.random.default_rng(seed + 1)
    size = scale_m * rng.lognormal(0, 1.5, truth.visible.shape)
    direction = rng.normal(size=truth.tracks_cam.shape)
    xyz = truth.tracks_cam + size[..., None] * direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    xyz[rng.random(truth.visible.shape) < 0.05] = np.nan
    visible = truth.visible ^ (rng.random(truth.visible.shape) < 0.2)
    return EstimatedTracks(
        xyz.astype(np.float32), visible, (size * rng.lognormal(0, 0.5, size.shape)).astype(np.float32)
    )


def tapvid_in_loops(
    estimate: EstimatedTracks, truth: GroundTruth, focal_px: float, first: int = 0
) -> tuple[float, float, float]:
    """3D-AJ, APD and OA as the paper words them, one pair at a time. ``focal_px`` is that at 256 pixels."""
    steps, points = truth.visible.shape
    jaccards, shares = [], []
    for pixels in (1, 2, 4, 8, 16):
        true_positives = false_positives = positives = near = 0
        for t in range(first, steps):
            for n in range(points):
                distance = float(np.linalg.norm(estimate.xyz_cam[t, n].astype(float) - truth.tracks_cam[t, n]))
                correct = distance < pixels * float(truth.tracks_cam[t, n, 2]) / focal_px
                seen, said = bool(truth.visible[t, n]), bool(estimate.visible[t, n])
                positives += seen
                near += seen and correct
                if said and seen and correct:
                    true_positives += 1
                elif said:
                    false_positives += 1
        jaccards.append(true_positives / (positives + false_positives))
        shares.append(near / positives)
    agree = [estimate.visible[t, n] == truth.visible[t, n] for t in range(first, steps) for n in range(points)]
    return sum(jaccards) / 5, sum(shares) / 5, sum(agree) / len(agree)


def off_by(truth: GroundTruth, error_mm: Any, *, visible: np.ndarray | None = None) -> EstimatedTracks:
    """An estimate that is off along x by (T, N) millimeters."""
    shift = np.broadcast_to(np.asarray(error_mm, float), truth.visible.shape)[..., None] * [1e-3, 0, 0]
    return EstimatedTracks((truth.tracks_cam + shift).astype(np.float32), truth.visible if visible is None else visible)


def still(points: int, steps: int, role: Role | None = Role.OBJECT) -> GroundTruth:
    """Points that rest 1 m before the camera, in sight."""
    tracks = np.tile(np.array([0, 0, 1], np.float32), (steps, points, 1))
    roles = None if role is None else np.full(points, role, np.int8)
    return GroundTruth(np.zeros((points, 2), np.float32), tracks, np.ones((steps, points), bool), roles)


def test_perfect_tracks_are_perfect() -> None:
    truth = make_truth()
    m = measure(EstimatedTracks(truth.tracks_cam, truth.visible), truth, CAMERA)
    assert (m.tapvid.average_jaccard, m.tapvid.apd, m.tapvid.occlusion_accuracy) == (1, 1, 1)
    assert m.survival == m.survival_moving == 1
    for group in (m.all, m.moving, m.object, m.occluded):
        assert group is not None
        assert (group.median_mm, group.p95_mm, group.within_5mm, group.answered) == (0, 0, 1, 1)


def test_errors_by_hand_leave_out_the_first_frame() -> None:
    truth = still(points=1, steps=6)
    m = measure(off_by(truth, [[900], [1], [6], [15], [30], [100]]), truth, CAMERA)
    assert m.all is not None
    assert m.all.n == 5
    assert m.all.median_mm == pytest.approx(15, abs=1e-3)
    assert m.all.mean_mm == pytest.approx(152 / 5, abs=1e-3)
    assert m.all.p95_mm == pytest.approx(30 + 0.8 * 70, abs=1e-3), "linear between the two largest"
    assert (m.all.within_5mm, m.all.within_10mm, m.all.within_20mm, m.all.within_40mm) == (0.2, 0.4, 0.6, 0.8)
    assert m.moving is None, "nothing moves"
    assert m.survival == pytest.approx(4 / 5), "lost at the last of five frames"


def test_tapvid_by_hand() -> None:
    """At 1 m and f = 256 px the limits are p / 256 m: 3.9, 7.8, 15.6, 31 and 62.5 mm."""
    camera = Camera(320, 256, np.array([[256.0, 0, 0], [0, 256, 0], [0, 0, 1]]), np.eye(4))
    truth = still(points=4, steps=1)
    truth.visible[0, 3] = False
    said = np.array([[True, False, True, True]])
    t = measure(off_by(truth, [[3, 10, 40, 0]], visible=said), truth, camera).tapvid
    assert t.apd == pytest.approx(np.mean([1 / 3, 1 / 3, 2 / 3, 2 / 3, 1]))
    # hits / (3 seen + false alarms): the fourth point always is one, the third until 16 pixels.
    assert t.average_jaccard == pytest.approx(np.mean([1 / 5, 1 / 5, 1 / 5, 1 / 5, 2 / 4]))
    assert t.occlusion_accuracy == 0.5


@pytest.mark.parametrize("seed", range(4))
def test_tapvid_agrees_with_loops(seed: int) -> None:
    truth = make_truth(seed)
    estimate = make_estimate(truth, seed)
    t = measure(estimate, truth, CAMERA).tapvid
    shorter_side = np.sqrt(300 * 270) * 256 / 240
    assert (t.average_jaccard, t.apd, t.occlusion_accuracy) == pytest.approx(
        tapvid_in_loops(estimate, truth, shorter_side), abs=1e-12
    )
    other = measure(estimate, truth, CAMERA, PROTOTYPE_RULES).tapvid
    assert (other.average_jaccard, other.apd, other.occlusion_accuracy) == pytest.approx(
        tapvid_in_loops(estimate, truth, 300 * 256 / 320, first=1), abs=1e-12
    )
    assert other != t


def test_limits_are_strict() -> None:
    """A point exactly on a limit is outside."""
    truth = still(points=1, steps=2)
    half = replace(off_by(truth, 0), xyz_cam=truth.tracks_cam + np.array([0.03125, 0, 0], np.float32))
    camera = Camera(256, 256, np.diag([256.0, 256.0, 1.0]), np.eye(4))
    assert measure(half, truth, camera).tapvid.apd == pytest.approx(1 / 5), "8 px is 31.25 mm"


def test_groups() -> None:
    """One point of each role slides 1.5 cm, rests there, then goes on to 4 cm; one never gets beyond 1.5 cm."""
    path = np.array([0, 0.015, 0.015, 0.04])
    tracks = np.zeros((4, 3, 3), np.float32)
    tracks[..., 2] = 1
    tracks[:, 0, 0] = tracks[:, 1, 0] = path
    tracks[:, 2, 0] = np.minimum(path, 0.015)
    visible = np.ones((4, 3), bool)
    visible[2, 0] = visible[3, 1] = visible[1, 2] = False
    role = np.array([Role.OBJECT, Role.ROBOT, Role.OBJECT], np.int8)
    truth = GroundTruth(np.zeros((3, 2), np.float32), tracks, visible, role)
    errors = [[0, 0, 0], [1, 2, 3], [4, 5, 6], [7, 8, 9]]
    m = measure(off_by(truth, errors), truth, CAMERA)
    assert m.all is not None
    assert m.moving is not None
    assert m.object is not None
    assert m.occluded is not None
    assert m.all.n == 6
    assert (m.moving.n, m.moving.mean_mm) == (4, pytest.approx((1 + 7 + 2 + 5) / 4, abs=1e-3))
    assert (m.object.n, m.object.mean_mm) == (2, pytest.approx((1 + 7) / 2, abs=1e-3))
    assert (m.occluded.n, m.occluded.mean_mm) == (2, pytest.approx((4 + 8) / 2, abs=1e-3))


def test_without_roles_nothing_is_said_of_motion() -> None:
    truth = replace(make_truth(), role=None)
    m = measure(make_estimate(truth), truth, CAMERA)
    assert (m.moving, m.object, m.occluded, m.survival_moving) == (None, None, None, None)
    assert m.all is not None
    assert not {"moving", "object", "occluded", "survival_moving"} & m.to_json().keys()


def test_no_answer_is_a_miss_but_no_number() -> None:
    truth = still(points=2, steps=2)
    estimate = off_by(truth, [[0, 0], [3, 3]])
    estimate.xyz_cam[1, 1] = np.nan
    m = measure(estimate, truth, CAMERA)
    assert m.all is not None
    assert (m.all.answered, m.all.within_40mm) == (0.5, 0.5)
    assert m.all.median_mm == pytest.approx(3, abs=1e-3)
    assert m.tapvid.apd < 1
    assert m.survival == 0.5
    estimate.xyz_cam[:] = np.nan
    lost = measure(estimate, truth, CAMERA)
    assert lost.all is not None
    assert np.isnan(lost.all.median_mm)
    assert json.loads(json.dumps(lost.to_json()))["all"]["median_mm"] is None


def test_survival_stops_at_the_first_visible_loss() -> None:
    truth = still(points=3, steps=5)
    truth.visible[2, 1] = False
    errors = np.zeros((5, 3))
    errors[3, 0] = errors[2, 1] = 60  # the second is not seen when it is wrong
    errors[1:, 2] = 60
    assert measure(off_by(truth, errors), truth, CAMERA).survival == pytest.approx((2 / 4 + 1 + 0) / 3)


def test_calibration_of_a_true_sigma() -> None:
    """Errors drawn so that 68 % lie below sigma: every bin of the reliability table says so."""
    rng = np.random.default_rng(0)
    sigma = np.exp(rng.uniform(np.log(1e-3), np.log(64e-3), 40000))
    quantile68 = 0.994457883  # of the absolute value of a normal variable
    c = calibrate(np.abs(rng.normal(size=sigma.shape)) * sigma / quantile68, sigma)
    assert c is not None
    assert c.within_1_sigma == pytest.approx(0.68, abs=0.01)
    assert c.within_2_sigma == pytest.approx(0.9533, abs=0.005)
    full = np.array(c.count) > 2000
    assert full.sum() == 12, "half octaves from 1 to 64 mm"
    assert sum(c.count) == c.n == 40000
    np.testing.assert_allclose(np.array(c.true_mm)[full] / np.array(c.stated_mm)[full], 1, atol=0.1)
    assert np.isnan(c.true_mm[0]), "nothing states less than half a millimeter"
    low, high = SIGMA_EDGES_MM[5:7]
    assert low <= c.stated_mm[5] < high


def test_a_sigma_of_half_the_error_is_found_out() -> None:
    rng = np.random.default_rng(0)
    sigma = rng.uniform(1e-3, 64e-3, 20000)
    c = calibrate(np.abs(rng.normal(size=sigma.shape)) * 2 * sigma, sigma)
    assert c is not None
    assert c.within_1_sigma < 0.4
    assert np.nanmedian(np.array(c.true_mm) / np.array(c.stated_mm)) == pytest.approx(2, abs=0.2)


def test_calibration_skips_the_first_frame_and_missing_answers() -> None:
    truth = make_truth()
    estimate = make_estimate(truth)
    c = measure(estimate, truth, CAMERA).calibration
    assert c is not None
    assert c.n == np.isfinite(estimate.xyz_cam[1:, :, 0]).sum()
    assert calibrate(np.array([np.nan]), np.array([1.0])) is None


@given(arrays(float, 30, elements=st.integers(0, 6).map(float)), arrays(float, 30, elements=st.floats(-5, 5)))
def test_rank_correlation_is_spearmans(a: np.ndarray, b: np.ndarray) -> None:
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        assert np.isnan(rank_correlation(a, b))
    else:
        assert rank_correlation(a, b) == pytest.approx(spearmanr(a, b).statistic, abs=1e-9)


@settings(max_examples=examples(30), deadline=None)
@given(st.integers(0, 10**6))
def test_what_holds_for_any_tracks(seed: int) -> None:
    truth = make_truth(seed)
    estimate = make_estimate(truth, seed)
    m = measure(estimate, truth, CAMERA)
    t = m.tapvid
    assert 0 <= t.average_jaccard <= t.apd <= 1, "a hit of the Jaccard figure is one of APD, over no fewer pairs"
    for group in (m.all, m.moving, m.object, m.occluded):
        if group is not None:
            assert (
                0 <= group.within_5mm <= group.within_10mm <= group.within_20mm <= group.within_40mm <= group.answered
            )
            assert list(group.curve) == sorted(group.curve)
            assert group.within_10mm <= group.curve[np.searchsorted(CURVE_MM, 10)]
            assert not group.median_mm > group.p95_mm
    order = np.random.default_rng(seed).permutation(truth.visible.shape[1])
    assert truth.role is not None
    assert estimate.sigma is not None
    shuffled = measure(
        EstimatedTracks(estimate.xyz_cam[:, order], estimate.visible[:, order], estimate.sigma[:, order]),
        GroundTruth(truth.query_px, truth.tracks_cam[:, order], truth.visible[:, order], truth.role[order]),
        CAMERA,
    )
    assert shuffled.tapvid == t
    assert shuffled.survival == pytest.approx(m.survival)


@settings(max_examples=examples(20), deadline=None)
@given(st.integers(0, 10**6), st.floats(1.1, 5))
def test_larger_errors_never_score_better(seed: int, factor: float) -> None:
    truth = make_truth(seed)
    estimate = make_estimate(truth, seed)
    worse = replace(
        estimate, xyz_cam=(truth.tracks_cam + factor * (estimate.xyz_cam - truth.tracks_cam)).astype(np.float32)
    )
    good, bad = measure(estimate, truth, CAMERA), measure(worse, truth, CAMERA)
    assert bad.tapvid.apd <= good.tapvid.apd
    assert bad.tapvid.average_jaccard <= good.tapvid.average_jaccard
    assert bad.tapvid.occlusion_accuracy == good.tapvid.occlusion_accuracy
    assert bad.survival <= good.survival


def test_the_average_counts_every_recording_the_same() -> None:
    parts = []
    for seed, steps in ((0, 6), (1, 30)):
        truth = make_truth(seed, steps)
        parts.append(measure(make_estimate(truth, seed), truth, CAMERA))
    no_motion = still(points=2, steps=3)
    parts.append(measure(off_by(no_motion, 1), no_motion, CAMERA))
    mean = average(parts)
    assert mean.tapvid.apd == pytest.approx(np.mean([p.tapvid.apd for p in parts]))
    moving = [p.moving for p in parts if p.moving is not None]
    assert len(moving) == 2
    assert mean.moving is not None
    assert mean.moving.median_mm == pytest.approx(np.mean([g.median_mm for g in moving]))
    assert mean.moving.n == sum(g.n for g in moving)
    assert mean.moving.curve[20] == pytest.approx(np.mean([g.curve[20] for g in moving]))
    assert mean.calibration is None, "reliability is no mean; it is given"
    calibration = parts[0].calibration
    assert average(parts, calibration).calibration is calibration


def test_json_has_every_figure() -> None:
    truth = make_truth()
    m = measure(make_estimate(truth), truth, CAMERA)
    values = json.loads(json.dumps(m.to_json(), allow_nan=False))
    assert set(values) == set(TrackMetrics.__slots__)
    assert set(values["object"]) == set(TrackErrors.__slots__)
    assert len(values["calibration"]["true_mm"]) == len(SIGMA_EDGES_MM) - 1


def test_confidently_wrong_is_far_off_without_saying_so() -> None:
    error = np.array([[0.03, 0.03, 0.019, np.nan, 0.03, 0.5]])
    sigma = np.array([[0.007, 0.008, 0.001, 0.001, 0.001, 0.13]])
    seen = np.array([[True, True, True, True, False, True]])
    assert confidently_wrong(error, sigma, seen) == 1 / 5
    assert np.isnan(confidently_wrong(error, sigma, np.zeros_like(seen)))
