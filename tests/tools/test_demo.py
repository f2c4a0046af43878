"""The demo says what happened: with the numbers that were measured, and loudly where something failed."""

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from synthetic import make_filmed_episode, make_manifest, put_unit

from flowlab.storage.dataset import begin

DEMO = Path(__file__).parents[2] / "tools" / "demo"


@pytest.fixture
def demo(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The program, as a module."""
    monkeypatch.syspath_prepend(str(DEMO))
    spec = importlib.util.spec_from_file_location("demo_program", DEMO / "__main__.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "demo_program", module)
    spec.loader.exec_module(module)
    return module


def try_out(folder: Path, *success: bool) -> None:
    """What `flowlab eval` keeps of episodes, the last written first."""
    kept = folder / "run" / "evaluation" / "step-00000009-execute-4"
    kept.mkdir(parents=True)
    lines = [
        {"task": "plate-slide", "seed": 0, "episode": k, "success": s, "steps": 50 + k} for k, s in enumerate(success)
    ]
    (kept / "episodes.jsonl").write_text("\n".join(map(json.dumps, reversed(lines))))


def test_the_first_episode_that_was_solved_is_shown(demo: ModuleType, tmp_path: Path) -> None:
    try_out(tmp_path, False, False, True, True)
    assert demo.first_solved(tmp_path) == 2
    assert demo.solved(tmp_path) == (2, 4)


def test_without_an_evaluation_nothing_is_said_of_one(demo: ModuleType, tmp_path: Path) -> None:
    assert demo.solved(tmp_path) is None
    assert demo.first_solved(tmp_path) is None


@pytest.mark.parametrize(("success", "code"), [((True, False), 0), ((True, False, False), 1), ((False,), 1)])
def test_a_policy_that_solves_less_than_half_is_a_failure(
    demo: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str], success: tuple[bool, ...], code: int
) -> None:
    assert demo.main(tmp_path, lambda commands: try_out(commands.folder, *success)) == code
    sentence = f"the policy solved only {sum(success)} of {len(success)} episodes"
    assert (sentence in capsys.readouterr().err) == bool(code)
    assert (sentence in (tmp_path / "index.html").read_text()) == bool(code)


@pytest.mark.parametrize(
    ("within", "sentence"),
    [
        ({"rigid-bodies": 0.7, "lucas-kanade": 0.69}, ""),
        ({"rigid-bodies": 0.7, "lucas-kanade": 0.71}, "70% by rigid-bodies, 71% by lucas-kanade"),
        ({"rigid-bodies": 0.59, "lucas-kanade": 0.4}, "59% by rigid-bodies, 40% by lucas-kanade"),
    ],
)
def test_labels_that_are_not_worth_a_look_are_a_failure(
    demo: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str], within: dict[str, float], sentence: str
) -> None:
    errors = {"median_mm": 3.0, "p95_mm": 9.0}
    means = {
        name: {
            **{group: {**errors, "within_20mm": share} for group in ("all", "moving", "object", "occluded")},
            "calibration": {"within_1_sigma": 0.66},
            "confidently_wrong": 0.0123,
        }
        for name, share in within.items()
    }
    row = {"seed": 0, "frames": 62, "queries": 96}
    trackers = [{"tracker": name, "mean": mean, "recordings": [row]} for name, mean in means.items()]

    def graded(commands: Any) -> None:
        (commands.folder / "graded").mkdir()
        (commands.folder / "graded" / "grade.json").write_text(json.dumps({"trackers": trackers}))

    assert demo.main(tmp_path, graded) == bool(sentence)
    page = (tmp_path / "index.html").read_text()
    assert ("of the object's positions are within 20 mm: " + sentence in capsys.readouterr().err) == bool(sentence)
    assert (sentence in page) or not sentence
    assert "1.23 % are confidently wrong" in page


def test_the_page_says_which_share_is_stated_below_what(demo: ModuleType, tmp_path: Path) -> None:
    folder = tmp_path / "real"
    manifest = begin(folder, make_manifest({"pour": 1}))
    put_unit(folder, [make_filmed_episode()], manifest.settings_digest)
    page = " ".join(demo.write_page(tmp_path, [], [], 60.0).read_text().split())
    shares = re.findall(r"</i>(\S+ \d+ mm): <b>(\d+)%<", page)
    assert shares == [
        ("&lt; 5 mm", "20"),
        ("&lt; 10 mm", "20"),
        ("&lt; 20 mm", "20"),
        ("&lt; 50 mm", "80"),
        ("≥ 50 mm", "20"),
    ]


def test_a_command_that_fails_is_told_where_it_belongs_and_the_rest_goes_on(
    demo: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(commands: object) -> None:
        commands.run("label", "track-real", tmp_path / "nowhere", "--out", tmp_path / "real")  # type: ignore[attr-defined]

    def sound(commands: object) -> None:
        commands.run("data", "tasks", into="tasks.txt")  # type: ignore[attr-defined]

    assert demo.main(tmp_path, broken, sound) == 1
    assert "nowhere" in capsys.readouterr().err
    page = (tmp_path / "index.html").read_text()
    part = page[page.index("from pictures alone</h2>") :]
    assert re.search(r"This failed\.</strong> flowlab track-real .*nowhere", part)
    assert "plate-slide" in (tmp_path / "tasks.txt").read_text()


def test_what_strangers_wrote_is_no_markup(demo: ModuleType, tmp_path: Path) -> None:
    failure = demo.Failure("eval", "flowlab eval", "<script>alert(1)</script>")
    page = demo.write_page(tmp_path, [demo.Cost("eval", "flowlab eval <b>", 1.0)], [failure], 60.0).read_text()
    assert "<script>" not in page
    assert "eval &lt;b&gt;" in page


@pytest.mark.slow
def test_the_whole_demo_succeeds_and_its_page_shows_what_was_measured(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, DEMO, tmp_path], capture_output=True, text=True, timeout=1800, check=False)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "index.html").read_text()
    for link in re.findall(r'(?:src|href)="([^"#:]+)"', page):
        assert (tmp_path / link).stat().st_size > 1000, link
    assert {"policy.mp4", "policy.png", "data.png", "run/curve.png", "real.mp4", "real.png", "graded/grade.png"} <= set(
        re.findall(r'src="([^"]+)"', page)
    )
    success = json.loads((tmp_path / "report" / "report.json").read_text())["summary"]["successes"][0]["success"]
    assert success["successes"] >= 15, "a wide margin: a third of a fast machine's steps suffices"
    assert f"{success['successes']} of {success['n']} episodes" in page
    graded = json.loads((tmp_path / "graded" / "grade.json").read_text())
    rigid, classic = (t["mean"] for t in graded["trackers"])
    for group in ("moving", "object"):
        assert f"{rigid[group]['median_mm']:.1f} mm" in page
        assert rigid[group]["median_mm"] < classic[group]["median_mm"]
    assert rigid["object"]["within_20mm"] >= 0.6
    assert f"{100 * rigid['confidently_wrong']:.2f} % are confidently wrong" in page
