"""The picture of grades shows the figures that it is given."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from flowlab.errors import DataError
from flowlab.geometry.camera import Camera
from flowlab.grading.ground_truth import GroundTruth
from flowlab.grading.metrics import CURVE_MM, EstimatedTracks, TrackMetrics, measure
from flowlab.viz.grade_figure import GROUPS, RELIABILITY_POINTS, draw_grades, plot_grades

CAMERA = Camera(320, 240, np.diag([250.0, 250.0, 1.0]), np.eye(4))


def make_metrics(error_m: float, *, roles: bool = True, sigma: bool = True) -> TrackMetrics:
    """Of points that move 10 cm, each off by up to twice ``error_m``, as its sigma says."""
    rng = np.random.default_rng(0)
    tracks = np.ones((20, 30, 3), np.float32)
    tracks[..., 0] += np.linspace(0, 0.1, 20)[:, None]
    visible = rng.random((20, 30)) < 0.7
    truth = GroundTruth(np.zeros((30, 2), np.float32), tracks, visible, np.full(30, 2, np.int8) if roles else None)
    error = rng.uniform(0, 2 * error_m, (20, 30))
    stated = (error * 1.1).astype(np.float32) if sigma else None
    return measure(
        EstimatedTracks((tracks + error[..., None] * [0, 0, 1]).astype(np.float32), visible, stated), truth, CAMERA
    )


def test_a_panel_for_each_group_and_a_line_for_each_tracker() -> None:
    metrics = {"good": make_metrics(0.002), "poor": make_metrics(0.02, sigma=False)}
    figure = plot_grades(metrics, ["hammer", "push"], ["2 recordings", "simulated sensor: kinect"])
    *panels, reliability = figure.axes
    assert [p.get_title(loc="left") for p in panels] == list(GROUPS.values())
    for panel, group in zip(panels, GROUPS, strict=True):
        for line, of_tracker in zip(panel.lines, metrics.values(), strict=True):
            np.testing.assert_array_equal(line.get_xdata(), CURVE_MM)
            np.testing.assert_array_equal(line.get_ydata(), getattr(of_tracker, group).curve)
    assert panels[0].lines[0].get_color() != panels[0].lines[1].get_color()
    assert len(reliability.lines) == 2, "the diagonal, and the only tracker that states its error"
    calibration = metrics["good"].calibration
    assert calibration is not None
    drawn = np.array(calibration.count) >= RELIABILITY_POINTS
    np.testing.assert_array_equal(reliability.lines[1].get_ydata(), np.array(calibration.true_mm)[drawn])
    words = {t.get_text() for t in figure.texts}
    assert words == {
        "error of tracks: hammer, push",
        "2 recordings   ·   simulated sensor: kinect",
        "good: 0.00% confidently wrong",
        "poor: states no errors",
        "confidently wrong: in sight, true error above 20 mm and above 4 σ",
    }
    assert [line.get_color() for line in figure.artists] == [line.get_color() for line in panels[0].lines]


@pytest.mark.parametrize(
    ("graded", "about"),
    [
        ([f"task-with-a-long-name-{k}" for k in range(100)], ["100 recordings"]),
        (["W" * 300, "x"], ["fact " * 100, "another"]),
        (["W" * 300], []),
        (["i" * 60] * 100, ["漢" * 500]),
    ],
)
def test_nothing_leaves_the_picture_however_much_there_is(graded: list[str], about: list[str]) -> None:
    one = make_metrics(0.01, roles=False)
    figure = plot_grades({"good": one, "W" * 300: one, **{f"tracker {k}": one for k in range(12)}}, graded, about)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")
        figure.canvas.draw()
        boxes = [text.get_window_extent() for text in figure.texts if text.get_text()]
    assert max(box.x1 for box in boxes) <= figure.bbox.x1
    assert min(box.x0 for box in boxes) >= 0
    assert min(box.y0 for box in boxes) >= 0
    assert not any(a.overlaps(b) for k, a in enumerate(boxes) for b in boxes[:k])
    lowest = min(panel.get_tightbbox().y0 for panel in figure.axes)
    assert sum(box.y1 < lowest for box in boxes) == len(boxes) - 2 + (not about), "all but the title are below panels"
    (title,) = [t.get_text() for t in figure.texts if t.get_text().startswith("error of tracks")]
    assert title.endswith(" more") == (len(graded) > 1)


def test_absent_groups_have_no_panel() -> None:
    figure = plot_grades({"only": make_metrics(0.01, roles=False, sigma=False)}, ["camera moves"])
    assert [a.get_title(loc="left") for a in figure.axes] == [GROUPS["all"]]
    nothing = replace(make_metrics(0.01, roles=False, sigma=False), all=None)
    assert len(plot_grades({"nothing": nothing}, ["a single frame"]).axes) == 1


def test_the_file_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "deeper" / "grade.png"
    draw_grades({"only": make_metrics(0.01)}, path, graded=["written"])
    picture = imread(path)
    assert picture.shape[1] > 2 * picture.shape[0]
    assert picture[..., :3].min() < 0.5
    before = path.read_bytes()

    def fails(*_: object) -> None:
        raise OSError("no space is left")

    monkeypatch.setattr("os.replace", fails)
    with pytest.raises(DataError, match="no space"):
        draw_grades({"only": make_metrics(0.02)}, path, graded=["lost"])
    assert path.read_bytes() == before
    assert [f.name for f in path.parent.iterdir()] == ["grade.png"]
