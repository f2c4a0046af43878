"""Training runs that take a second, through the command line, for the tests of whole runs."""

import json
import struct
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file
from synthetic import call_cli, make_dataset, make_episode, with_quality

from flowlab.cli import main
from flowlab.policies.profiles import load_settings
from flowlab.records import Episode, Queries

NETWORK = Path(__file__).parent / "profiles/network.yaml"
"""A profile with small networks; it says nothing of how long a run takes."""


def options(*changes: str) -> list[str]:
    """``--set`` for each of some changed settings."""
    return [word for change in changes for word in ("--set", change)]


SMALL = ("--profile", str(Path(__file__).parent / "profiles/small.yaml"))
"""The same, and a run of 20 steps, with a checkpoint after every fourth and a look at held-out demonstrations after
every fifth."""


def small_settings(policy: str, *changes: str) -> Any:
    """The settings of such a run."""
    return load_settings(SMALL[1], policy, changes)


def make_rolls(folder: Path, episodes: int = 4, **changes: Any) -> Path:
    """A dataset of balls that roll for 20 steps."""
    make_dataset(folder, [[make_episode(k, steps=20) for k in range(episodes)]], **changes)
    return folder


def train(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """``flowlab train``, here, which must succeed; its output."""
    code, out, err = call_cli(capsys, "train", *arguments)
    assert code == 0, err
    return out


def make_run(*arguments: str | Path) -> Path:
    """The same without a word, for what several tests share; the folder behind ``--out``."""
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        main("train", *map(str, arguments))
    return Path(arguments[arguments.index("--out") + 1])


def lines_of(run: Path, kind: str | None = None) -> list[dict[str, Any]]:
    """Lines of ``metrics.jsonl`` without their digests, of one kind or of all."""
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert all(line.pop("sha256") for line in lines)
    return [line for line in lines if kind in (None, line["kind"])]


def without_times(lines: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """What does not depend on how fast the machine is."""
    return [{k: v for k, v in line.items() if k not in ("cpu_s", "wall_s", "samples_per_s")} for line in lines]


def saved_by(run: Path) -> dict[str, bytes]:
    """The bytes of all weights of a run, and of what resuming needs."""
    return {str(f.relative_to(run)): f.read_bytes() for f in sorted(run.rglob("*.safetensors"))}


def policy_of(run: Path) -> dict[str, Any]:
    """``policy.json``."""
    return json.loads((run / "policy.json").read_text())


def weights_of(run: Path, step: int) -> dict[str, np.ndarray]:
    """The averaged weights that a run had after some steps."""
    return load_file(run / f"checkpoints/step-{step:08d}.safetensors")


def header_of(path: Path) -> dict[str, Any]:
    """The header of a safetensors file, read as the format's specification says."""
    content = path.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    header = json.loads(content[8 : 8 + length])
    ends = [about["data_offsets"][1] for name, about in header.items() if name != "__metadata__"]
    assert 8 + length + max(ends) == len(content)
    return header


def step_in(path: Path) -> int:
    """The training step that a file of weights says it is of."""
    return int(json.loads(header_of(path)["__metadata__"]["flowlab"])["step"])


def leftovers(folder: Path) -> list[str]:
    """Temporary files that somebody left behind."""
    return [str(p.relative_to(folder)) for p in folder.rglob(".tmp*")]


def make_recorded(seed: int, steps: int = 24) -> Episode:
    """As from a recording: position, quaternion and gripper; the action is where the robot is a step later."""
    rng = np.random.default_rng(seed)
    episode = with_quality(make_episode(seed, task="pour", steps=steps, queries=12, object_pose=False), seed)
    assert episode.tracks.quality is not None
    wander = 0.01 * rng.normal(size=(steps, 3)).cumsum(0)
    hand = episode.point_cloud[:, 0] + 0.1 * (wander - wander[0])  # it holds the ball there, and turns with it
    turn = np.tile([1.0, 0, 0, 0], (steps, 1)) + 0.05 * rng.normal(size=(steps, 4))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    state = np.concatenate([hand, turn, rng.uniform(0, 0.08, (steps, 1))], 1).astype(np.float32)
    return replace(
        episode,
        state=state,
        action=np.concatenate([state[1:], state[-1:]]),
        queries=Queries(episode.queries.xyz_world, np.full(12, -1, np.int16), 12),
    )
