"""What recordings, films and stills show of predicted flow, on an episode and plans made by hand."""

import subprocess
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from matplotlib.image import imread
from test_recordings_and_stills import columns

from flowlab.errors import DataError
from flowlab.geometry.camera import Camera
from flowlab.records import Entity, Episode, FlowPrediction, Queries, Role, Tracks3D
from flowlab.viz.colors import PREDICTED_RGB, ROLE_RGB, cloud_rgb
from flowlab.viz.flow_prediction import draw_flow_prediction, plot_flow_prediction
from flowlab.viz.panels import TIME_COLORS
from flowlab.viz.recording import write_rrd
from flowlab.viz.video import write_video

T, HORIZON, DISTINCT, FAR = 20, 9, 5, 99.0
SCALE = 8  # 80 pixels wide becomes 640
ROLES = [Role.ROBOT, Role.OBJECT, Role.PROP, Role.BACKGROUND, Role.OBJECT]
PLANS = [0, 6, 12]
"""Steps. The robot and the first object move but between the last two; the other object creeps, by 3 mm in all."""
TIMES = np.arange(HORIZON)


@pytest.fixture(scope="module")
def episode() -> Episode:
    """The camera looks along +y, at points 1 m away."""
    T_world_cam = np.eye(4)
    T_world_cam[:3] = [[1, 0, 0, 0], [0, 0, 1, -1.0], [0, -1, 0, 0]]
    moved = np.interp(np.arange(T), [0, 6, 12, 19], [0, 6, 6, 13])
    start = np.array([[-0.3, 0, 0.1], [0.1, 0, -0.1], [0.3, 0, 0.2], [-0.3, 0, -0.2], [0.3, 0, -0.2], [FAR] * 3])
    xyz_world = np.tile(start, (T, 1, 1))
    xyz_world[:, 0, 0] += 0.02 * moved
    xyz_world[:, 1, 2] += 0.01 * moved
    xyz_world[:, 4, 0] += 0.003 / T * np.arange(T)
    tracks = xyz_world.astype(np.float32)
    rng = np.random.default_rng(0)
    cloud = np.tile(rng.uniform([-0.4, 0.1, -0.3], [0.4, 0.2, 0.3], (50, 3)), (T, 1, 1)).astype(np.float32)
    return Episode(
        task="slide",
        seed=7,
        camera=Camera.from_fovy(80, 60, 50.0, T_world_cam),
        time_s=np.arange(T) / 10,
        point_cloud=cloud,
        point_count=np.full(T, 50, np.int32),
        state=np.zeros((T, 2), np.float32),
        action=np.zeros((T, 2), np.float32),
        success=np.zeros(T, bool),
        queries=Queries(
            tracks[0], np.array([*ROLES, 0], np.int16), DISTINCT, tuple(Entity(r.name, r.name, r) for r in Role)
        ),
        tracks=Tracks3D(tracks, np.ones((T, 6), bool), np.zeros(6, np.float32)),
        rgb=np.full((T, 60, 80, 3), 128, np.uint8),
    )


@pytest.fixture(scope="module")
def prediction(episode: Episode) -> FlowPrediction:
    """Plan 0 is off by 1 mm a step for the robot and by 3 mm for the object; plan 1 expects that nothing moves, and
    plan 2 that the object goes left instead, three times as fast, and the rest stays. Padding is expected anywhere."""
    paths = np.repeat(episode.tracks.xyz_world[PLANS, None], HORIZON, 1)
    paths[0, :, 0] += TIMES[:, None] * [0.02, 0, 0.001]
    paths[0, :, 1] += TIMES[:, None] * [0.003, 0, 0.01]
    paths[0, :, 2] += TIMES[:, None] * [0.0002, 0, 0]  # 1.6 mm in all
    paths[2, :, 1] += TIMES[:, None] * [-0.03, 0, 0]
    paths[:, :, 5] = np.arange(HORIZON)[:, None]
    return FlowPrediction(np.array(PLANS), paths.astype(np.float32))


@pytest.fixture(scope="module")
def found(
    episode: Episode, prediction: FlowPrediction, tmp_path_factory: pytest.TempPathFactory
) -> dict[Any, list[Any]]:
    return recorded(episode, prediction, tmp_path_factory.mktemp("recording"))


def recorded(episode: Episode, prediction: FlowPrediction | None, folder: Path) -> dict[Any, list[Any]]:
    write_rrd(episode, folder / "e.rrd", name="slide", about="By hand.", prediction=prediction)
    return columns(folder / "e.rrd")


def motionless(prediction: FlowPrediction) -> FlowPrediction:
    return FlowPrediction(prediction.step, np.repeat(prediction.paths_world[:, :1], HORIZON, 1))


def test_every_plan_is_recorded_and_clears_the_one_before(
    found: dict[Any, list[Any]], prediction: FlowPrediction
) -> None:
    for part, component in (("paths", "LineStrips3D:strips"), ("ends", "Points3D:positions")):
        rows = found[f"/world/predicted/{part}", component]
        assert found[f"/world/predicted/{part}", "step"] == PLANS
        assert [len(row) for row in rows] == [2, 0, 1]
        times = found[f"/world/predicted/{part}", "time"]
        assert [round(t.total_seconds(), 6) for t in times] == [0, 0.6, 1.2]
    strips = found["/world/predicted/paths", "LineStrips3D:strips"]
    ends = found["/world/predicted/ends", "Points3D:positions"]
    for plan, points in ((0, [0, 1]), (2, [1])):
        paths = prediction.paths_world[plan][:, points]
        np.testing.assert_array_equal(strips[plan], paths.swapaxes(0, 1))
        np.testing.assert_array_equal(ends[plan], paths[-1])


def test_flow_error_is_plotted_where_something_moves(found: dict[Any, list[Any]], tmp_path: Path) -> None:
    error = dict(
        zip(
            found["/scalars/flow_error", "step"],
            np.ravel(found["/scalars/flow_error", "Scalars:scalars"]),
            strict=True,
        )
    )
    assert list(error) == [*range(1, 7), *range(13, 20)]  # not while all stand still, nor when a plan is new
    for k in range(1, 7):
        assert error[k] == pytest.approx(2 * k, abs=1e-3)  # 1 mm and 3 mm a step
    for k in range(1, 8):
        assert error[12 + k] == pytest.approx((20 * k + np.hypot(30, 10) * k) / 2, abs=1e-3)
    assert found["/scalars/flow_error", "SeriesLines:names"] == [["flow error [mm]"]]


def test_the_layout_has_a_plot_of_the_error_if_there_is_one(
    episode: Episode, prediction: FlowPrediction, tmp_path: Path
) -> None:
    calm = replace(episode, tracks=replace(episode.tracks, xyz_world=episode.tracks.xyz_world[:1].repeat(T, 0)))
    for shown, plans, plots in ((episode, prediction, 3), (calm, prediction, 2), (episode, None, 2)):
        kept = recorded(shown, plans, tmp_path)
        assert (("/scalars/flow_error", "step") in kept) == (plots == 3)
        views = columns(tmp_path / "e.rrd", blueprint=True)
        kinds = [rows[0][0] for (_, name), rows in views.items() if name.endswith(":class_identifier")]
        assert kinds.count("TimeSeries") == plots
        queries = [rows[0] for (_, name), rows in views.items() if name.endswith(":query")]
        assert (["+ /scalars/flow_error"] in queries) == (plots == 3)


def test_info_says_what_the_lines_are(
    found: dict[Any, list[Any]], episode: Episode, prediction: FlowPrediction, tmp_path: Path
) -> None:
    text = found["/info", "TextDocument:text"][0][0]
    assert text.startswith("By hand.\n\n|")
    for fact in ("yellow lines", "predicted", "2 mm", "5 mm", "flow error"):
        assert fact in text
    plain = recorded(episode, None, tmp_path)
    assert not any("predicted" in entity for entity, _ in plain)
    assert "yellow" not in plain["/info", "TextDocument:text"][0][0]


def test_predictions_have_a_color_of_their_own(found: dict[Any, list[Any]]) -> None:
    red, green, blue = PREDICTED_RGB
    packed = red << 24 | green << 16 | blue << 8 | 255
    for colors in (
        found["/world/predicted/paths", "LineStrips3D:colors"],
        found["/world/predicted/ends", "Points3D:colors"],
    ):
        assert colors == [[packed]]

    def light(rgb: Any) -> float:
        return float(np.asarray(rgb) @ [0.2126, 0.7152, 0.0722])

    for rgb in [*ROLE_RGB.values(), *cloud_rgb(np.array([*Role, -1]))]:
        assert np.abs(np.array(rgb, int) - PREDICTED_RGB).max() > 80
        assert light(rgb) < light(PREDICTED_RGB) - 60


@pytest.mark.parametrize("plans", ["some", "none that moves anything", "one"])
def test_rerun_can_read_it(plans: str, episode: Episode, prediction: FlowPrediction, tmp_path: Path) -> None:
    one = FlowPrediction(prediction.step[:1], prediction.paths_world[:1])
    chosen = {"some": prediction, "none that moves anything": motionless(prediction), "one": one}[plans]
    kept = recorded(episode, chosen, tmp_path)
    assert len(kept["/world/predicted/paths", "LineStrips3D:strips"]) == (1 if plans == "one" else 3)
    rerun = Path(sys.executable).with_name("rerun")
    result = subprocess.run([rerun, "rrd", "verify", tmp_path / "e.rrd"], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def filmed(episode: Episode, path: Path, **options: Any) -> np.ndarray:
    """All frames (T, H, W, 3) of a film."""
    write_video(episode, path, trail_s=0.2, **options)
    with av.open(str(path)) as film:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]).astype(float)


def yellowness(picture: np.ndarray) -> np.ndarray:
    """Of every pixel; orange, gray and blue are not above zero."""
    red, green, blue = np.moveaxis(picture, -1, 0)
    return green - blue - np.abs(red - green)


def yellow(picture: np.ndarray, episode: Episode, xyz_world: np.ndarray) -> float:
    """How yellow the 5 x 5 pixels of the film around a point are."""
    u, v = (episode.camera.project(xyz_world)[0] + 0.5) * SCALE - 0.5
    return float(yellowness(picture[round(v) - 2 : round(v) + 3, round(u) - 2 : round(u) + 3]).max())


def test_films_show_the_plan_in_force(episode: Episode, prediction: FlowPrediction, tmp_path: Path) -> None:
    film = filmed(episode, tmp_path / "e.mp4", prediction=prediction)
    paths = prediction.paths_world
    for t, lit, dark in ((0, 0, 2), (5, 0, 2), (6, None, 0), (11, None, 0), (12, 2, 0), (19, 2, 0)):
        if lit is not None:
            assert yellow(film[t], episode, paths[lit, -1, 1]) > 80  # the dot at the end
            assert yellow(film[t], episode, paths[lit, [6, 7], 1].mean(0)) > 30  # the line
            assert yellow(film[t], episode, paths[lit, 1, 1]) > 30  # from where the point was when it was made
        assert yellow(film[t], episode, paths[dark, -1, 1]) < 10
        for still in (2, 3, 4):
            assert yellow(film[t], episode, paths[0, -1, still] + [0.02, 0, 0]) < 10


def test_films_of_what_expects_nothing_differ_in_the_legend_only(
    episode: Episode, prediction: FlowPrediction, tmp_path: Path
) -> None:
    plain = filmed(episode, tmp_path / "plain.mp4", note="a note")
    film = filmed(episode, tmp_path / "e.mp4", prediction=motionless(prediction), note="a note")
    assert film.shape == plain.shape
    picture, legend = np.s_[:, :470], np.s_[:, 536:564]
    assert np.abs(film[picture] - plain[picture]).max() < 6  # the codec's
    amount = [(yellowness(f[legend]) > 60).sum() for f in (plain, film)]
    assert amount[0] == 0
    assert amount[1] > 100


def test_expected_paths_that_leave_the_picture_do_no_harm(
    episode: Episode, prediction: FlowPrediction, tmp_path: Path
) -> None:
    wild = prediction.paths_world.copy()
    wild[0, 3:5, 0] = [[1e9, 0, 0], [0, -2, 0]]  # far away, and behind the camera
    wild[0, :, 1] += [0, -2, 0]
    film = filmed(episode, tmp_path / "e.mp4", prediction=replace(prediction, paths_world=wild))
    for k in (1, 2, 7, 8):
        assert yellow(film[0], episode, prediction.paths_world[0, k, 0]) > 30


def test_before_the_first_plan_nothing_is_drawn(episode: Episode, prediction: FlowPrediction, tmp_path: Path) -> None:
    late = FlowPrediction(prediction.step[2:], prediction.paths_world[2:])
    film = filmed(episode, tmp_path / "e.mp4", prediction=late)
    assert yellow(film[11], episode, prediction.paths_world[2, -1, 1]) < 10
    assert yellow(film[12], episode, prediction.paths_world[2, -1, 1]) > 80


def pixels(image: np.ndarray, figure: Any, panel: int, place: np.ndarray) -> np.ndarray:
    """The 5 x 5 pixels of a still around a place in the coordinates of a panel."""
    x, y = figure.axes[panel].transData.transform(place)
    row, column = round(len(image) - y), round(x)
    return image[row - 2 : row + 3, column - 2 : column + 3].reshape(-1, 3)


def test_stills_show_expected_and_true_paths(episode: Episode, prediction: FlowPrediction, tmp_path: Path) -> None:
    draw_flow_prediction(episode, prediction, tmp_path / "e.png", title="slide", plan=0)
    image, figure = (
        np.round(imread(tmp_path / "e.png")[..., :3] * 255),
        plot_flow_prediction(episode, prediction, "", 0),
    )
    assert image.shape == (960, 1800, 3)
    expected, true = prediction.paths_world[0, :, 1], episode.tracks.xyz_world[:7, 1]
    for panel in (0, 1):

        def place(xyz_world: np.ndarray, panel: int = panel) -> np.ndarray:
            return xyz_world[[0, 2]] if panel else episode.camera.project(xyz_world)[0]

        for k in (4.5, 6.5):  # where both paths are, they lie apart
            at = place((expected[int(k)] + expected[int(k) + 1]) / 2)
            color = 255 * np.array(TIME_COLORS(int(k) / (HORIZON - 2))[:3])
            assert np.abs(pixels(image, figure, panel, at) - color).max(-1).min() < 15
        assert pixels(image, figure, panel, place(true[5])).max(-1).min() < 100  # dark
        assert pixels(image, figure, panel, place(true[6] + [0, 0, 0.012])).max(-1).min() > 150  # the next plan's


def words(figure: Any) -> str:
    return " ".join(text.get_text() for text in figure.texts)


def test_captions_state_the_error_while_the_plan_was_executed(episode: Episode, prediction: FlowPrediction) -> None:
    for plan, facts in {
        0: ["plan of step 0, 6 of its 8 steps executed", "ADE 7.0 mm, FDE 12.0 mm over 2 moving", "2 of 2 predicted"],
        1: ["plan of step 6, 6 of its 8 steps", "no point moves", "0 of 0 predicted"],
        2: ["plan of step 12, 7 of its 8 steps", "over 2 moving", "1 of 1 predicted"],
    }.items():
        text = words(plot_flow_prediction(episode, prediction, "a title", plan))
        for fact in ["a title", "slide, seed 7", *facts]:
            assert fact in text


def test_by_default_the_plan_that_moves_the_objects_most_is_shown(episode: Episode, prediction: FlowPrediction) -> None:
    assert "plan of step 12" in words(plot_flow_prediction(episode, prediction, ""))
    quick = prediction.paths_world.copy()
    quick[0, :, 0] += TIMES[:, None] * [0.2, 0, 0]  # the robot's
    robot = replace(prediction, paths_world=quick)
    assert "plan of step 12" in words(plot_flow_prediction(episode, robot, ""))
    unknown = replace(episode, queries=replace(episode.queries, owner=np.full(6, -1, np.int16)))
    assert "plan of step 0" in words(plot_flow_prediction(unknown, robot, ""))


def test_the_cloud_of_the_plans_step_is_drawn(episode: Episode, prediction: FlowPrediction) -> None:
    cloud = episode.point_cloud.copy()
    cloud[12, :, 0] += 0.01
    there = plot_flow_prediction(replace(episode, point_cloud=cloud), prediction, "").axes[1]
    drawn = next(np.asarray(c.get_offsets()) for c in there.collections if len(c.get_offsets()) == 50)
    np.testing.assert_allclose(np.sort(drawn, 0), np.sort(cloud[12][:, [0, 2]], 0), atol=1e-6)


def test_the_close_up_shows_the_objects(episode: Episode, prediction: FlowPrediction) -> None:
    left, right = plot_flow_prediction(episode, prediction, "", 0).axes[:2]
    spans = defaultdict(list)
    for axes, points in ((left, [0, 1]), (right, [1])):
        paths = prediction.paths_world[0][:, points]
        flat = paths[..., [0, 2]] if axes is right else episode.camera.project(paths)[0]
        for limits, values in ((axes.get_xlim(), flat[..., 0]), (axes.get_ylim(), flat[..., 1])):
            assert min(limits) < values.min() < values.max() < max(limits)
            spans[axes].append(np.ptp(limits) / np.ptp(values))
    assert min(spans[left]) < 1.5
    assert min(spans[right]) < 2.5
    assert right.get_xlim()[0] > prediction.paths_world[0, -1, 0, 0]  # the robot's path lies outside


@pytest.mark.parametrize("plan", [3, -1])
def test_a_plan_that_is_not_there_is_one_sentence(plan: int, episode: Episode, prediction: FlowPrediction) -> None:
    with pytest.raises(DataError, match=f"slide, seed 7: no plan {plan}; there are 3, counted from 0") as error:
        plot_flow_prediction(episode, prediction, "", plan)
    assert "\n" not in str(error.value)


def test_a_failure_leaves_the_old_still_alone(episode: Episode, prediction: FlowPrediction, tmp_path: Path) -> None:
    (tmp_path / "e.png").write_text("old")
    with pytest.raises(DataError):
        draw_flow_prediction(episode, prediction, tmp_path / "e.png", title="slide", plan=9)
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"e.png": "old"}
