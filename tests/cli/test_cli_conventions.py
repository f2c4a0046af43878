"""What holds for every command: one notation for lists, one JSON document, quiet when asked, a sign of life."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from synthetic import call_cli, make_dataset, make_episode

from flowlab.cli import _COMMANDS, cli, heartbeat
from flowlab.cli.values import Names, Numbers
from flowlab.errors import UsageError

INSTANT = {"tasks", "info", "doctor", "plugins", "serve"}
"""What reports no progress: it is done at once, or, as a server, tells of clients only."""
Capsys = pytest.CaptureFixture[str]


def every_command() -> Iterator[tuple[str, click.Command]]:
    for name in _COMMANDS:
        command = cli.get_command(click.Context(cli), name)
        assert command is not None
        below = command.commands if isinstance(command, click.Group) else {"": command}
        yield from ((f"{name} {part}".strip(), one) for part, one in below.items())


ALL = dict(every_command())


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return make_dataset(tmp_path / "push", [[make_episode(3, task=t)] for t in ("push", "push, then pull")]).path


@pytest.mark.parametrize("name", ALL)
def test_every_command_has_json_and_all_that_take_long_are_quiet_when_asked(name: str) -> None:
    options = {option for parameter in ALL[name].params for option in parameter.opts}
    assert "--json" in options
    assert ("--quiet" in options) == (name not in INSTANT)


@pytest.mark.parametrize("name", ALL)
def test_what_names_several_is_a_list_with_commas_everywhere(name: str) -> None:
    for parameter in ALL[name].params:
        several = parameter.multiple or parameter.nargs == -1
        if several and parameter.name not in ("overrides", "settings", "changes") and "Path" not in str(parameter.type):
            assert isinstance(parameter.type, Names | Numbers), parameter.opts  # settings and paths may have commas
        if parameter.name == "tasks":
            assert parameter.param_type_name == "argument" or {"--tasks", "--task"} == {*parameter.opts}


def test_lists_may_be_parted_repeated_and_hold_commas() -> None:
    seen: dict[str, object] = {}
    from flowlab.cli.values import names_option, numbers_option

    @click.command()
    @names_option("--tasks")
    @numbers_option("--seeds", default=["0,1,2"])
    def probe(tasks: tuple[str, ...], seeds: tuple[int, ...]) -> None:
        seen.update(tasks=tasks, seeds=seeds)

    probe.main(
        ["--tasks", "a, b", "--tasks", "c,a", "--tasks", r"pour\, stir", "--seeds", "7,0:3"], standalone_mode=False
    )
    assert seen == {"tasks": ("a", "b", "c", "pour, stir"), "seeds": (7, 0, 1, 2)}
    probe.main([], standalone_mode=False)
    assert seen == {"tasks": (), "seeds": (0, 1, 2)}
    for wrong in ("1:", "-1", "x", "3:3", ""):
        with pytest.raises((click.BadParameter, UsageError)):
            probe.main(["--seeds", wrong], standalone_mode=False)


def test_extract_takes_tasks_with_commas_and_groups_among_them(capsys: Capsys, tmp_path: Path) -> None:
    for words in (["reach,pick-plce"], ["hard", "pick-plce"]):
        code, _, errors = call_cli(capsys, "extract-sim", *words, "--out", tmp_path / "x")
        assert code == 2
        assert "no task is called 'pick-plce'; did you mean pick-place" in errors


def test_json_is_alone_on_standard_output(data: Path, tmp_path: Path, capsys: Capsys) -> None:
    for words in (
        ["tasks", "--group", "hard,medium"], ["plugins", "trackers,readers"], ["info", data], ["validate", data],
        ["viz", data, "--png", tmp_path / "a.png"],
        ["subset", data, "--tasks", r"push\, then pull", "--out", tmp_path / "b"],
        ["merge", data, tmp_path / "b", "--out", tmp_path / "c"],
        ["export", data, "--to", "dp3", "--out", tmp_path / "d.zarr"],
        ["bench", "--recipe", "table1", "--out", tmp_path / "e", "--dry-run", "--tasks", "push,hammer"],
        ["bench", "--recipe", "table1", "--out", tmp_path / "e", "--dry-run", "--expert", "--tasks", "push"],
    ):  # fmt: skip
        code, output, errors = call_cli(capsys, *words, "--json")
        assert code == 0, errors
        json.loads(output)
    assert call_cli(capsys, "info", tmp_path / "b", "--json")[1].count('"task": "push, then pull"')


@pytest.mark.parametrize("name", sorted({*ALL} - {"tasks", "plugins", "doctor"}))
def test_a_refused_command_prints_no_json(
    name: str, tmp_path: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    needs_out = {"extract-sim", "track-real", "label-actions", "train", "bench", "merge", "subset", "export", "report"}
    more = {
        "hub push": ["a/b", "--dry-run"], "label-actions": ["--from", "other"], "train": ["--policy", "fdp"],
        "bench": ["--tasks"], "export": ["--to", "dp3"], "subset": ["--episodes", "0"], "grade": ["--out", "g"],
    }  # fmt: skip
    words = [*name.split(), *(["--out", "out"] if name in needs_out else []), *more.get(name, []), "nothere"]
    code, output, errors = call_cli(capsys, *words, "--json")
    assert code in (1, 2, 3), (words, output)
    assert errors
    assert output in ("", "[]\n") or json.loads(output), output  # findings are what validate is asked for


def test_a_silent_command_says_that_it_is_at_work(capsys: Capsys, monkeypatch: pytest.MonkeyPatch) -> None:
    assert heartbeat.SILENT_S < 30
    monkeypatch.setattr(heartbeat, "SILENT_S", 0.2)
    slow = click.Command("slow", callback=lambda: time.sleep(0.7))
    quiet = click.Command("quiet", callback=lambda: (heartbeat.be_quiet(), time.sleep(0.7)))
    monkeypatch.setattr(type(cli), "get_command", lambda *_: {"tasks": slow, "info": quiet}[_[-1]])
    lines = call_cli(capsys, "tasks")[2].splitlines()
    assert len(lines) in (2, 3)
    assert all(line.startswith("flowlab tasks: at work for ") for line in lines)
    assert call_cli(capsys, "info")[2] == ""


def test_what_was_said_last_is_repeated_after_a_silence_and_not_before() -> None:
    pulse = heartbeat.Heartbeat()
    pulse.said("step 50 of 1000")
    assert pulse.due(pulse._last + 24, "flowlab train") == ""
    assert pulse.due(pulse._last + 26, "flowlab train").startswith("flowlab train: at work for 26 s; step 50 of 1000")
    pulse.bars = 1
    assert pulse.due(pulse._last + 100, "flowlab train") == ""


def test_bash_completes_commands_tasks_in_a_list_and_plug_ins(tmp_path: Path) -> None:
    def complete(*words: str) -> list[str]:
        environment = {**os.environ, "_FLOWLAB_COMPLETE": "bash_complete", "COMP_WORDS": " ".join(words),
                       "COMP_CWORD": str(len(words) - 1)}  # fmt: skip
        run = subprocess.run([sys.executable, "-m", "flowlab"], env=environment, capture_output=True, text=True)
        return [line.partition(",")[2] for line in run.stdout.splitlines()]

    assert complete("flowlab", "ext") == ["extract-sim"]
    assert complete("flowlab", "extract-sim", "push,ham") == ["push,hammer"]
    assert complete("flowlab", "train", "data", "--policy", "f") == ["fdp"]


def test_info_lists_episodes_by_the_numbers_that_viz_takes(tmp_path: Path, capsys: Capsys) -> None:
    units = [[make_episode(k, task=task) for k in (5, 3, 9)] for task in ("push", "hammer")]
    data = make_dataset(tmp_path / "d", units).path
    listed = json.loads(call_cli(capsys, "info", data, "--json")[1])["listed"]
    assert [(e["episode"], e["task"], e["seed"]) for e in listed[:4]] == [
        (0, "hammer", 3), (1, "hammer", 5), (2, "hammer", 9), (3, "push", 3),
    ]  # fmt: skip
    for e in listed[1:5:3]:
        output = call_cli(capsys, "viz", data, "--episode", e["episode"], "--save", tmp_path / "e.rrd")[1]
        assert output.startswith(f"{e['task']} seed {e['seed']}:")
    many = make_dataset(tmp_path / "many", [[make_episode(k) for k in range(22)]]).path
    assert "... and 2 episodes more; --all lists them" in call_cli(capsys, "info", many)[1]
    assert "more; --all" not in call_cli(capsys, "info", many, "--all")[1]
