"""``flowlab validate RUN``: a byte that changed anywhere in a run is found, and what is sound is called so."""

import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file
from synthetic import call_cli
from thoroughness import examples
from trained_runs import SMALL, make_rolls, make_run, options

from flowlab.checksums import with_checksum
from flowlab.evaluation.episode_log import append_result
from flowlab.evaluation.results import EpisodeResult
from flowlab.evaluation.validation import validate_run
from flowlab.policies.trained import FREE

Capture = pytest.CaptureFixture[str]
OLD = Path(__file__).parents[1] / "fixtures/old/runs"
EPISODES = "evaluation/step-00000020-execute-4/episodes.jsonl"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run with an evaluation. Copy it before changing it."""
    place = tmp_path_factory.mktemp("runs")
    short = options("run.checkpoints=2", "run.validations=2")
    made = make_run(make_rolls(place / "d"), "--policy", "dp3", "--out", place / "run", *SMALL, *short)
    (made / EPISODES).parent.mkdir(parents=True)
    result = {"task": "roll", "seed": 0, "episode": 0, "scene_seed": 1_000_000, "success": True, "success_dp3": True}
    append_result(made / EPISODES, EpisodeResult.model_validate({**result, "steps": 57}))
    return made


def test_a_sound_run_is_called_so(run: Path, capsys: Capture) -> None:
    assert call_cli(capsys, "validate", run) == (0, f"{run}: sound\n", "")
    assert call_cli(capsys, "validate", run, "--json") == (0, "[]\n", "")


def test_a_changed_byte_anywhere_is_found(run: Path, tmp_path: Path) -> None:
    """In each of its files, at random places."""
    rng = random.Random(0)
    names = [p.relative_to(run) for p in sorted(run.rglob("*")) if p.is_file() and p.suffix != ".png"]
    assert len(names) == 7
    work = Path(shutil.copytree(run, tmp_path / "run"))
    for name in names:
        whole = (run / name).read_bytes()
        for _ in range(examples(8)):
            content = bytearray(whole)
            position = rng.randrange(len(content) - 1)  # the end of a last line may be cut off
            content[position] ^= 1 << rng.randrange(8)
            (work / name).write_bytes(content)
            assert [*validate_run(work)] or json_of(content) == json_of(whole), (name, position)
        (work / name).write_bytes(whole)
    assert [*validate_run(work)] == []


def json_of(content: bytes | bytearray) -> object:
    """JSON values, in which a changed blank has no meaning."""
    try:
        return json.loads(content)
    except ValueError:
        return bytes(content)


def spoil(path: Path) -> None:
    """As an earlier version would have written it, without digests."""
    tensors = load_file(path)
    name = next(iter(tensors))
    tensors[name] = np.full_like(tensors[name], np.nan)
    save_file(tensors, path, {"step": "20"})


def rewrite(path: Path, **changes: object) -> None:
    values = {k: v for k, v in json.loads(path.read_text()).items() if k != "sha256"}
    path.write_text(json.dumps(with_checksum({**values, **changes}, FREE if path.name == "run.json" else ())))


PROBLEMS: dict[str, tuple[Callable[[Path], object], str]] = {
    "not begun": (lambda r: [(r / n).unlink() for n in ("policy.json", "resume.safetensors")], "has not begun yet"),
    "no dataset": (lambda r: rewrite(r / "run.json", dataset="/nowhere"), "run.json: dataset: /nowhere is not there"),
    "other dataset": (lambda r: rewrite(r / "run.json", dataset=str(make_rolls(r.parent / "e", 3))), "its content is"),
    "not finite": (lambda r: spoil(r / "checkpoints/step-00000020.safetensors"), "has values that are not finite"),
    "resume not finite": (lambda r: spoil(r / "resume.safetensors"), "has values that are not finite"),
    "another name": (
        lambda r: (r / "checkpoints/step-00000020.safetensors").rename(r / "checkpoints/step-00000030.safetensors"),
        "holds the weights after 20 steps",
    ),
    "text for a number": (lambda r: (r / "metrics.jsonl").write_text('{"kind":"train","step":"x"}\n'), "line 1 is"),
    "cut episodes": (lambda r: (r / EPISODES).write_text('{"task":\n'), "line 1 is damaged"),
    "long normalizer": (
        lambda r: rewrite(r / "policy.json", policy=_longer(json.loads((r / "policy.json").read_text())["policy"])),
        "normalizer.state must have 9 finite offsets and positive units",
    ),
}


def _longer(policy: dict[str, object]) -> dict[str, object]:
    normalizer = dict(policy["normalizer"])  # type: ignore[call-overload]
    return {**policy, "normalizer": {**normalizer, "state": {"offset": [0] * 8, "unit": [1] * 9}}}


@pytest.mark.parametrize("problem", PROBLEMS)
def test_each_problem_is_a_finding(problem: str, run: Path, tmp_path: Path, capsys: Capture) -> None:
    damage, sentence = PROBLEMS[problem]
    work = Path(shutil.copytree(run, tmp_path / "run"))
    damage(work)
    code, out, err = call_cli(capsys, "validate", work)
    assert code == 3
    assert sentence in out
    assert err.startswith(f"flowlab: {work}: ")


def test_of_a_run_without_digests_that_is_said(run: Path, tmp_path: Path, capsys: Capture) -> None:
    old = Path(shutil.copytree(OLD / "fdp", tmp_path / "fdp"))
    code, out, _ = call_cli(capsys, "validate", old)
    assert code == 3
    assert out.count("\n") == 1, "but for its dataset, which is not here, it is sound"
    assert f"{old}/run.json: dataset: " in out
    work = Path(shutil.copytree(run, tmp_path / "run"))
    for path in (work / "policy.json", work / "run.json"):
        path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k != "sha256"}))
    assert call_cli(capsys, "validate", work) == (
        0, f"{work}: sound; of an earlier version, without checksums: a changed number is not found\n", ""
    )  # fmt: skip


def test_a_network_of_any_size_takes_no_memory(run: Path, tmp_path: Path, capsys: Capture) -> None:
    """One that was never trained, of 80 GB; its weights are small."""
    work = Path(shutil.copytree(run, tmp_path / "run"))
    policy = json.loads((work / "policy.json").read_text())["policy"]
    policy["settings"]["encoder"]["widths"] = [100_000, 100_000]
    rewrite(work / "policy.json", policy=policy)
    for path in work.rglob("*.safetensors"):
        save_file(load_file(path), path, {"step": str(int(path.stem[5:] if "step" in path.stem else 20))})
    for command in (("validate", work), ("train", work, "--resume"), ("eval", work, "--offline")):
        code, out, err = call_cli(capsys, *command)
        assert code == 3
        assert "policy.json; restore both from one run" in out + err
