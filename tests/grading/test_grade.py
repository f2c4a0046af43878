"""Simulated recordings are what they say, and grading finds exactly the errors that were made."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import files_below

from flowlab.errors import DataError, MissingLibraryError
from flowlab.geometry.camera import Camera
from flowlab.grading import grade as grading
from flowlab.grading import ground_truth
from flowlab.grading.grade import grade_recording, grade_tracker, read_clip
from flowlab.grading.graded_recording import UNUSABLE_M, QueryMix
from flowlab.grading.ground_truth import MADE_WITH, GroundTruth, unusable_queries
from flowlab.grading.simulate import SimulatedRecording, simulate_recording
from flowlab.perception.observer import Box, ObserverSettings
from flowlab.pipeline.stages.simulation import ExpertStage
from flowlab.recordings.writing import write_rgbd_recording
from flowlab.records import Clip, Quality, Role, Tracks2D, Tracks3D
from flowlab.sim.scene_settings import CameraSettings, SceneSettings
from flowlab.sim.sensor import CLEAN, KINECT
from flowlab.tracking.base import Session, Tracker
from flowlab.tracking.chunking import ChunkSettings
from flowlab.tracking.lifting import LiftSettings

STEPS = 40


def small(steps: int = STEPS, **changes: Any) -> SimulatedRecording:
    """Settings that make a recording in a few seconds."""
    camera = CameraSettings(width=96, height=72)
    scene = SceneSettings(camera=camera, renderer="gl", rgb=True, markers=False)
    values: dict[str, Any] = {"expert": ExpertStage(max_steps=steps, scene=scene), "sensor": CLEAN}
    return SimulatedRecording(**{**values, **changes})


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording whose sensor adds nothing. Copy it before changing it."""
    folder = tmp_path_factory.mktemp("recordings") / "door-open-0"
    try:
        assert simulate_recording(folder, "door-open", 0, small())
    except MissingLibraryError as error:
        pytest.skip(str(error))
    return folder


@pytest.fixture(scope="module")
def noisy(clean: Path) -> Path:
    """The same with a Kinect's noise."""
    folder = clean.with_name("noisy")
    assert simulate_recording(folder, "door-open", 0, small(sensor=KINECT))
    return folder


class Still(Tracker):
    """Believes that nothing ever moves."""

    name = "still"
    license = "none"

    def open(self, clip: Clip) -> Session:
        raise AssertionError("the tests answer in its place")


Label = Callable[[Clip, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


@pytest.fixture
def answer(monkeypatch: pytest.MonkeyPatch) -> Callable[[Label], None]:
    """Puts a function (clip, queries) -> (xyz_cam, visible, sigma) in the place of the labeling."""

    def use(label: Label) -> None:
        def label_clip(clip: Clip, queries_xy: np.ndarray, *_: object) -> tuple[Tracks2D, Tracks3D]:
            xyz_cam, visible, sigma = label(clip, queries_xy)
            R, t = clip.camera.T_world_cam[:3, :3], clip.camera.T_world_cam[:3, 3]
            xyz_world, nothing = (xyz_cam.astype(float) @ R.T + t).astype(np.float32), np.zeros_like(sigma)
            quality = Quality(sigma, np.zeros(sigma.shape, np.uint8), visible, nothing, nothing, nothing)
            in_picture = Tracks2D(np.zeros((*visible.shape, 2), np.float32), visible, nothing)
            return in_picture, Tracks3D(xyz_world, visible, np.zeros(visible.shape[1], np.float32), quality)

        monkeypatch.setattr(grading, "label_clip", label_clip)

    return use


def held(clip: Clip, queries_xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every point where the first depth picture has it, for ever; a labeling that needs nothing but pictures."""
    x, y = queries_xy.astype(int).T
    at_camera = Camera(clip.camera.width, clip.camera.height, clip.camera.K, np.eye(4))
    first = at_camera.unproject(queries_xy, clip.depth[0][y, x]).astype(np.float32)
    shape = len(clip), len(first)
    return np.repeat(first[None], len(clip), 0), np.ones(shape, bool), np.full(shape, 0.01, np.float32)


def off_by(truth: GroundTruth, meters: float) -> Label:
    """The truth, moved towards the camera."""
    sigma = np.full(truth.visible.shape, 0.01, np.float32)
    return lambda *_: (truth.tracks_cam - np.float32([0, 0, meters]), truth.visible, sigma)


def grade_one(recording: Path) -> grading.RecordingGrade:
    return grade_recording(recording, Still(), ChunkSettings(), LiftSettings())


def depth_at(clip: Clip, truth: GroundTruth, shift: int = 0) -> np.ndarray:
    """How far behind the points (T - shift, N) the depth pictures of ``shift`` steps later see anything [m]."""
    tracks = truth.tracks_cam[: len(clip) - shift].astype(float)
    uv = np.rint(tracks[..., :2] / tracks[..., 2:] * np.diag(clip.camera.K)[:2] + clip.camera.K[:2, 2]).astype(int)
    u, v = uv[..., 0].clip(0, clip.camera.width - 1), uv[..., 1].clip(0, clip.camera.height - 1)
    return clip.depth[shift:][np.arange(len(tracks))[:, None], v, u] - tracks[..., 2]


def test_the_truth_is_what_the_pictures_show(clean: Path) -> None:
    clip, truth = read_clip(clean), ground_truth.read(clean)
    assert len(clip) == len(truth.tracks_cam) == STEPS
    assert np.abs(depth_at(clip, truth)[0]).max() < 2e-4, "queries lie on the surface: to depth units of 0.1 mm"
    pixel = truth.tracks_cam[0, :, :2] / truth.tracks_cam[0, :, 2:] * clip.camera.K[0, 0] + clip.camera.K[:2, 2]
    np.testing.assert_allclose(pixel, truth.query_px, atol=1e-3)
    behind = depth_at(clip, truth)[truth.visible]
    assert np.mean(np.abs(behind) < 0.012) > 0.9, "but at edges, a seen point is what its pixel shows"
    moved = np.linalg.norm(truth.tracks_cam - truth.tracks_cam[0], axis=-1) > 0.05
    assert moved.any()
    right, late = depth_at(clip, truth)[:-4], depth_at(clip, truth, 4)
    of = (truth.visible & moved)[:-4]
    assert np.mean(np.abs(right[of]) < 0.012) > np.mean(np.abs(late[of]) < 0.012) + 0.3, "this has power"
    hidden = ~truth.visible & (truth.tracks_cam[..., 2] > 0)
    assert np.mean(depth_at(clip, truth)[hidden] < 0.003) > 0.8, "what is out of sight has something before it"


def test_all_kinds_of_points_are_graded(clean: Path) -> None:
    role = ground_truth.read(clean).role
    assert role is not None
    share = {r: float((role == r).mean()) for r in Role}
    assert 90 <= len(role) <= 128
    assert 0.35 < share[Role.BACKGROUND] < 0.6
    assert share[Role.OBJECT] >= 0.2
    assert share[Role.ROBOT] > 0.1
    assert share[Role.MARKER] == 0


def test_a_clean_sensor_leaves_no_query_out_and_noise_some(clean: Path, noisy: Path) -> None:
    assert unusable_queries(clean) == 0
    left_out, truth, clip = unusable_queries(noisy), ground_truth.read(noisy), read_clip(noisy)
    assert left_out > 3
    assert len(truth.query_px) + left_out <= QueryMix().points
    off = np.abs(depth_at(clip, truth)[0])
    assert off.max() < UNUSABLE_M + 1e-4
    assert off.max() > 0.001
    assert (clip.depth == 0).mean() > (read_clip(clean).depth == 0).mean() + 0.01


def test_a_recording_is_made_once(clean: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(clean, tmp_path / "again"))
    before = files_below(folder)
    assert not simulate_recording(folder, "door-open", 0, small())
    assert files_below(folder) == before
    assert simulate_recording(folder, "door-open", 0, small(2))
    assert len(read_clip(folder)) == 2
    assert not list(tmp_path.glob(".tmp*"))


def test_the_same_settings_make_the_same_bytes(clean: Path, tmp_path: Path) -> None:
    content = []
    for name in ("once", "again"):
        simulate_recording(tmp_path / name, "door-open", 0, small(3, sensor=KINECT))
        content.append({file: of for file, (of, _) in files_below(tmp_path / name).items()})
    assert content[0] == content[1]


def test_a_folder_of_somebody_else_stays(tmp_path: Path) -> None:
    (tmp_path / "door-open-0").mkdir()
    (tmp_path / "door-open-0" / "precious.txt").write_text("keep")
    with pytest.raises(DataError, match="door-open-0: is in the way"):
        simulate_recording(tmp_path / "door-open-0", "door-open", 0, small())
    assert (tmp_path / "door-open-0" / "precious.txt").read_text() == "keep"


def test_a_crop_without_points_is_said(clean: Path, tmp_path: Path) -> None:
    nowhere = ObserverSettings(crop=Box(low=(5, 5, 5), high=(6, 6, 6)))
    with pytest.raises(DataError, match="no point of the first frame lies in the crop"):
        simulate_recording(tmp_path / "none", "door-open", 0, small(2, observer=nowhere))
    assert not list(tmp_path.iterdir())


def test_an_error_of_3_mm_is_3_mm(clean: Path, answer: Callable[[Label], None]) -> None:
    truth = ground_truth.read(clean)
    answer(off_by(truth, 0.003))
    result = grade_one(clean)
    m = result.metrics
    for group in (m.all, m.moving, m.object, m.occluded):
        assert group is not None
        assert group.n > 10
        assert group.median_mm == pytest.approx(3, abs=0.01)
        assert group.p95_mm == pytest.approx(3, abs=0.01)
    assert m.tapvid.occlusion_accuracy == 1
    assert m.calibration is not None
    assert m.calibration.within_1_sigma == 1
    assert (result.frames, result.queries, result.unusable_queries) == (STEPS, len(truth.query_px), 0)


def test_labeling_sees_nothing_but_pictures_and_pixels(
    clean: Path, tmp_path: Path, answer: Callable[[Label], None]
) -> None:
    """Without robot state, with other truth than its pixels: the same labels."""
    answer(held)
    labels = grade_one(clean).estimate
    stripped, truth = tmp_path / "stripped", ground_truth.read(clean)
    clip = read_clip(clean)
    other = replace(truth, tracks_cam=truth.tracks_cam + 1, visible=~truth.visible, role=None)
    write_rgbd_recording(
        stripped, rgb=clip.rgb, depth=clip.depth, camera=clip.camera, time_s=np.arange(STEPS) / 80,
        depth_unit_m=0.0001, **other.arrays(),
    )  # fmt: skip
    again = grade_one(stripped)
    assert (again.estimate.xyz_cam == labels.xyz_cam).all()
    assert again.metrics.moving is None
    assert again.metrics.all is not None
    assert again.metrics.all.median_mm > 1000


def test_grades_average_recordings_and_pool_calibration(
    clean: Path, noisy: Path, answer: Callable[[Label], None]
) -> None:
    answer(held)
    told: list[str] = []
    grades = grade_tracker(
        [clean, noisy], Still(), ChunkSettings(), LiftSettings(), report=lambda g: told.append(g.recording)
    )
    assert told == ["door-open-0", "noisy"]
    one, two = (g.metrics for g in grades.rows)
    assert one != two
    assert grades.mean.tapvid.apd == pytest.approx((one.tapvid.apd + two.tapvid.apd) / 2)
    assert grades.mean.calibration is not None
    assert one.calibration is not None
    assert two.calibration is not None
    assert grades.mean.calibration.n == one.calibration.n + two.calibration.n
    values = grades.to_json()
    assert values["tracker"] == "still"
    assert [r["recording"] for r in values["recordings"]] == told
    assert values["recordings"][1]["unusable_queries"] == unusable_queries(noisy)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"tracks_cam": slice(0, 5), "visible": slice(0, 5)}, r"'tracks_cam' has 5 frames, and the recording 40"),
        ({"query_px": np.array([[96.0, 3.0]])}, r"'query_px' has \(96, 3\), outside the picture of 96 x 72"),
    ],
)
def test_truth_of_other_pictures(clean: Path, tmp_path: Path, change: dict[str, Any], expected: str) -> None:
    folder = Path(shutil.copytree(clean, tmp_path / "other"))
    arrays = ground_truth.read(clean).arrays()
    for name, value in change.items():
        if isinstance(value, slice):
            arrays[name] = arrays[name][value]
        else:
            arrays[name][: len(value)] = value
    np.savez(folder / ground_truth.FILE_NAME, **arrays)
    with pytest.raises(DataError, match=expected):
        grade_one(folder)


def test_a_bad_picture_is_named(clean: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(clean, tmp_path / "bad"))
    picture = folder / "color" / "000007.png"
    picture.write_bytes(picture.read_bytes()[:500])
    with pytest.raises(DataError, match=r"1 of 40 frames are bad \(color/000007.png"):
        grade_one(folder)


def test_a_recording_of_ones_own_has_no_queries_left_out(clean: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(clean, tmp_path / "own"))
    (folder / MADE_WITH).unlink()
    assert unusable_queries(folder) == 0


def test_choosing_nothing_of_a_kind_is_possible(clean: Path, tmp_path: Path) -> None:
    mix = QueryMix(points=20, background_share=0, object_share=0)
    simulate_recording(tmp_path / "few", "door-open", 0, small(2, queries=mix))
    role = ground_truth.read(tmp_path / "few").role
    assert role is not None
    assert len(role) == 20
    assert Role.BACKGROUND not in role
