"""Names and words from files are shown as they are: no markup, no escape of the terminal, no path, no formula."""

import csv
import io
import json
import os
import re
import socket
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from synthetic import call_cli, make_dataset, make_episode

from flowlab.cli import console
from flowlab.errors import DataError
from flowlab.files import new_file, new_folder, output_file
from flowlab.report.csv_files import csv_text
from flowlab.storage.dataset import Dataset
from flowlab.text import file_name, is_plain_name, markdown
from flowlab.viz.learning_curve_figure import LearningCurve, draw_learning_curves
from flowlab.viz.recording import write_rrd
from flowlab.viz.success_figure import Mark, SuccessPanel, draw_success

HOSTILE = (
    "[/red]",
    "\x1b[31mred",
    "$\\frac{",
    ":smile:",
    "a\nfake: line",
    "\u202egnp",
    "\u061cgnp\u200b",
    "x" * 5000,
    "_hidden",
    "\ud800",
)


@pytest.mark.parametrize("text", HOSTILE)
def test_text_on_the_terminal_is_what_it_is(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    console.echo(f"echo {text}")
    console.say(f"say {text}")
    console.print_table(["name", text], [[text, 1]], text)
    with console.ProgressBar() as bar:
        bar.update(1, 1, text, text)
    out, err = capsys.readouterr()
    assert not re.search("[\x1b\u202e\u061c\u200b\ud800]", out + err)
    assert [line[:4] for line in out.splitlines()[:1]] == ["echo"]
    assert len(err.splitlines()) == 2
    if text == "[/red]":
        assert out.count(text) == 4


@pytest.mark.parametrize(("total", "done"), [(60, 0), (100, 0), (100, 70)], ids=["as many", "more", "some known"])
def test_other_work_has_a_time_of_its_own(
    total: int, done: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is left of an evaluation is not told from how long it took to choose."""
    now = 0.0
    monkeypatch.setattr(console, "time", SimpleNamespace(monotonic=lambda: now))
    with console.ProgressBar() as bar:
        bar.update(0, 60, "choosing")
        now = 600.0
        bar.update(60, 60, "choosing")
        now = 605.0
        bar.update(done, total, "evaluating")
        now = 625.0
        bar.update(done + 10, total, "evaluating")
    first, second = capsys.readouterr().err.splitlines()
    assert first == "choosing: 60 of 60 episodes, 600 s, 0 s left"
    left = 2 * (total - done - 10)
    assert second == f"evaluating: {done + 10} of {total} episodes, 20 s, {left} s left"


def test_every_command_prints_through_the_console() -> None:
    for file in Path(console.__file__).parent.glob("*.py"):
        if file.name not in ("console.py", "__init__.py"):
            assert not re.search(r"click\.echo|Console\(|(?<!\w)print\(", file.read_text()), file


@pytest.mark.parametrize(
    "text", ["../x", "/abs", "n" * 300, "nul\0", "~", ".hidden", "a/b", "\ud800", "line\nbreak", ""]
)
def test_any_text_becomes_a_plain_name_of_its_own(text: str) -> None:
    assert is_plain_name(file_name(text))
    assert file_name(text) != file_name(text + "'")
    assert file_name(text + ".rrd") == file_name(text + ".rrd")


def test_viz_writes_beside_the_user_whatever_a_task_is_called(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    make_dataset(tmp_path / "data", [[make_episode(0)]])
    here = tmp_path / "deep" / "here"
    here.mkdir(parents=True)
    monkeypatch.chdir(here)
    real = Dataset.episode
    monkeypatch.setattr(Dataset, "episode", lambda self, k: _renamed(real(self, k), "../../x"))
    code, out, _ = call_cli(capsys, "viz", tmp_path / "data")
    assert code == 0, out
    assert [p.suffix for p in here.iterdir()] == [".rrd"]
    assert {p.name for p in tmp_path.iterdir()} == {"data", "deep"}


def _renamed(episode: object, task: str) -> object:
    object.__setattr__(episode, "task", task)
    return episode


def test_markdown_shows_markup() -> None:
    assert markdown("|a| `b` <i> [c](d)\n# e") == r"\|a\| \`b\` \<i\> \[c\](d) \# e"


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@SUM(A1)"])
def test_no_text_in_a_csv_is_a_formula(text: str) -> None:
    (_, row) = csv.reader(io.StringIO(csv_text(["a", "b"], [[text, -1]])))
    assert row == [f"'{text}", "-1"]


def test_figures_show_any_name(tmp_path: Path) -> None:
    mark, curve = Mark(0.5, 0.2, 0.8), LearningCurve((1.0,), (Mark(0.5, 0.2, 0.8),))
    rows = {name: {name: mark} for name in HOSTILE}
    draw_success([SuccessPanel(name, rows, {}) for name in HOSTILE[:3]], HOSTILE, tmp_path / "a.png")
    draw_learning_curves({name: {name: curve} for name in HOSTILE[:4]}, HOSTILE, tmp_path / "b.png")
    assert {p.name for p in tmp_path.iterdir()} == {"a.png", "b.png"}


def test_a_recording_takes_any_name(tmp_path: Path) -> None:
    write_rrd(make_episode(0), tmp_path / "a.rrd", name="\ud800\0[red]")


@pytest.mark.parametrize("name", ["matplotlibrc", ".numba_config.yaml"])
def test_settings_of_libraries_are_not_taken_from_the_current_folder(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_text("cache_dir: ./evil")
    code, _, err = call_cli(capsys, "tasks")
    assert code == 2
    assert name in err
    assert len(err.splitlines()) == 1


WRITERS: dict[str, Callable[[Path], object]] = {
    "file": lambda path: _fill(new_file(path)),
    "output": lambda path: _fill(output_file(path)),
    "folder": lambda path: _fill(new_folder(path)),
}


@pytest.mark.parametrize("path", ["a" * 300, "a/" * 3000, "a\0b", "\ud800"], ids=ascii)
@pytest.mark.parametrize(
    "command",
    [["info"], ["validate"], ["report"], ["viz"], ["train", "--resume"], ["eval"],
     ["export", "--to", "dp3", "--out", "o"], ["extract-sim", "push", "--out"], ["track-real", "--dry-run"], ["grade"]],
    ids=lambda words: words[0],
)  # fmt: skip
def test_a_path_that_no_file_can_have_is_one_sentence(
    command: list[str], path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, err = call_cli(capsys, *command, path)
    assert code == 2
    assert "cannot be looked for" in err
    assert len(err) < 1000
    assert not list(tmp_path.iterdir())


def _fill(context: object) -> None:
    with context as temporary:  # type: ignore[attr-defined]
        (temporary / "a" if temporary.is_dir() else temporary).write_text("mine")


@pytest.mark.parametrize("kind", WRITERS)
def test_a_link_laid_at_a_temporary_name_is_not_followed(kind: str, tmp_path: Path) -> None:
    folder = tmp_path / "theirs"
    folder.mkdir()
    (folder / f".tmp-{socket.gethostname()}+{os.getpid()}+x").symlink_to(tmp_path / "outside")
    WRITERS[kind](folder / "x")
    assert [p.name for p in folder.iterdir()] == ["x"]
    assert not (tmp_path / "outside").exists()


def test_of_two_exports_to_one_place_one_wins_whole(tmp_path: Path) -> None:
    def slow() -> None:
        with new_folder(tmp_path / "x") as mine:
            (mine / "a").write_text("mine")
            (tmp_path / "x").mkdir()  # by the other, meanwhile
            (tmp_path / "x" / "a").write_text("theirs")

    with pytest.raises(DataError, match="cannot be written"):
        slow()
    assert {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*")} == {"x", "x/a"}
    assert (tmp_path / "x" / "a").read_text() == "theirs"


def test_a_report_that_cannot_be_written_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "trials.csv").write_text("policy,task,trial,success\n=a,[/red],1,1\n")
    (tmp_path / "file").touch()
    code, _, err = call_cli(capsys, "report", tmp_path / "trials.csv", "--out", tmp_path / "file" / "r")
    assert code == 3
    assert len(err.splitlines()) == 1
    code, out, err = call_cli(capsys, "report", tmp_path / "trials.csv", "--out", tmp_path / "r")
    assert code == 0, err
    assert "[/red]" in out
    page = (tmp_path / "r" / "report.html").read_text()
    assert "[/red]" in page
    assert "Content-Security-Policy" in page
    assert json.loads((tmp_path / "r" / "report.json").read_text())["scored"]
