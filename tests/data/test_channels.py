"""Which numbers are places is known of simulation, measured of recordings, and never guessed."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import recorded
from synthetic import make_dataset, make_episode

from flowlab.data.channels import ChannelSpec, infer_channels
from flowlab.data.replay_buffer import load_buffer
from flowlab.data.source import open_training_source
from flowlab.pipeline.recipe import load_recipe
from flowlab.records import Episode
from flowlab.storage.dataset import Dataset
from flowlab.storage.exporters.dp3 import DP3Exporter

FIRST = (0, 1, 2)
PER_STEP = ("time_s", "point_cloud", "point_count", "state", "action", "success", "object_pose")


def channels_of(folder: Path, episodes: list[Episode], **changes: Any) -> ChannelSpec:
    make_dataset(folder, [episodes], **changes)
    source = open_training_source(folder)
    return infer_channels(source, load_buffer(source, folder))


@pytest.mark.parametrize("recipe", ["metaworld", "metaworld-dp3"])
def test_of_simulation_it_is_known(tmp_path: Path, recipe: str) -> None:
    """Hand and both fingers are places; actions are displacements. DP3's frame is the camera's, its state's is not."""
    settings = load_recipe(recipe, []).settings()
    found = channels_of(tmp_path / "d", [make_episode(k) for k in range(3)], settings=settings)
    if recipe == "metaworld":
        assert found == ChannelSpec(
            gripper=FIRST, state_positions=(FIRST, (3, 4, 5), (6, 7, 8)), action_displacement=FIRST
        )
    else:
        assert found == ChannelSpec()


def test_of_a_recording_whose_gripper_is_seen_and_sent_to_places(tmp_path: Path) -> None:
    found = channels_of(tmp_path / "d", [recorded(k) for k in range(3)])
    assert found == ChannelSpec(gripper=FIRST, state_positions=(FIRST,), action_position=FIRST)


def test_displacements_are_no_places(tmp_path: Path) -> None:
    def displacement(position: np.ndarray) -> np.ndarray:
        return np.diff(position, axis=0, append=position[-1:])

    found = channels_of(tmp_path / "d", [recorded(k, action=displacement) for k in range(3)])
    assert found == ChannelSpec(gripper=FIRST, state_positions=(FIRST,))
    assert not found.shifts, "along x alone, nobody can tell what y and z are"


def driven(seed: int, command: str) -> Episode:
    """An arm that is sent about, and goes a fifth of the way to where it is sent in every step; what it holds is seen.

    It is sent by what ``command`` says. Targets are 3 to 8 cm away while it goes.
    """
    steps = 90
    e, rng = make_episode(seed, steps=steps), np.random.default_rng(seed)
    goals = np.array([0.0, 0.6, 0.2]) + rng.uniform(-0.15, 0.15, (6, 3))
    target = np.stack([np.interp(np.arange(steps), np.linspace(0, steps - 10, 6), goals[:, k]) for k in range(3)], 1)
    hand = np.repeat(target[:1], steps, 0)
    for t in range(1, steps):
        hand[t] = hand[t - 1] + 0.2 * (target[t - 1] - hand[t - 1])
    tracks = hand[:, None] + rng.uniform(-0.03, 0.03, (8, 3))
    reach, height = np.linalg.norm(hand[:, :2], axis=1), hand[:, 2]
    elbow = np.arccos(np.clip((reach**2 + height**2 - 0.5) / 0.5, -1, 1))
    action = {
        "targets": target,
        "targets of a flange": target + np.array([0, 0, 0.1]),
        "targets from the start": target - target[0] + np.array([0, 0, 3.0 * seed]),
        "displacements": (target - hand) * 20,
        "displacements in a turned frame": (target - hand)[:, [1, 0, 2]] * np.array([20, -20, 20]),
        "joint angles": np.stack([np.arctan2(hand[:, 1], hand[:, 0]), np.arctan2(height, reach) - elbow / 2, elbow], 1),
    }[command]
    return replace(
        e,
        state=np.c_[hand, np.zeros((steps, 1))].astype(np.float32),
        action=np.c_[action, np.zeros((steps, 1))].astype(np.float32),
        tracks=replace(e.tracks, xyz_world=tracks.astype(np.float32), visible=np.ones((steps, 8), bool)),
    )


@pytest.mark.parametrize(
    ("command", "kind"),
    [
        ("targets", "position"),
        ("targets of a flange", "position"),
        ("targets from the start", None),
        ("displacements", "displacement"),
        ("displacements in a turned frame", None),
        ("joint angles", None),
    ],
)
def test_an_arm_that_lags_shows_what_it_is_sent_by(tmp_path: Path, command: str, kind: str | None) -> None:
    found = channels_of(tmp_path / "d", [driven(k, command) for k in range(3)])
    assert found.gripper == FIRST
    assert found.action_position == (FIRST if kind == "position" else None)
    assert found.action_displacement == (FIRST if kind == "displacement" else None)
    assert found.shifts == (kind is not None), "a scene is shifted only with actions that can be shifted, too"


def test_of_more_numbers_than_one_arm_has_nobody_knows_what_else_is_a_place(tmp_path: Path) -> None:
    both = [replace(e, action=np.tile(e.action, 3)) for e in (driven(k, "targets") for k in range(3))]
    assert channels_of(tmp_path / "d", both) == ChannelSpec(gripper=FIRST, state_positions=(FIRST,))


def test_actions_of_two_numbers_are_no_places(tmp_path: Path) -> None:
    episodes = [replace(e, action=e.action[:, :2]) for e in map(recorded, range(3))]
    assert channels_of(tmp_path / "d", episodes) == ChannelSpec(gripper=FIRST, state_positions=(FIRST,))


@pytest.mark.parametrize(("away", "seen"), [(0.0, True), (0.17, False)])
def test_a_gripper_far_from_all_points_is_none(tmp_path: Path, away: float, seen: bool) -> None:
    """Nothing within 10 cm can show that it is there."""
    found = channels_of(tmp_path / "d", [recorded(k, away=away) for k in range(3)])
    assert (found.gripper is not None) == seen
    if not seen:
        assert found == ChannelSpec(), "then nothing is known to be in the frame of the points"


@pytest.mark.parametrize(("off", "places"), [(0.015, True), (0.1, True), (0.2, False)])
def test_actions_are_places_where_the_gripper_gets_near_them(tmp_path: Path, off: float, places: bool) -> None:
    def missed(position: np.ndarray) -> np.ndarray:
        return np.concatenate([position[1:], position[-1:]]) + np.array([0, off, 0])

    found = channels_of(tmp_path / "d", [recorded(k, action=missed) for k in range(3)])
    assert (found.action_position == FIRST) == places


def test_actions_are_compared_with_where_the_gripper_is_a_step_later(tmp_path: Path) -> None:
    """Here it moves 4 cm a step; the last action of a demonstration is followed by nothing."""

    def fast(seed: int) -> Episode:
        e = recorded(seed)
        kept = np.arange(0, len(e), 4)
        then = e.state[[*kept[1:], kept[-1]], :3]
        then[-1] += 5
        rows = {name: getattr(e, name)[kept] for name in PER_STEP}
        tracks = replace(e.tracks, xyz_world=e.tracks.xyz_world[kept], visible=e.tracks.visible[kept])
        action = np.concatenate([then, rows["action"][:, 3:]], 1)
        return replace(e, **rows | {"tracks": tracks, "action": action})

    episodes = [fast(k) for k in range(3)]
    assert [len(e) for e in episodes] == [3, 3, 3]
    assert channels_of(tmp_path / "d", episodes).action_position == FIRST


def test_a_state_of_two_numbers_has_no_place(tmp_path: Path) -> None:
    episodes = [replace(e, state=e.state[:, :2]) for e in map(recorded, range(3))]
    assert channels_of(tmp_path / "d", episodes) == ChannelSpec()


def test_of_a_store_in_dp3s_layout_nothing_is_known(tmp_path: Path) -> None:
    make_dataset(tmp_path / "d", [[recorded(k) for k in range(3)]])
    DP3Exporter().export(Dataset(tmp_path / "d"), tmp_path / "s.zarr")
    source = open_training_source(tmp_path / "s.zarr")
    assert infer_channels(source, load_buffer(source, tmp_path)) == ChannelSpec()


@pytest.mark.parametrize("kind", ["joint angles", "another frame", "lies still"])
def test_numbers_near_points_that_do_not_move_with_them_are_no_gripper(tmp_path: Path, kind: str) -> None:
    """Nearness is chance: the first numbers are near the ball all the time, and the ball does not go with them."""

    def near(k: int) -> Episode:
        e = recorded(k)
        t = np.arange(len(e))[:, None]
        way = {
            "joint angles": 0.05 * np.sin(t * [0.9, 1.3, 0.7]),
            "another frame": np.cumsum(np.tile([[-0.01, 0.0, 0.0]], (len(e), 1)), 0)[::-1] * [[1, 0, 0]]
            + 0.01 * t[::-1],
            "lies still": np.zeros((len(e), 3)),
        }[kind]
        start = e.state[:1, :3] + (e.state[-1:, :3] - e.state[:1, :3]) / 2
        return replace(e, state=np.concatenate([start + way, e.state[:, 3:]], 1).astype(np.float32))

    assert channels_of(tmp_path / "d", [near(k) for k in range(3)]).gripper is None


@pytest.mark.parametrize(
    ("degrees", "scale", "seen"),
    [(0, 1.0, True), (5, 1.0, True), (30, 1.0, False), (60, 1.0, False), (0, 1.5, False), (0, 0.6, False)],
)
def test_a_gripper_goes_the_way_on_which_points_take_it(
    tmp_path: Path, degrees: float, scale: float, seen: bool
) -> None:
    """Of a state in a frame that is turned, or in other units, the distance to points alone would not tell."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = scale * np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    def turned(e: Episode) -> Episode:
        middle = e.state[:, :3].mean(0)
        return replace(e, state=np.c_[(e.state[:, :3] - middle) @ turn.T + middle, e.state[:, 3:]].astype(np.float32))

    found = channels_of(tmp_path / "d", [turned(recorded(k)) for k in range(3)])
    assert found.gripper == (FIRST if seen else None)
