"""``benchmarks/gpu.py`` on the CPU, with small networks: what it compares, what it leaves out, what it refuses."""

import importlib
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from trained_runs import NETWORK, make_rolls

from flowlab.training.precision import has_bf16
from flowlab.training.trainer import Trainer

ROOT = Path(__file__).parents[2]
POLICIES = ("dp3", "fdp", "mba")
ABLE = ("fp32", "bf16") if has_bf16(torch.device("cpu")) else ("fp32",)
QUICK = ("--steps", "3", "--rounds", "2", "--round-seconds", "0.01", "--plans", "4")


@pytest.fixture(scope="module")
def rolls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_rolls(tmp_path_factory.mktemp("gpu") / "rolls")


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module("gpu")


def measure(
    gpu: ModuleType, monkeypatch: pytest.MonkeyPatch, data: Path, out: Path, *options: str
) -> tuple[int, dict[str, Any]]:
    words = ["gpu.py", "--data", data, "--profiles", NETWORK, "--json", out, "--device", "cpu", *options]
    monkeypatch.setattr(sys, "argv", [str(word) for word in words])
    return gpu.main(), json.loads(out.read_text())


def test_the_cpu_agrees_with_itself_exactly_and_all_is_measured_or_named(
    gpu: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    rolls: Path,
    tmp_path: Path,
) -> None:
    code, found = measure(gpu, monkeypatch, rolls, tmp_path / "found.json", *QUICK)
    printed = capsys.readouterr().out
    assert code == 0
    assert "no GPU was used" in printed
    compared = {(row["policy"], row["precision"]): row for row in found["agreement"]}
    assert list(compared) == [(policy, precision) for policy in POLICIES for precision in ABLE]
    assert {row["steps"] for row in compared.values()} == {3}
    for policy in POLICIES:
        assert compared[policy, "fp32"]["difference"] == 0
        assert compared[policy, "fp32"]["verdict"] == "exact"
        if "bf16" in ABLE:  # another precision is another number, or nothing was switched
            assert 0 < compared[policy, "bf16"]["difference"] < compared[policy, "bf16"]["tolerance"]
    assert [(row["policy"], row["precision"], row["rounds"]) for row in found["training"]] == [
        (*c, 2) for c in compared
    ]
    assert all(0 < row["gather_ms"] < 1e3 / row["steps_per_s"] for row in found["training"])
    assert all(row["waits_for_batch"] < 1 and row["peak_mb"] is None for row in found["training"])
    assert [(row["policy"], row["plans"], row["denoising_steps"]) for row in found["plans"]] == [
        (policy, 4, 10) for policy in POLICIES
    ]
    left_out = [row["what"] for row in found["not_measured"]]
    assert "tf32, all policies" in left_out
    assert not [what for what in left_out if what.startswith(str(NETWORK))]
    assert not (rolls.parent / "no-run").exists()


def test_a_budget_that_is_too_small_names_all_that_it_leaves_out(
    gpu: ModuleType, monkeypatch: pytest.MonkeyPatch, rolls: Path, tmp_path: Path
) -> None:
    code, found = measure(gpu, monkeypatch, rolls, tmp_path / "found.json", "--budget", "0")
    assert code == 0
    assert not found["training"] + found["agreement"] + found["plans"]
    left_out = [row["what"] for row in found["not_measured"] if row["why"] == "the budget was used up"]
    assert left_out == [f"{NETWORK}, {policy}: everything" for policy in POLICIES]


def test_a_device_that_computes_something_else_is_found_out(
    gpu: ModuleType, monkeypatch: pytest.MonkeyPatch, rolls: Path, tmp_path: Path
) -> None:
    honest = gpu.restart

    def a_little_off(trainer: Trainer, weights: dict[str, torch.Tensor]) -> None:
        honest(trainer, {name: 1.05 * value for name, value in weights.items()})

    monkeypatch.setattr(gpu, "restart", a_little_off)
    code, found = measure(
        gpu, monkeypatch, rolls, tmp_path / "found.json", "--policies", "dp3", "--steps", "2", "--rounds", "0"
    )
    assert code == 1
    assert [row["verdict"] for row in found["agreement"]] == ["DIFFERS"] * len(ABLE)
    assert not found["training"]


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_is_refused_in_a_sentence(
    gpu: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--device", "cuda"])
    assert gpu.main() == 2
    assert capsys.readouterr().err == "--device cuda: PyTorch sees no GPU here; use --device cpu\n"
