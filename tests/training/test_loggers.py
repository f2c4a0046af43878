"""TensorBoard and Weights & Biases hold what was logged, also of a run that was resumed."""

import json
import os
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from trained_runs import SMALL, make_rolls, train

from flowlab.errors import MissingLibraryError, UsageError
from flowlab.training.loggers import make_logger

SETTINGS = {"policy": "fdp", "optimizer": {"learning_rate": 0.001, "betas": [0.95, 0.999]}}
BLOCK = 32768


def read_tensorboard(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Step and value of every scalar, as TensorBoard shows them."""
    reading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    events = reading.EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    return {tag: [(e.step, round(e.value, 6)) for e in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def read_wandb(file: Path) -> Iterator[Any]:
    """The records of a W&B file: LevelDB's log format, in blocks, after a head of 7 bytes."""
    records = pytest.importorskip("wandb.proto.wandb_internal_pb2")
    content, place, record = file.read_bytes(), 7, b""
    while place + 7 <= len(content):
        left = BLOCK - place % BLOCK
        if left < 7:
            place += left
            continue
        _, length, kind = struct.unpack("<IHB", content[place : place + 7])
        record += content[place + 7 : place + 7 + length]
        place += 7 + length
        if kind in (1, 4):  # whole, or the last part
            yield records.Record.FromString(record)
            record = b""


def read_history(file: Path) -> dict[int, dict[str, float]]:
    """What a W&B file holds of each step, beside W&B's own."""
    rows = [r.history for r in read_wandb(file) if r.WhichOneof("record_type") == "history"]
    named = {
        row.step.num: {i.key or "/".join(i.nested_key): json.loads(i.value_json) for i in row.item} for row in rows
    }
    return {step: {k: v for k, v in row.items() if not k.startswith("_")} for step, row in named.items()}


LOGGING = """
import json, sys
from pathlib import Path
from flowlab.errors import FlowlabError
from flowlab.training.loggers import make_logger
folder, settings, written = sys.argv[1], *map(json.loads, sys.argv[2:])
try:
    log = make_logger("wandb", Path(folder), "push-fdp", settings)
except FlowlabError as error:
    sys.exit(f"{type(error).__name__}: {error}")
for step, values in written:
    log.write(step, values)
log.close()
"""


def log_to_wandb(tmp_path: Path, mode: str, written: list[tuple[int, dict[str, float]]]) -> tuple[int, str]:
    """Exit code and errors of a process of its own, without an account; within one, W&B keeps its first mode."""
    pytest.importorskip("wandb")
    home = tmp_path / "home"
    home.mkdir(exist_ok=True)
    mine = {"HOME": str(home), "NETRC": str(home / "netrc"), "WANDB_MODE": mode, "WANDB_SILENT": "true"}
    others = {k: v for k, v in os.environ.items() if not k.startswith("WANDB_")}
    result = subprocess.run(
        [sys.executable, "-c", LOGGING, tmp_path, json.dumps(SETTINGS), json.dumps(written)],
        env=others | mine, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    return result.returncode, result.stderr


def test_tensorboard_reads_what_was_logged(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    log = make_logger("tensorboard", tmp_path, "push-fdp", SETTINGS)
    log.write(50, {"train/loss": 0.5, "train/lr": 0.001})
    log.write(50, {"validation/action_l1": 0.25})
    log.write(100, {"train/loss": 0.4, "train/lr": 0.0005})
    log.close()
    assert read_tensorboard(tmp_path) == {
        "train/loss": [(50, 0.5), (100, 0.4)],
        "train/lr": [(50, 0.001), (100, 0.0005)],
        "validation/action_l1": [(50, 0.25)],
    }


def test_tensorboard_of_a_killed_and_resumed_run_has_every_step_once(tmp_path: Path) -> None:
    """The first run is never closed, and had come farther than what it is resumed from."""
    pytest.importorskip("tensorboard")
    killed = make_logger("tensorboard", tmp_path, "push-fdp", SETTINGS)
    for step in (50, 100, 150, 200):
        killed.write(step, {"train/loss": 1 / step})
    assert [step for step, _ in read_tensorboard(tmp_path)["train/loss"]] == [50, 100, 150, 200]
    resumed = make_logger("tensorboard", tmp_path, "push-fdp", SETTINGS)
    for step in (150, 200, 250):
        resumed.write(step, {"train/loss": 2.0})
    resumed.close()
    again = [(50, 0.02), (100, 0.01), (150, 2.0), (200, 2.0), (250, 2.0)]
    assert read_tensorboard(tmp_path) == {"train/loss": again}
    killed.close()


def test_a_run_that_logs_nothing_leaves_nothing(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    make_logger("tensorboard", tmp_path, "push-fdp", SETTINGS).close()
    assert list(tmp_path.iterdir()) == []


def test_wandb_keeps_what_was_logged(tmp_path: Path) -> None:
    """The second run is a resumed one: W&B joins runs of one id when they are synced."""
    last = {"validation/action_l1": 0.25}
    first = [(50, {"train/loss": 6.25}), (100, {"train/loss": 12.5}), (100, last)]
    for written in (first, [(150, {"train/loss": 18.75}), (150, last)]):
        assert log_to_wandb(tmp_path, "offline", written) == (0, "")
    files = sorted(tmp_path.glob("wandb/offline-run-*/*.wandb"), key=lambda f: f.stat().st_mtime_ns)
    assert [read_history(f) for f in files] == [
        {50: {"train/loss": 6.25}, 100: {"train/loss": 12.5, "validation/action_l1": 0.25}},
        {150: {"train/loss": 18.75, "validation/action_l1": 0.25}},
    ]
    runs = [r.run for f in files for r in read_wandb(f) if r.WhichOneof("record_type") == "run"]
    assert {(r.project, r.display_name, r.run_id) for r in runs} == {
        ("flowlab", "push-fdp", (tmp_path / "wandb-id.txt").read_text())
    }
    config = {i.key: json.loads(i.value_json) for i in runs[0].config.update}
    assert SETTINGS.items() <= config.items()


def test_wandb_without_an_account_says_what_to_do(tmp_path: Path) -> None:
    code, said = log_to_wandb(tmp_path, "online", [])
    assert code == 1
    assert said.startswith("LoggerRefusedError: --log wandb: No API key")
    assert said.endswith("; type 'wandb login', or set WANDB_MODE=offline and 'wandb sync' later\n")
    assert not (tmp_path / "wandb-id.txt").exists()


@pytest.mark.parametrize("name", ["tensorboard", "wandb"])
def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    for module in [m for m in sys.modules if m.startswith(("torch.utils.tensorboard", "tensorboard", "wandb"))]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, name, None)  # as Python has it for what cannot be imported
    with pytest.raises(
        MissingLibraryError, match=rf"^--log {name} needs a library: pip install 'flowlab\[{name}\]' \("
    ):
        make_logger(name, tmp_path, "push-fdp", SETTINGS)
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_log_is_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no logger is called 'tensorbord'; did you mean tensorboard"):
        make_logger("tensorbord", tmp_path, "push-fdp", SETTINGS)


OWN = """
import json
from flowlab.training.loggers import MetricsLogger


class Lines(MetricsLogger):
    def __init__(self, folder, run, settings):
        self.file = folder / "lines.txt"
        self.file.write_text(f"{run} {settings['policy']}\\n")

    def write(self, step, values):
        self.file.write_text(self.file.read_text() + f"{step} {sorted(values)[0]}\\n")

    def close(self):
        self.file.write_text(self.file.read_text() + "closed\\n")
"""


def test_a_logger_of_ones_own_lies_in_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "my_own_logger.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    train(capsys, make_rolls(tmp_path / "d"), "--policy", "dp3", "--out", "run", *SMALL, "--log", "my_own_logger:Lines")
    lines = (tmp_path / "run/lines.txt").read_text().splitlines()
    assert lines[0] == "run dp3"
    assert "20 train/action_loss" in lines
    assert lines[-1] == "closed"
    assert sys.path == before
