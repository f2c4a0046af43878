"""Example 5 is a policy of another kind: it keeps a policy's promises, trains, is evaluated and drives a robot."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from run_example import EXAMPLES

from flowlab.deployment.robot_policy import Policy
from flowlab.errors import UsageError
from flowlab.policies.base import PolicyNetwork
from flowlab.records import Frame
from flowlab.storage.dataset import Dataset
from flowlab.testing.policies import CHECKS

FOLDER = EXAMPLES / "05_own_policy"
SMALL = ("network.size=32", "network.channels=[8,16]", "network.features=32")
ENVIRONMENT = os.environ | {"MUJOCO_GL": "egl", "PYTHONPATH": str(FOLDER)}


def flowlab(*arguments: str | Path, folder: Path | None = None) -> subprocess.CompletedProcess[str]:
    """The command line as the example's text calls it."""
    command = [sys.executable, "-m", "flowlab", *map(str, arguments)]
    return subprocess.run(
        command, env=ENVIRONMENT, cwd=folder, capture_output=True, text=True, timeout=280, check=False
    )


def options(*changes: str) -> list[str]:
    return [word for change in changes for word in ("--set", change)]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short demonstrations with color pictures."""
    folder = tmp_path_factory.mktemp("data") / "slide"
    scene = options("expert.scene.renderer=gl", "expert.scene.rgb=true", "write.rgb=true")
    done = flowlab("extract-sim", "plate-slide", "--episodes", 2, "--out", folder, "--workers", 1, *scene)
    if "OpenGL" in done.stderr:
        pytest.skip(f"color pictures need OpenGL: {done.stderr.strip()[:200]}")
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def run(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "pixels"
    small = options(*SMALL, "run.minutes=null", "run.steps=8", "run.checkpoints=1", "batch.windows=16")
    command = ("train", data, "--policy", "pixel_bc:PixelBC", "--out", out, *small, "--json")
    done = flowlab(*command, folder=FOLDER)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["step"] == 8
    return out


@pytest.fixture
def policy(monkeypatch: pytest.MonkeyPatch) -> type[PolicyNetwork]:
    monkeypatch.syspath_prepend(str(FOLDER))
    from pixel_bc import PixelBC

    return PixelBC  # type: ignore[no-any-return]


@pytest.mark.parametrize("check", CHECKS, ids=lambda c: c.__name__)
def test_it_keeps_the_promises_of_a_policy(check: Callable[..., None], policy: type[PolicyNetwork]) -> None:
    check(policy, SMALL)


SLOW = pytest.mark.slow
"""Color pictures by llvmpipe, episode after episode; tests/evaluation/test_color_policy.py has one."""


@SLOW
def test_it_is_evaluated_in_simulation(run: Path) -> None:
    done = flowlab("eval", run, "--episodes", 2, "--seeds", 0, "--workers", 1, "--json")
    assert done.returncode == 0, done.stderr
    (log,) = run.rglob("episodes.jsonl")
    tried = [json.loads(line) for line in log.read_text().splitlines()]
    assert [(t["task"], t.get("note", "")) for t in tried] == [("plate-slide", "")] * 2


@SLOW
def test_it_drives_a_robot_by_color(run: Path, data: Path, policy: type[PolicyNetwork]) -> None:
    driver, episode = Policy.load(run), Dataset(data).episode(0)
    assert isinstance(driver.network, policy)
    assert episode.rgb is not None
    depth = np.ones(episode.rgb.shape[1:3], np.float32)

    def act(rgb: np.ndarray | None) -> np.ndarray:
        driver.reset(0)
        return driver.act(Frame(depth, episode.camera, rgb=rgb), episode.state[0])

    seen, other = act(episode.rgb[0]), act(255 - episode.rgb[0])
    assert seen.shape == (4,)
    assert not np.array_equal(seen, other), "it looks at the pictures"
    with pytest.raises(UsageError, match="needs color, and the frame has none"):
        act(None)


@SLOW
def test_where_its_module_is_not_found_a_run_says_so(run: Path) -> None:
    command = [sys.executable, "-m", "flowlab", "eval", run, "--episodes", "1"]
    environment = {k: v for k, v in ENVIRONMENT.items() if k != "PYTHONPATH"}
    done = subprocess.run(command, env=environment, cwd=run, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 3
    assert (
        "policy 'pixel_bc:PixelBC': cannot be imported (No module named 'pixel_bc'); install what has this policy, "
        in (done.stderr)
    )
    assert done.stderr.count("\n") == 1


def test_without_color_pictures_it_is_not_trained(small_dataset: Path, tmp_path: Path) -> None:
    done = flowlab("train", small_dataset, "--policy", "pixel_bc:PixelBC", "--out", tmp_path / "run", folder=FOLDER)
    assert done.returncode == 3
    assert "has no color pictures, which pixel_bc:PixelBC is trained on; make the dataset with them" in done.stderr
