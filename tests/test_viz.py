"""Recordings and stills of a small episode made by hand: what they show is what the episode holds."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Cli
from matplotlib.image import imread
from rerun.chunk import RrdReader

from flowlab.geometry.camera import Camera
from flowlab.records import Entity, Episode, Queries, Role, Tracks3D
from flowlab.viz.colours import ROLE_RGB, UNKNOWN
from flowlab.viz.facts import describe
from flowlab.viz.recording import TRAIL_STEPS, write_recording
from flowlab.viz.still import TIME_COLOURS, compose, draw_still

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


def columns(path: Path, blueprint: bool = False) -> dict[tuple[str, str], list[Any]]:
    """The rows of every column of a recording or its blueprint, by entity and component."""
    reader = RrdReader(path)
    store = (reader.blueprints() if blueprint else reader.recordings())[0]
    found = {}
    for chunk in reader.stream(store=store).to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name not in ("rerun.controls.RowId", "blueprint", "log_time", "RecordingInfo:start_time"):
                found[chunk.entity_path, name] = batch.column(name).to_pylist()
    return found


def recorded(episode: Episode, tmp_path: Path) -> dict[tuple[str, str], list[Any]]:
    write_recording(episode, tmp_path / "e.rrd", name="slide / seed 7", about="Made by hand.")
    return columns(tmp_path / "e.rrd")


@pytest.mark.parametrize("kind", ["episode", "bare"])
def test_rerun_can_read_every_recording(kind: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    write_recording(request.getfixturevalue(kind), tmp_path / "e.rrd", name="slide")
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


def test_colours_tell_roles_and_hidden_points_are_darker(episode: Episode, tmp_path: Path) -> None:
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
    depth_mm = np.array(found["/world/camera/main/depth", "DepthImage:buffer"], np.uint8).view(np.uint16)
    np.testing.assert_allclose(depth_mm.reshape(T, 30, 40) / 1000, episode.depth, atol=5.1e-4)
    np.testing.assert_array_equal(
        np.reshape(found["/world/camera/main/rgb", "Image:buffer"], episode.rgb.shape), episode.rgb
    )
    for kind, values in (("state", episode.state), ("action", episode.action)):
        read = [np.ravel(found[f"/scalars/{kind}/{k}", "Scalars:scalars"]) for k in range(values.shape[1])]
        np.testing.assert_array_equal(np.transpose(read), values)
    np.testing.assert_array_equal(np.ravel(found["/scalars/success", "Scalars:scalars"]), episode.success)


def test_depth_is_not_unprojected_into_the_scene(episode: Episode, tmp_path: Path) -> None:
    recorded(episode, tmp_path)
    layout = columns(tmp_path / "e.rrd", blueprint=True)
    kinds = {entity: rows[0][0] for (entity, name), rows in layout.items() if name.endswith(":class_identifier")}
    (scene,) = [entity for entity, kind in kinds.items() if kind == "3D"]
    (shown,) = [rows[0] for (e, name), rows in layout.items() if e.startswith(scene) and name.endswith(":query")]
    assert "+ /world/**" in shown
    assert {"- /world/camera/main/depth/**", "- /world/camera/main/rgb/**"} <= set(shown)


def test_views_of_pictures_only_where_there_are_some(episode: Episode, bare: Episode, tmp_path: Path) -> None:
    for e, expected in ((episode, 2), (bare, 0)):
        found = recorded(e, tmp_path)
        layout = columns(tmp_path / "e.rrd", blueprint=True)
        kinds = [rows[0][0] for (_, name), rows in layout.items() if name.endswith(":class_identifier")]
        assert kinds.count("2D") == expected
        assert kinds.count("TimeSeries") == 2
        assert len({entity for entity, _ in found if entity.startswith("/world/camera/main/")}) == expected
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
    nobody = np.full(M, 77, np.int16)  # an owner that is not among the entities
    broken = replace(episode, queries=replace(episode.queries, owner=nobody))
    (tmp_path / "e.rrd").write_text("old")
    (tmp_path / "e.png").write_text("old")
    with pytest.raises(IndexError):
        write_recording(broken, tmp_path / "e.rrd", name="broken")
    with pytest.raises(IndexError):
        draw_still(broken, tmp_path / "e.png", title="broken")
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"e.rrd": "old", "e.png": "old"}


def test_nothing_is_left_where_the_file_cannot_be_put(episode: Episode, tmp_path: Path) -> None:
    for name in ("e.rrd", "e.png"):
        (tmp_path / name).mkdir()
    with pytest.raises(OSError, match="rrd"):
        write_recording(episode, tmp_path / "e.rrd", name="slide")
    with pytest.raises(OSError, match="png"):
        draw_still(episode, tmp_path / "e.png", title="slide")
    assert {p.name for p in tmp_path.iterdir()} == {"e.rrd", "e.png"}


def picture(episode: Episode, path: Path) -> np.ndarray:
    """A still's pixels, 0 to 255."""
    draw_still(episode, path, title="slide")
    return np.round(imread(path)[..., :3] * 255)


def colours_at(image: np.ndarray, episode: Episode, panel: int, place: np.ndarray) -> np.ndarray:
    """The 5 x 5 pixels of the image around a place in the coordinates of a panel."""
    figure = compose(episode, "slide")
    x, y = figure.axes[panel].transData.transform(place)
    row, column = round(len(image) - y), round(x)
    return image[row - 2 : row + 3, column - 2 : column + 3].reshape(-1, 3)


def test_still_has_its_size_without_optional_arrays(bare: Episode, tmp_path: Path) -> None:
    assert picture(bare, tmp_path / "e.png").shape == (960, 1800, 3)


@pytest.mark.parametrize("t", [8, 20])
def test_tracks_are_drawn_where_the_points_are_at_that_time(episode: Episode, tmp_path: Path, t: int) -> None:
    image = picture(episode, tmp_path / "e.png")
    expected = 255 * np.array(TIME_COLOURS((t + 0.5) / (T - 1))[:3])
    for k in (0, 2):
        xyz_world = episode.tracks.xyz_world[t, k]
        uv, _ = episode.camera.project(xyz_world)
        for panel, place in ((0, uv), (1, xyz_world[[0, 2]])):
            error = np.abs(colours_at(image, episode, panel, place) - expected).max(-1)
            assert error.min() < 12, f"point {k}, panel {panel}: {error.min()} off"


def test_only_moving_points_have_trails_and_ends(episode: Episode, tmp_path: Path) -> None:
    still = np.repeat(episode.tracks.xyz_world[:1], T, 0)
    motionless = replace(episode, tracks=replace(episode.tracks, xyz_world=still))
    for share in (0.5, 1.0):  # of the time: on the way, and at the end
        colour = 255 * np.array(TIME_COLOURS(share)[:3])
        painted = [
            int((np.abs(picture(e, tmp_path / "e.png")[:830, :900] - colour).max(-1) < 20).sum())
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


@pytest.mark.parametrize("option", ["--png", "--save"])
def test_a_place_that_cannot_be_written_is_one_sentence(
    option: str, flowlab: Cli, small_dataset: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    result = flowlab("viz", small_dataset, option, tmp_path / "file" / "picture")
    assert result.returncode == 1
    assert "file/picture: cannot be written" in result.stderr
    assert "Traceback" not in result.stderr
