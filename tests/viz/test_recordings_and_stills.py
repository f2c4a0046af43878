"""Recordings and stills of a small episode made by hand: what they show is what the episode holds."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib.collections import EllipseCollection
from matplotlib.image import imread
from rerun.chunk import RrdReader
from synthetic import (
    LOOKING_ALONG_Y,
    call_cli,
    make_dataset,
    make_episode,
    make_filmed_episode,
    make_manifest,
    put_unit,
)

from flowlab.checksums import sha256_of
from flowlab.errors import DataError
from flowlab.geometry.camera import Camera
from flowlab.records import Entity, Episode, Queries, Role, Tracks3D
from flowlab.storage.dataset import begin
from flowlab.storage.receipts import Reject, shard_path
from flowlab.storage.shard import write_shard
from flowlab.viz.blueprint import make_blueprint
from flowlab.viz.captions import caption, describe, moving
from flowlab.viz.colors import ROLE_RGB, UNKNOWN, cloud_rgb_at
from flowlab.viz.orientation import up_from_world
from flowlab.viz.recorded_tracks import TRAIL_STEPS
from flowlab.viz.recording import write_rrd
from flowlab.viz.stated_error import sigma_rgb
from flowlab.viz.still import TIME_COLORS, draw_still, plot_still

T, P, M, DISTINCT_POINTS, DISTINCT_QUERIES = 30, 50, 8, 40, 6
FAR = 99.0
"""Where padding lies [m], for nobody to see."""
ROLES = [Role.ROBOT, Role.ROBOT, Role.OBJECT, Role.PROP, Role.BACKGROUND, UNKNOWN]
MOVING = [0, 1, 2]
PARTS = tuple(Entity(role.name, role.name, role) for role in Role)


@pytest.fixture
def episode() -> Episode:
    """The first two points rise, the third slides along x, the rest stand still; the camera looks along +y."""
    rng = np.random.default_rng(0)
    t = np.linspace(0, 1, T)
    xyz_world = np.tile(rng.uniform(-0.2, 0.2, (M, 3)), (T, 1, 1))
    xyz_world[:, :2, 2] += 0.3 * t[:, None]
    xyz_world[:, 2, 0] += 0.2 * t**2
    xyz_world[:, DISTINCT_QUERIES:] = FAR
    visible = np.ones((T, M), bool)
    visible[10:, 1] = False
    cloud = np.tile(rng.uniform(-0.3, 0.3, (P, 3)), (T, 1, 1))
    cloud[:, DISTINCT_POINTS:] = FAR
    T_world_cam = np.eye(4)
    T_world_cam[:3] = [[1, 0, 0, 0.05], [0, 0, 1, -1.0], [0, -1, 0, 0.1]]
    owner = np.array([*ROLES, UNKNOWN, UNKNOWN], np.int16)
    turn = np.stack([np.cos(t), np.sin(t), 0 * t, -np.sin(t), np.cos(t), 0 * t], -1)
    return Episode(
        task="slide",
        seed=7,
        camera=Camera.from_fovy(40, 30, 50.0, T_world_cam),
        time_s=np.arange(T) * 0.0125,
        point_cloud=cloud.astype(np.float32),
        point_count=np.full(T, DISTINCT_POINTS, np.int32),
        state=rng.normal(size=(T, 3)).astype(np.float32),
        action=rng.normal(size=(T, 2)).astype(np.float32),
        success=np.arange(T) >= 25,
        queries=Queries(xyz_world[0].astype(np.float32), owner, DISTINCT_QUERIES, PARTS),
        tracks=Tracks3D(xyz_world.astype(np.float32), visible, np.zeros(M, np.float32)),
        object_pose=np.concatenate([xyz_world[:, 2], turn], -1).astype(np.float32),
        depth=rng.uniform(0.5, 2, (T, 30, 40)).astype(np.float32),
        rgb=rng.integers(0, 255, (T, 30, 40, 3)).astype(np.uint8),
    )


@pytest.fixture
def bare(episode: Episode) -> Episode:
    """The same, as it comes back from most shards."""
    return replace(episode, depth=None, rgb=None, object_pose=None)


@pytest.fixture
def real() -> Episode:
    """From a recording, in the frame of its camera."""
    return make_filmed_episode()


def columns(path: Path, blueprint: bool = False, only: str = "") -> dict[tuple[str, str], list[Any]]:
    """The rows of every column of a recording or its blueprint, by entity and component; of some entities ``only``."""
    reader = RrdReader(path)
    store = (reader.blueprints() if blueprint else reader.recordings())[0]
    found = {}
    for chunk in reader.stream(store=store).to_chunks():
        if not chunk.entity_path.startswith(only):
            continue
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name not in ("rerun.controls.RowId", "blueprint", "log_time", "RecordingInfo:start_time"):
                found[chunk.entity_path, name] = batch.column(name).to_pylist()
    return found


def pictures(found: dict[tuple[str, str], list[Any]], entity: str, kind: str) -> list[np.ndarray]:
    """The decoded pictures of an entity."""
    return [cv2.imdecode(np.ravel(blob).astype(np.uint8), -1) for blob in found[entity, f"{kind}:blob"]]


def recorded(episode: Episode, tmp_path: Path) -> dict[tuple[str, str], list[Any]]:
    write_rrd(episode, tmp_path / "e.rrd", name="slide / seed 7", about="Made by hand.")
    return columns(tmp_path / "e.rrd")


@pytest.mark.parametrize("kind", ["episode", "bare", "real"])
def test_rerun_can_read_every_recording(kind: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    write_rrd(request.getfixturevalue(kind), tmp_path / "e.rrd", name="slide")
    rerun = Path(sys.executable).with_name("rerun")
    result = subprocess.run([rerun, "rrd", "verify", tmp_path / "e.rrd"], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_recorded_points_are_the_tracks_without_repeats(episode: Episode, tmp_path: Path) -> None:
    found = recorded(episode, tmp_path)
    points = np.array(found["/world/tracks/points", "Points3D:positions"])
    np.testing.assert_array_equal(points, episode.tracks.xyz_world[:, :DISTINCT_QUERIES])
    assert found["/world/tracks/points", "step"] == list(range(T))
    assert [round(t.total_seconds(), 6) for t in found["/world/tracks/points", "time"]][:3] == [0, 0.0125, 0.025]


def test_padding_of_the_cloud_is_left_out(episode: Episode, tmp_path: Path) -> None:
    few = replace(episode, point_count=np.arange(11, 11 + T, dtype=np.int32))
    clouds = recorded(few, tmp_path)["/world/cloud", "Points3D:positions"]
    for t, cloud in enumerate(clouds):
        np.testing.assert_array_equal(cloud, few.point_cloud[t, : 11 + t])


def test_trails_follow_moving_points_for_a_while(episode: Episode, tmp_path: Path) -> None:
    strips = recorded(episode, tmp_path)["/world/tracks/trails", "LineStrips3D:strips"]
    assert strips[0] == []
    for t in (15, T - 1):
        for strip, k in zip(strips[t], MOVING, strict=True):
            np.testing.assert_array_equal(strip, episode.tracks.xyz_world[max(0, t - TRAIL_STEPS) : t + 1, k])


def test_colors_tell_roles_and_hidden_points_are_darker(episode: Episode, tmp_path: Path) -> None:
    packed = np.array(recorded(episode, tmp_path)["/world/tracks/points", "Points3D:colors"], np.uint32)
    rgb = np.stack([packed >> 24, packed >> 16 & 255, packed >> 8 & 255], -1)
    np.testing.assert_array_equal(rgb[0], [ROLE_RGB[role] for role in ROLES])
    assert (rgb[10:, 1] < 0.6 * rgb[9, 1]).all()


def test_camera_and_object_stand_where_they_are(episode: Episode, tmp_path: Path) -> None:
    found = recorded(episode, tmp_path)
    camera = "/world/camera/main"
    K, R = (np.reshape(found[camera, c][0], (3, 3)).T for c in ("Pinhole:image_from_camera", "Transform3D:mat3x3"))
    np.testing.assert_allclose(K, episode.camera.K, rtol=1e-6)
    np.testing.assert_allclose(R, episode.camera.T_world_cam[:3, :3], atol=1e-6)
    np.testing.assert_allclose(found[camera, "Transform3D:translation"][0][0], [0.05, -1, 0.1], atol=1e-6)
    R_object = np.reshape(found["/world/object", "Transform3D:mat3x3"][T - 1], (3, 3)).T
    np.testing.assert_allclose(R_object @ [1, 0, 0], [np.cos(1), np.sin(1), 0], atol=1e-6)


def test_pictures_and_scalars_are_kept(episode: Episode, tmp_path: Path) -> None:
    found = recorded(episode, tmp_path)
    assert episode.depth is not None
    assert episode.rgb is not None
    depth_mm = np.stack(pictures(found, "/depth", "EncodedDepthImage"))
    np.testing.assert_allclose(depth_mm / 1000, episode.depth, atol=5.1e-4)
    shown = np.stack(pictures(found, "/world/camera/main/rgb", "EncodedImage"))[..., ::-1]
    smooth = [
        cv2.GaussianBlur(np.asarray(x, np.float32), (0, 0), 4) for x in (*shown, *episode.rgb)
    ]  # JPEG keeps those
    np.testing.assert_allclose(smooth[:T], smooth[T:], atol=12)
    for kind, values in (("state", episode.state), ("action", episode.action)):
        read = [np.ravel(found[f"/scalars/{kind}/{k}", "Scalars:scalars"]) for k in range(values.shape[1])]
        np.testing.assert_array_equal(np.transpose(read), values)
    np.testing.assert_array_equal(np.ravel(found["/scalars/success", "Scalars:scalars"]), episode.success)


def test_pictures_of_a_camera_that_hangs_upside_down_are_upright_and_fit_the_scene(
    episode: Episode, tmp_path: Path
) -> None:
    turned = episode.camera.T_world_cam.copy()
    turned[:3, :2] *= -1
    hanging = replace(episode, camera=replace(episode.camera, T_world_cam=turned))
    found, camera = recorded(hanging, tmp_path), "/world/camera/main"
    assert hanging.depth is not None
    np.testing.assert_allclose(
        pictures(found, "/depth", "EncodedDepthImage")[3] / 1000, hanging.depth[3, ::-1, ::-1], atol=5.1e-4
    )
    K, R = (np.reshape(found[camera, c][0], (3, 3)).T for c in ("Pinhole:image_from_camera", "Transform3D:mat3x3"))
    origin = found[camera, "Transform3D:translation"][0][0]
    seen = K @ R.T @ ([0.1, 0.2, 0.15] - np.array(origin))  # a point, as the viewer projects it
    uv, _ = hanging.camera.project(np.array([[0.1, 0.2, 0.15]]))
    np.testing.assert_allclose(
        seen[:2] / seen[2], [39, 29] - uv[0], atol=1e-4
    )  # as in the picture turned by 180 degrees


def test_a_long_episode_with_large_pictures_is_a_small_recording(episode: Episode, tmp_path: Path) -> None:
    steps = np.arange(200) % T
    v, u = np.mgrid[:480, :640]
    waves = np.tile((127 + 100 * np.sin(u / 40 + v / 90)).astype(np.uint8), (len(steps), 1, 1))
    long = replace(
        episode,
        **{name: getattr(episode, name)[steps] for name in ("state", "action", "success", "object_pose")},
        time_s=np.arange(len(steps)) / 64,
        tracks=replace(
            episode.tracks, xyz_world=episode.tracks.xyz_world[steps], visible=episode.tracks.visible[steps]
        ),
        point_cloud=np.random.default_rng(1).normal(size=(len(steps), 1024, 3)).astype(np.float32),
        point_count=np.full(len(steps), 1024, np.int32),
        camera=replace(episode.camera, width=640, height=480),
        rgb=np.repeat(waves[..., None], 3, -1),
        depth=waves.astype(np.float32) / 100,
    )
    write_rrd(long, tmp_path / "e.rrd", name="long")
    assert (tmp_path / "e.rrd").stat().st_size < 5e6
    found = columns(tmp_path / "e.rrd", only="/world/camera/main")
    assert pictures(found, "/world/camera/main/rgb", "EncodedImage")[0].shape == (240, 320, 3)
    assert found["/world/camera/main", "Pinhole:resolution"][0][0] == [320, 240]
    assert found["/world/camera/main/rgb", "step"] == list(range(0, 200, 2))


def test_depth_is_not_unprojected_into_the_scene(episode: Episode, tmp_path: Path) -> None:
    recorded(episode, tmp_path)
    layout = columns(tmp_path / "e.rrd", blueprint=True)
    kinds = {entity: rows[0][0] for (entity, name), rows in layout.items() if name.endswith(":class_identifier")}
    (scene,) = [entity for entity, kind in kinds.items() if kind == "3D"]
    (shown,) = [rows[0] for (e, name), rows in layout.items() if e.startswith(scene) and name.endswith(":query")]
    assert "+ /world/**" in shown
    assert "- /world/camera/main/rgb/**" in shown
    assert not [e for e, _ in columns(tmp_path / "e.rrd") if "depth" in e and e.startswith("/world")]


def test_views_of_pictures_only_where_there_are_some(episode: Episode, bare: Episode, tmp_path: Path) -> None:
    for e, expected in ((episode, 2), (bare, 0)):
        found = recorded(e, tmp_path)
        layout = columns(tmp_path / "e.rrd", blueprint=True)
        kinds = [rows[0][0] for (_, name), rows in layout.items() if name.endswith(":class_identifier")]
        assert kinds.count("2D") == expected
        assert kinds.count("TimeSeries") == 2
        assert len({entity for entity, _ in found if entity in ("/world/camera/main/rgb", "/depth")}) == expected
        assert (("/world/object", "Transform3D:translation") in found) == (e is episode)


def test_info_says_whose_recording_it_is(episode: Episode, tmp_path: Path) -> None:
    found = recorded(episode, tmp_path)
    text = found["/info", "TextDocument:text"][0][0]
    assert text == f"Made by hand.\n\n{describe(episode)}"
    assert "| cloud points | 40 |" in text
    assert "| cloud points | 11 to 40 |" in describe(replace(episode, point_count=np.arange(11, 41, dtype=np.int32)))
    for fact in ("slide", "7", "2 robot, 1 object, 1 prop", "1 background", "1 unknown", "5 steps, first at 25"):
        assert fact in text
    assert found["/__properties", "RecordingInfo:name"] == [["slide / seed 7"]]


def test_a_failure_leaves_the_old_file_alone(episode: Episode, tmp_path: Path) -> None:
    broken = replace(episode, queries=replace(episode.queries))
    nobody = np.full(M, 77, np.int16)  # an owner that is not among the entities
    object.__setattr__(broken.queries, "owner", nobody)  # which no record would take
    (tmp_path / "e.rrd").write_text("old")
    (tmp_path / "e.png").write_text("old")
    with pytest.raises(IndexError):
        write_rrd(broken, tmp_path / "e.rrd", name="broken")
    with pytest.raises(IndexError):
        draw_still(broken, tmp_path / "e.png", title="broken")
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"e.rrd": "old", "e.png": "old"}


def test_nothing_is_left_where_the_file_cannot_be_put(episode: Episode, tmp_path: Path) -> None:
    for name in ("e.rrd", "e.png"):
        (tmp_path / name).mkdir()
    with pytest.raises(DataError, match="rrd"):
        write_rrd(episode, tmp_path / "e.rrd", name="slide")
    with pytest.raises(DataError, match="png"):
        draw_still(episode, tmp_path / "e.png", title="slide")
    assert {p.name for p in tmp_path.iterdir()} == {"e.rrd", "e.png"}


def picture(episode: Episode, path: Path) -> np.ndarray:
    """A still's pixels, 0 to 255."""
    draw_still(episode, path, title="slide")
    return np.round(imread(path)[..., :3] * 255)


def colors_at(image: np.ndarray, episode: Episode, panel: int, place: np.ndarray) -> np.ndarray:
    """The 5 x 5 pixels of the image around a place in the coordinates of a panel."""
    figure = plot_still(episode, "slide")
    x, y = figure.axes[panel].transData.transform(place)
    row, column = round(len(image) - y), round(x)
    return image[row - 2 : row + 3, column - 2 : column + 3].reshape(-1, 3)


def test_still_has_its_size_without_optional_arrays(bare: Episode, tmp_path: Path) -> None:
    assert picture(bare, tmp_path / "e.png").shape == (960, 1800, 3)


@pytest.mark.parametrize("t", [8, 20])
def test_tracks_are_drawn_where_the_points_are_at_that_time(episode: Episode, tmp_path: Path, t: int) -> None:
    image = picture(episode, tmp_path / "e.png")
    expected = 255 * np.array(TIME_COLORS((t + 0.5) / (T - 1))[:3])
    for k in (0, 2):
        xyz_world = episode.tracks.xyz_world[t, k]
        uv, _ = episode.camera.project(xyz_world)
        for panel, place in ((0, uv), (1, xyz_world[[0, 2]])):
            error = np.abs(colors_at(image, episode, panel, place) - expected).max(-1)
            assert error.min() < 12, f"point {k}, panel {panel}: {error.min()} off"


def test_only_moving_points_have_trails_and_ends(episode: Episode, tmp_path: Path) -> None:
    still = np.repeat(episode.tracks.xyz_world[:1], T, 0)
    motionless = replace(episode, tracks=replace(episode.tracks, xyz_world=still))
    for share in (0.5, 1.0):  # of the time: on the way, and at the end
        color = 255 * np.array(TIME_COLORS(share)[:3])
        painted = [
            int((np.abs(picture(e, tmp_path / "e.png")[:830, :900] - color).max(-1) < 20).sum())
            for e in (episode, motionless)
        ]
        assert painted[0] > 20
        assert painted[1] == 0


def test_padding_does_not_show_in_stills(episode: Episode, tmp_path: Path) -> None:
    cloud, tracks = episode.point_cloud.copy(), episode.tracks.xyz_world.copy()
    cloud[:, DISTINCT_POINTS:] = tracks[:, DISTINCT_QUERIES:] = 0
    other = replace(episode, point_cloud=cloud, tracks=replace(episode.tracks, xyz_world=tracks))
    np.testing.assert_array_equal(picture(episode, tmp_path / "a.png"), picture(other, tmp_path / "b.png"))


def test_a_camera_that_hangs_upside_down_sees_the_same(episode: Episode, tmp_path: Path) -> None:
    turned = episode.camera.T_world_cam @ np.diag([-1.0, -1, 1, 1])
    hanging = replace(episode, camera=replace(episode.camera, T_world_cam=turned))
    upright, hung = picture(episode, tmp_path / "a.png"), picture(hanging, tmp_path / "b.png")
    np.testing.assert_array_equal(upright[150:830, :800], hung[150:830, :800])


def test_one_frame_is_enough(episode: Episode, tmp_path: Path) -> None:
    names = ["time_s", "point_cloud", "point_count", "state", "action", "success", "object_pose", "depth", "rgb"]
    tracks = replace(episode.tracks, xyz_world=episode.tracks.xyz_world[:1], visible=episode.tracks.visible[:1])
    one = replace(episode, tracks=tracks, **{name: getattr(episode, name)[:1] for name in names})
    assert recorded(one, tmp_path)["/world/tracks/points", "step"] == [0]
    assert picture(one, tmp_path / "e.png").shape == (960, 1800, 3)


def test_estimated_tracks_are_colored_by_their_error(real: Episode, tmp_path: Path) -> None:
    assert real.tracks.quality is not None
    packed = np.array(recorded(real, tmp_path)["/world/tracks/points", "Points3D:colors"], np.uint32)
    rgb = np.stack([packed >> 24, packed >> 16 & 255, packed >> 8 & 255], -1)
    expected = sigma_rgb(real.tracks.quality.sigma[:, :5])
    np.testing.assert_array_equal(rgb[:, :2], expected[:, :2])  # in sight
    assert (rgb[:, 2:] < 0.6 * expected[:, 2:]).all()
    assert np.abs(expected[0, 0].astype(int) - expected[0, 1]).max() > 100


def test_error_and_visibility_are_plotted_over_time(real: Episode, tmp_path: Path) -> None:
    assert real.tracks.quality is not None
    rng = np.random.default_rng(0)
    sigma = rng.uniform(0, 0.05, real.tracks.visible.shape).astype(np.float32)
    visible = rng.random(sigma.shape) < 0.5
    tracks = replace(real.tracks, visible=visible, quality=replace(real.tracks.quality, sigma=sigma))
    found = recorded(replace(real, tracks=tracks), tmp_path)
    read = {
        key: np.ravel(found[f"/scalars/quality/{key}", "Scalars:scalars"])
        for key in ("sigma_median", "sigma_p90", "sigma_below", "visible")
    }
    in_order = 1000 * np.sort(sigma[:, :5], 1)  # the sixth repeats one of them
    np.testing.assert_allclose(read["sigma_median"], in_order[:, 2], rtol=1e-5)
    np.testing.assert_allclose(read["sigma_p90"], 0.4 * in_order[:, 3] + 0.6 * in_order[:, 4], rtol=1e-5)
    np.testing.assert_allclose(read["sigma_below"], 100 * (sigma[:, :5] < 0.02).mean(1), rtol=1e-5)
    np.testing.assert_allclose(read["visible"], 100 * visible[:, :5].sum(1) / 5, rtol=1e-5)
    kinds = [rows[0][0] for (_, name), rows in columns(tmp_path / "e.rrd", True).items() if "class_id" in name]
    assert kinds.count("TimeSeries") == 3


def test_checks_of_a_recording_have_a_panel(real: Episode, tmp_path: Path) -> None:
    assert ("/checks", "TextDocument:text") not in recorded(real, tmp_path)
    checks = [
        {"about": "clock", "verdict": "ok", "says": "fine"},
        {"about": "x", "verdict": "doubtful", "says": "<b>|"},
    ]
    found = recorded(replace(real, extras={**real.extras, "reader": "plain", "checks": checks}), tmp_path)
    text = found["/checks", "TextDocument:text"][0][0]
    assert text.splitlines()[2:] == [r"| doubtful | x | \<b\>\| |", "| ok | clock | fine |"]


def test_info_says_who_tracked_and_how_well(real: Episode) -> None:
    text = describe(real)
    for row in (
        "| recording | pour-3 |",
        "| tracker | rigid-bodies |",
        "| its license | Apache-2.0 |",
        "| positions | 40% measured, 40% model, 20% filled |",
        "| stated error | σ median 20 mm, p90 60 mm |",
    ):
        assert row in text
    assert r"| stated below | σ \< 5 mm 20%, \< 10 mm 20%, \< 20 mm 20%, \< 50 mm 80% |" in text
    assert "tracker rigid-bodies: σ median 20 mm" in caption(real, 1)
    assert "exact" not in caption(real, 1)
    assert "exact tracks" in caption(replace(real, tracks=replace(real.tracks, quality=None)), 1)
    assert "tracker" not in describe(replace(real, tracks=replace(real.tracks, quality=None)))
    nobody = describe(replace(real, extras={}))
    assert "| tracker | not known |" in nobody


def test_what_moves_must_move_beyond_its_stated_error(real: Episode) -> None:
    assert real.tracks.quality is not None
    assert moving(real).tolist() == [True, False, False, False, False]  # the second by 17 cm, if with 2 x 8.5 cm
    sure = replace(real.tracks.quality, sigma=np.full_like(real.tracks.quality.sigma, 0.001))
    assert moving(replace(real, tracks=replace(real.tracks, quality=sure)))[:2].all()


def test_in_the_frame_of_the_camera_up_is_against_y(real: Episode, episode: Episode, tmp_path: Path) -> None:
    for e, up in ((real, [0, -1, 0]), (episode, [0, 0, 1])):
        np.testing.assert_array_equal(up_from_world(e.camera) @ up, [0, 0, 1])
        recorded(e, tmp_path)
        shown = columns(tmp_path / "e.rrd", blueprint=True)
        (eye_up,) = [rows[0][0] for (_, name), rows in shown.items() if name == "EyeControls3D:eye_up"]
        np.testing.assert_array_equal(eye_up, up)
        (plane,) = [rows[0][0] for (_, name), rows in shown.items() if name == "LineGrid3D:plane"]
        normal, distance = np.array(plane[:3]), plane[3]
        np.testing.assert_array_equal(normal, up)
        points = e.tracks.xyz_world[:, : e.queries.count].reshape(-1, 3) @ normal
        assert distance <= np.percentile(points, 2)  # the floor lies below
        (eye,) = [rows[0][0] for (_, name), rows in shown.items() if name == "EyeControls3D:position"]
        assert eye @ normal > points.max()  # and is looked at from above


def test_recordings_say_which_axis_is_up(real: Episode, episode: Episode, tmp_path: Path) -> None:
    up, down = 1, 2  # Rerun's numbers
    for e, axis, way in ((real, 1, down), (episode, 2, up)):
        (axes,) = recorded(e, tmp_path)["/", "ViewCoordinates:xyz"]
        assert axes[0][axis] == way


def test_a_layout_has_no_plot_of_nothing(real: Episode, tmp_path: Path) -> None:
    idle = replace(real, state=np.zeros((12, 0), np.float32), action=np.zeros((12, 0), np.float32))
    found = recorded(idle, tmp_path)
    assert not any(entity.startswith(("/scalars/state", "/scalars/action")) for entity, _ in found)
    kinds = [rows[0][0] for (_, name), rows in columns(tmp_path / "e.rrd", True).items() if "class_id" in name]
    assert kinds.count("TimeSeries") == 2


def test_a_lost_point_does_not_shrink_the_scene() -> None:
    long = make_filmed_episode(steps=300)
    xyz_world = long.tracks.xyz_world.copy()
    xyz_world[200:202, 2] = 500
    lost = replace(long, tracks=replace(long.tracks, xyz_world=xyz_world))
    for e in (long, lost):
        spans = [np.ptp(plot_still(e, "").axes[k].get_xlim()) for k in (0, 1)]
        assert spans[0] < 2000
        assert spans[1] < 10
        eye = make_blueprint(e).root_container.contents[0].properties["EyeControls3D"]  # type: ignore[union-attr]
        assert np.abs(eye.position.as_arrow_array().to_pylist()).max() < 10


def test_clouds_of_recordings_have_the_colors_of_the_picture(real: Episode, episode: Episode) -> None:
    assert real.rgb is not None
    real.rgb[3, 2, 10] = (200, 10, 30)
    rgb = cloud_rgb_at(real, 3)
    expected = np.full((len(rgb), 3), 128)
    expected[1] = (200, 10, 30)  # the second point of the wall was seen at u = 10, v = 2
    np.testing.assert_array_equal(rgb, expected)
    behind = real.point_cloud.copy()
    behind[3, :2] = [[0, 0, -1], [50, 0, 1]]
    assert len(np.unique(cloud_rgb_at(replace(real, point_cloud=behind), 3), axis=0)) == 2  # gray for these
    assert not (cloud_rgb_at(episode, 0) == 128).all()


def test_stills_of_recordings_are_upright(real: Episode) -> None:
    figure = plot_still(real, "pour")
    camera, side = figure.axes[:2]
    assert (side.get_xlabel(), side.get_ylabel()) == ("z [m]", "−y [m]")
    points = np.concatenate(
        [c.get_offsets() for c in side.collections if len(c.get_offsets()) == len(real.point_cloud[0])]
    )
    np.testing.assert_allclose(np.sort(points[:, 1]), np.sort(-real.point_cloud[0, :, 1]), atol=1e-6)
    assert side.get_ylim()[1] > side.get_ylim()[0]
    assert camera.get_ylim()[1] < camera.get_ylim()[0]
    placed = make_filmed_episode(LOOKING_ALONG_Y)
    assert plot_still(placed, "pour").axes[1].get_ylabel() == "z [m]"


def test_stills_of_recordings_show_the_error(real: Episode, tmp_path: Path) -> None:
    image = picture(real, tmp_path / "e.png")
    for k in (2, 3):  # those that stand still have dots only
        expected = 0.88 * sigma_rgb(np.array([0.02]))[0]
        uv, _ = real.camera.project(real.tracks.xyz_world[0, k])
        assert np.abs(colors_at(image, real, 0, uv) - expected).max(-1).min() < 12
    figure = plot_still(real, "pour")
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts[:5] == ["σ < 5 mm: 20%", "< 10 mm: 20%", "< 20 mm: 20%", "< 50 mm: 80%", "≥ 50 mm: 20%"]
    assert texts[5:] == ["start", "end", "end, out of sight", "radius σ, 20 to 50 mm"]
    np.testing.assert_allclose([bar.get_height() for bar in figure.axes[2].patches], [0.2, 0, 0, 0.6, 0.2])


def test_trails_of_recordings_are_colored_by_error_and_faint_where_it_is_large(real: Episode) -> None:
    assert real.tracks.quality is not None
    sigma = real.tracks.quality.sigma.copy()
    sigma[:, 0] = [0.001] * 4 + [0.007] * 4 + [0.03] * 4
    tracks = replace(real.tracks, quality=replace(real.tracks.quality, sigma=sigma))
    camera, side = plot_still(replace(real, tracks=tracks), "pour").axes[:2]
    for axes, unit in ((camera, real.camera.K[0, 0]), (side, 1.0)):
        trail, circles = axes.collections[2:4]
        found = np.asarray(trail.get_edgecolor())
        np.testing.assert_allclose(found[:, :3], 0.88 * sigma_rgb(sigma[1:, 0]) / 255)
        np.testing.assert_allclose(found[:, 3], [1.0] * 7 + [0.3] * 4)
        assert isinstance(circles, EllipseCollection)
        np.testing.assert_allclose(circles.get_widths(), [2 * 0.03 * unit], rtol=1e-3)
    sure = replace(real.tracks.quality, sigma=np.full_like(sigma, 0.001))
    camera = plot_still(replace(real, tracks=replace(tracks, quality=sure)), "pour").axes[0]
    (circles,) = [c for c in camera.collections if isinstance(c, EllipseCollection)]
    assert len(circles.get_widths()) == 0


def test_large_stated_errors_are_spheres_in_the_recording(real: Episode, tmp_path: Path) -> None:
    half_sizes = recorded(real, tmp_path)["/world/tracks/errors", "Ellipsoids3D:half_sizes"]
    np.testing.assert_allclose(half_sizes[0], np.repeat([[0.05], [0.02], [0.02], [0.02]], 3, axis=1))
    exact = replace(real, tracks=replace(real.tracks, quality=None))
    assert ("/world/tracks/errors", "Ellipsoids3D:half_sizes") not in recorded(exact, tmp_path)


def test_a_note_stands_in_the_still(real: Episode) -> None:
    texts = [text.get_text() for text in plot_still(real, "pour", note="too poor " * 60).texts]
    (note,) = [text for text in texts if text.startswith("too poor")]
    assert note.endswith("…")
    assert len(note) <= 170


@pytest.fixture
def pours(tmp_path: Path) -> Path:
    """One good episode and two rejects, of which one left nothing to look at."""
    folder = tmp_path / "data"
    manifest = begin(folder, make_manifest({"pour": 3}))
    rejects = (
        Reject(task="pour", seed=4, stage="recording", reason="no frame is whole"),
        Reject(task="pour", seed=5, stage="quality", reason="too unsure", position=0),
    )
    kept = folder / shard_path("rejects", "pour-000003-000003")
    write_shard(kept, [make_filmed_episode(seed=5)], manifest.settings_digest)
    known = {"seeds": (3, 4, 5), "rejects": rejects, "rejects_sha256": sha256_of(kept)}
    put_unit(folder, [make_filmed_episode()], manifest.settings_digest, **known)
    return folder


def test_films_from_the_command_line(pours: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    code, out, _ = call_cli(capsys, "viz", pours, "--mp4", tmp_path / "e.mp4")
    assert (code, out) == (0, f"pour seed 3: {tmp_path / 'e.mp4'}\n")
    assert (tmp_path / "e.mp4").read_bytes()[4:8] == b"ftyp"
    assert {p.name for p in tmp_path.iterdir()} == {"data", "e.mp4"}  # no recording unless asked for
    code, _, errors = call_cli(capsys, "viz", pours, "--fps", "5")
    assert code == 2
    assert "--mp4" in errors


def test_rejects_can_be_looked_at(pours: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    code, out, _ = call_cli(
        capsys, "viz", pours, "--rejects", "--episode", "1", "--task", "pour", "--png", tmp_path / "e.png",
        "--mp4", tmp_path / "e.mp4", "--save", tmp_path / "e.rrd",
    )  # fmt: skip
    assert code == 0
    assert out.splitlines()[0] == "pour seed 5 was rejected at quality: too unsure"
    assert (tmp_path / "e.png").exists()
    found = columns(tmp_path / "e.rrd")
    assert "rejected at quality: too unsure" in found["/info", "TextDocument:text"][0][0]
    assert found["/__properties", "RecordingInfo:name"] == [["pour seed 5 (rejected)"]]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rejects"], "pour seed 4 was rejected at recording (no frame is whole)"),
        (["--rejects", "--episode", "2"], "no reject 2; there are 2, counted from 0"),
        (["--rejects", "--task", "push"], "task 'push': no reject 0; there are 0"),
        (["--episode", "1"], "no episode 1; there are 1, counted from 0"),
    ],
)
def test_what_cannot_be_shown_is_one_sentence(
    arguments: list[str], message: str, pours: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, errors = call_cli(capsys, "viz", pours, *arguments)
    assert (code, out) == (3, "")
    assert message in " ".join(errors.split())


def test_a_dataset_without_pictures_has_no_film(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    make_dataset(tmp_path / "data", [[make_episode()]])
    code, _, errors = call_cli(capsys, "viz", tmp_path / "data", "--mp4", tmp_path / "e.mp4")
    assert code == 3
    assert "write.depth=true" in errors


@pytest.mark.parametrize("option", ["--png", "--save", "--mp4"])
def test_a_place_that_cannot_be_written_is_one_sentence(
    option: str, pours: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    code, _, errors = call_cli(capsys, "viz", pours, option, tmp_path / "file" / "picture")
    assert code == 3
    assert "file/picture: cannot be written" in "".join(errors.splitlines())
