"""LeRobot's own class opens what was exported: ``make lerobot``, for it needs an environment of its own."""

import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic import make_dataset
from test_lerobot_exporter import COLOR, DEPTH, FPS, episode

from flowlab.records import Episode
from flowlab.storage.exporters.lerobot import LeRobotExporter

PYTHON = os.environ.get("FLOWLAB_LEROBOT", "")
"""Of an environment with LeRobot."""
pytestmark = pytest.mark.skipif(not PYTHON, reason="make lerobot sets up what this needs")
HOW: dict[str, dict[str, Any]] = {
    "as it is": {},
    "without loss, flat": {"rgb": "image", "depth": "m", "flat": True},
    "all videos": {"depth": "video"},
}


@pytest.mark.parametrize("how", HOW)
def test_lerobot_opens_it(how: str, tmp_path: Path) -> None:
    made: list[Episode] = [episode(0, "lift"), episode(0)]
    LeRobotExporter(**HOW[how]).export(make_dataset(tmp_path / "d", [made[:1], made[1:]]), tmp_path / "x")
    env = {
        **os.environ,
        "HF_HUB_OFFLINE": "1",
        "HF_HOME": str(tmp_path / "hf"),
        "HF_LEROBOT_HOME": str(tmp_path / "hf/lerobot"),
        "CUDA_VISIBLE_DEVICES": "",
    }
    script = Path(__file__).with_name("open_with_lerobot.py")
    done = subprocess.run(
        [PYTHON, script, tmp_path / "x", tmp_path / "out.npz"], env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    print(done.stdout)
    found = np.load(tmp_path / "out.npz")
    every = {
        "observation.state": [e.state for e in made],
        "action": [e.action for e in made],
        "observation.point_cloud": [e.point_cloud for e in made],
        "observation.tracks": [e.tracks.xyz_world for e in made],
        "observation.tracks_visible": [e.tracks.visible for e in made],
        "next.success": [e.success for e in made],
    }
    for name, values in every.items():
        rows = np.concatenate(values)
        np.testing.assert_array_equal(found[name].reshape(rows.shape), rows, name)
    assert found["task"].tolist() == [e.task for e in made for _ in range(len(e))]
    assert found["success"].tolist() == [True, True]
    np.testing.assert_allclose(found["timestamp"][: len(made[0])], np.arange(len(made[0])) / FPS, atol=1e-6)
    rgb, depth = (np.concatenate([getattr(e, name) for e in made]) for name in ("rgb", "depth"))
    off = np.abs(np.moveaxis(found[COLOR], 1, -1) * 255 - rgb)
    assert off.max() < 1e-3 if how == "without loss, flat" else off.mean() < 6
    seen = found[DEPTH][:, 0] / 1000  # it gives millimeters, whatever is stored
    np.testing.assert_allclose(seen[depth > 0], depth[depth > 0], atol=3e-3 if how == "all videos" else 1e-3)
    np.testing.assert_array_equal(found["window/action"], made[0].action[1:5])
    np.testing.assert_array_equal(found["window/observation.point_cloud"].reshape(2, -1, 3), made[0].point_cloud[:2])
    np.testing.assert_allclose(
        found["stats/observation.state/mean"], np.concatenate([e.state for e in made]).mean(0), atol=1e-5
    )
    np.testing.assert_array_equal(found[f"camera/{COLOR}"], made[0].camera.K)
