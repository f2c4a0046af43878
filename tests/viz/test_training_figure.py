"""The picture of a training run shows what its metrics say."""

import json
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import imread

from flowlab.errors import DataError
from flowlab.viz.training_figure import draw_training, plot_training
from flowlab.viz.training_metrics import read_metrics

ACTION = {"action_l1": 0.1, "action_l1_zero": 0.4, "action_l1_hold": 0.15}
FLOW = {
    "flow_moving_mm": 9.0, "flow_moving_mm_zero": 38.0, "flow_moving_mm_constant": 30.0,
    "flow_static_mm": 3.0, "flow_static_mm_zero": 0.0, "flow_static_mm_constant": 0.5,
}  # fmt: skip
POSE = {"pose_mm": 6.0, "pose_mm_zero": 7.0, "pose_mm_constant": 12.0}


def make_lines(errors: dict[str, float], *, motion: bool = True, steps: int = 1000) -> list[dict[str, Any]]:
    """A run whose losses halve and whose errors shrink to those given; its baselines stay what they are."""
    lines: list[dict[str, Any]] = []
    for step in range(50, steps + 1, 50):
        loss = 2 ** (-step / 200)
        losses = {"loss": loss, "action_loss": 0.8 * loss} | ({"motion_loss": 0.2 * loss} if motion else {})
        about = {"lr": 1e-4 * step, "samples_per_s": 500.0, "cpu_s": 0.3 * step, "wall_s": 0.6 * step}
        lines.append({"kind": "train", "step": step, **losses, **about})
        if step % 500 == 0:
            more = steps / step
            looked = {k: v if k.endswith(("zero", "hold", "constant")) else more * v for k, v in errors.items()}
            lines.append({"kind": "validation", "step": step, **looked, "cpu_s": 0.3 * step, "wall_s": 0.6 * step})
    return lines


def write(path: Path, lines: Sequence[dict[str, Any]]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def draw(tmp_path: Path, lines: Sequence[dict[str, Any]]) -> dict[str, Axes]:
    """The panels by heading."""
    figure = plot_training(read_metrics(write(tmp_path / "metrics.jsonl", lines)), "run")
    return {axes.get_title(loc="left"): axes for axes in figure.axes}


def drawn(axes: Axes) -> list[tuple[list[float], list[float], bool]]:
    """x and y of every line, and whether it is dashed."""
    return [
        (np.asarray(line.get_xdata()).tolist(), np.asarray(line.get_ydata()).tolist(), line.is_dashed())
        for line in axes.lines
    ]


def labels(axes: Axes) -> set[str]:
    return {text.get_text() for text in axes.texts}


def test_a_panel_for_all_that_the_metrics_tell(tmp_path: Path) -> None:
    headings = ["training", "learning rate", "held-out actions"]
    assert list(draw(tmp_path, make_lines(ACTION, motion=False))) == headings
    flow = ["held-out flow, moving points", "held-out flow, still points"]
    assert list(draw(tmp_path, make_lines(ACTION | FLOW))) == headings + flow
    assert list(draw(tmp_path, make_lines(ACTION | POSE))) == [*headings, "held-out positions of the object"]
    assert list(draw(tmp_path, make_lines({}))) == headings[:2]
    needs_frame = [line for line in make_lines(ACTION) if line["kind"] == "validation"]
    assert list(draw(tmp_path, needs_frame)) == headings[2:]


def test_lines_are_those_of_the_metrics(tmp_path: Path) -> None:
    lines = make_lines(ACTION)
    panels = draw(tmp_path, lines)
    training = [line for line in lines if line["kind"] == "train"]
    steps = [line["step"] for line in training]
    losses = drawn(panels["training"])
    assert losses == [(steps, [x[name] for x in training], False) for name in ("loss", "action_loss", "motion_loss")]
    assert panels["training"].get_yscale() == "log"
    assert labels(panels["training"]) == {"total 0.0312", "action 0.025", "motion 0.00625"}
    assert drawn(panels["learning rate"]) == [(steps, [line["lr"] for line in training], False)]
    policy, *_ = drawn(panels["held-out actions"])
    assert policy == ([500, 1000], [0.2, 0.1], False)


def test_a_loss_of_action_alone_is_drawn_once(tmp_path: Path) -> None:
    training = draw(tmp_path, make_lines(ACTION, motion=False))["training"]
    assert len(training.lines) == 1
    assert labels(training) == {"total 0.0312"}


def test_baselines_are_dashed_over_the_whole_run(tmp_path: Path) -> None:
    panels = draw(tmp_path, make_lines(ACTION | POSE))
    object_ = panels["held-out positions of the object"]
    _, *baselines = drawn(object_)
    assert baselines == [([0, 1], [7.0, 7.0], True), ([0, 1], [12.0, 12.0], True)]  # of the panel's width
    assert labels(object_) == {"policy 6", "no motion 7", "same velocity 12"}
    assert object_.get_ylim() == pytest.approx((0, 1.1 * 12))
    assert object_.get_ylabel() == "mean error [mm]"


def test_a_baseline_far_above_the_rest_is_only_named(tmp_path: Path) -> None:
    """Else it would press the curve to the floor."""
    actions = draw(tmp_path, make_lines(ACTION | {"action_l1_zero": 0.41}))["held-out actions"]
    assert labels(actions) == {"policy 0.1", "no action 0.41 ↑", "last action again 0.15"}
    assert [y for _, y, dashed in drawn(actions) if dashed] == [[0.15, 0.15]]
    assert actions.get_ylim() == pytest.approx((0, 1.1 * 0.2))
    actions = draw(tmp_path, make_lines(ACTION | {"action_l1_zero": 0.39}))["held-out actions"]
    assert "no action 0.39" in labels(actions)
    assert actions.get_ylim() == pytest.approx((0, 1.1 * 0.39))


def test_labels_stay_apart_and_inside(tmp_path: Path) -> None:
    """Three crowd at the top of one panel, two at the bottom of the other."""
    top = {"flow_moving_mm": 18.0, "flow_moving_mm_zero": 100.0, "flow_moving_mm_constant": 17.9}
    bottom = {"flow_static_mm": 3.0, "flow_static_mm_zero": 0.0, "flow_static_mm_constant": 0.001}
    panels = draw(tmp_path, make_lines(ACTION | top | bottom, steps=500))
    for axes in panels.values():
        figure = axes.figure
        assert isinstance(figure, Figure)
        figure.canvas.draw()
        boxes = sorted((text.get_window_extent() for text in axes.texts), key=lambda box: box.y0)
        assert all(low.y1 <= high.y0 for low, high in pairwise(boxes))
        assert all(box.x0 > axes.bbox.x1 and box.x1 < figure.bbox.x1 for box in boxes)
        others = [other.get_tightbbox() for other in panels.values() if other is not axes]
        assert not any(box.overlaps(other) for box in boxes for other in others if other is not None)
        assert all(axes.bbox.y0 - 20 < box.y0 and box.y1 < axes.bbox.y1 + 20 for box in boxes)


def test_what_some_looks_lack_is_left_out(tmp_path: Path) -> None:
    lines = make_lines(ACTION | FLOW)
    for name in [name for name in FLOW if "moving" in name]:
        del next(line for line in lines if line["kind"] == "validation")[name]
    moving = draw(tmp_path, lines)["held-out flow, moving points"]
    assert drawn(moving)[0] == ([1000], [9.0], False)


def test_a_run_of_one_line_can_be_seen(tmp_path: Path) -> None:
    panels = draw(tmp_path, make_lines({}, steps=50))
    for axes in panels.values():
        assert {line.get_marker() for line in axes.lines} == {"o"}


def test_the_picture_says_what_the_run_took(tmp_path: Path) -> None:
    lines = read_metrics(write(tmp_path / "m.jsonl", make_lines(ACTION)))
    words = {text.get_text() for text in plot_training(lines, "my run").texts}
    assert words == {"my run", "1 000 steps   ·   5.0 min of CPU time   ·   10.0 min by the clock   ·   500 samples/s"}
    words = {text.get_text() for text in plot_training(lines[:2], "my run").texts}
    assert "100 steps   ·   30 s of CPU time   ·   60 s by the clock   ·   500 samples/s" in words


def test_a_last_line_that_a_kill_cut_off_is_left_out(tmp_path: Path) -> None:
    metrics = write(tmp_path / "metrics.jsonl", make_lines(ACTION))
    whole = read_metrics(metrics)
    with metrics.open("a") as file:
        file.write('{"kind": "train", "step": 1050, "los')
    assert read_metrics(metrics) == whole
    assert [line.step for line in whole][-3:] == [950, 1000, 1000]


@pytest.mark.parametrize(
    "damage",
    ['{"kind": "train", "st', "[1, 2]", '{"kind": "train"}', '{"kind": "train", "step": 3, "loss": "low"}', ""],
)
def test_a_damaged_line_is_named(tmp_path: Path, damage: str) -> None:
    metrics = write(tmp_path / "metrics.jsonl", make_lines(ACTION))
    lines = metrics.read_text().split("\n")
    lines[3] = damage
    metrics.write_text("\n".join(lines))
    with pytest.raises(DataError, match=f"^{metrics}: line 4 is damaged .*; delete the line$"):
        draw_training(metrics, tmp_path / "curve.png")
    assert [f.name for f in tmp_path.iterdir()] == ["metrics.jsonl"]


def test_bytes_that_are_no_text_are_damage(tmp_path: Path) -> None:
    metrics = tmp_path / "metrics.jsonl"
    metrics.write_bytes(b'{"kind": "train", "step": 50, "loss": 1}\n\xff\xfe\n')
    with pytest.raises(DataError, match="line 2 is damaged"):
        read_metrics(metrics)


def test_a_run_without_metrics_is_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"no\.jsonl: there is no such file; a training"):
        draw_training(tmp_path / "no.jsonl", tmp_path / "curve.png")
    (tmp_path / "cut.jsonl").write_text('{"kind": "tr')
    with pytest.raises(DataError, match=r"cut\.jsonl: holds no whole line yet"):
        draw_training(tmp_path / "cut.jsonl", tmp_path / "curve.png")


def test_the_file_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    metrics = write(tmp_path / "push-fdp" / "metrics.jsonl", make_lines(ACTION | FLOW))
    path = tmp_path / "deeper" / "curve.png"
    draw_training(metrics, path)
    picture = imread(path)
    assert picture.shape[1] > 2.5 * picture.shape[0]
    assert picture[..., :3].min() < 0.5
    before = path.read_bytes()

    def fails(*_: object) -> None:
        raise OSError("no space is left")

    monkeypatch.setattr("os.replace", fails)
    with pytest.raises(DataError, match="no space"):
        draw_training(metrics, path)
    assert path.read_bytes() == before
    assert [f.name for f in path.parent.iterdir()] == ["curve.png"]
