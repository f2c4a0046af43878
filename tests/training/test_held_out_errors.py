"""Errors on held-out demonstrations are distances one can work out by hand."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from builders import every_window, random_buffer, tiny_settings, tiny_spec

from flowlab.data.batch_builder import BatchBuilder
from flowlab.data.batches import Batch, ObservationBatch
from flowlab.data.channels import ChannelSpec
from flowlab.data.replay_buffer import EpisodeSlice, ReplayBuffer
from flowlab.data.training_settings import TrainSettings
from flowlab.data.window_sampler import WindowIndex
from flowlab.nets.diffusion import NoiseSampler
from flowlab.policies.base import ActionPlan, Generators, Losses, PolicyNetwork, make_policy
from flowlab.training.validation import validate

NOW, HORIZON, EXECUTED, LENGTH = 1, 8, 4, 30
STEP_M = 0.01


class Oracle(PolicyNetwork):
    """Plans what was demonstrated, and so much more."""

    action_off = 0.0
    flow_off = pose_off = (0.0, 0.0, 0.0)
    from_row, to_row = 0, HORIZON

    def compute_loss(self, batch: Batch, noise: NoiseSampler, windows: int) -> Losses:
        raise AssertionError("is not trained")

    def plan(self, context: ObservationBatch, generators: Generators = None) -> ActionPlan:
        assert isinstance(context, Batch)
        rows = slice(self.from_row, self.to_row)
        flow, pose = context.flow.clone(), context.object_pose.clone()
        flow[:, rows] += torch.tensor(self.flow_off)
        name = self.spec.settings.policy
        if name == "mba":
            pose[:, rows] += torch.tensor([*self.pose_off] + [0.0] * 6)
        return ActionPlan(
            context.action + self.action_off,
            flow if name == "fdp" else None,
            pose if name == "mba" else None,
        )


def oracle(settings: TrainSettings, **off: Any) -> Oracle:
    policy = Oracle(tiny_spec(settings))
    for name, value in off.items():
        assert hasattr(policy, name)
        setattr(policy, name, value)
    return policy


def rolling(demos: int = 2) -> ReplayBuffer:
    """Points 0 to 3 and the object go on by 1 cm a step, each its own way; points 4 and 5 lie still.

    Action t is (t, 2 t, 0, 1) / 10.
    """
    buffer = random_buffer([("roll", LENGTH)] * demos)
    t = np.arange(LENGTH)[:, None, None]
    ways = np.array([[1.0, 0, 0], [0, 1, 0], [0, -1, 0], [0.6, 0, 0.8], [0, 0, 0], [0, 0, 0]])
    tracks = np.tile((t * STEP_M * ways).astype(np.float32), (demos, 1, 1))
    pose = np.array(buffer.object_pose)
    pose[:, :3] = tracks[:, 3]
    action = np.stack([t, 2 * t, 0 * t, 0 * t + 10], -1)[:, 0, 0] / 10
    return replace(
        buffer,
        tracks=tracks,
        object_pose=pose,
        action=np.tile(action.astype(np.float32), (demos, 1)),
        visible=np.ones_like(buffer.visible),
        sigma=np.zeros_like(buffer.sigma),
    )


def errors(buffer: ReplayBuffer, policy: PolicyNetwork, rows: list[int] | None = None) -> dict[str, float]:
    """The errors in all windows, or in those of the first demonstration's that are decided on at some rows."""
    s = policy.spec.settings
    windows = every_window(buffer, s)
    if rows is not None:
        windows = WindowIndex(np.zeros(len(rows), int), np.array(rows), np.zeros(len(rows), int))
    builder = BatchBuilder(buffer, ChannelSpec(), s, buffer.tasks)
    return validate(policy, builder, windows, torch.device("cpu"))


@pytest.mark.parametrize("name", ["dp3", "fdp", "mba"])
def test_the_truth_has_no_error(name: str) -> None:
    buffer = random_buffer()
    buffer.tracks[:, 5] *= 1e-3  # hardly moves
    found = errors(buffer, oracle(tiny_settings(name)))
    kinds = {"dp3": [], "fdp": ["flow_moving_mm", "flow_static_mm"], "mba": ["pose_mm"]}[name]
    assert found.keys() == {f"action_l1{x}" for x in ("", "_zero", "_hold")} | {
        f"{kind}{x}" for kind in kinds for x in ("", "_zero", "_constant")
    }
    for kind in ("action_l1", *kinds):
        assert found.pop(kind) < 1e-4
    assert min(found.values()) > 1e-3


def test_with_one_frame_there_is_no_past_to_go_on_from() -> None:
    found = errors(random_buffer(), oracle(tiny_settings("fdp", "n_obs_steps=1")))
    assert found.keys() == {f"{kind}{x}" for kind in ("action_l1", "flow_moving_mm") for x in ("", "_zero")}


def test_an_offset_of_actions_is_the_error_whatever_their_number() -> None:
    found = errors(rolling(), oracle(tiny_settings("dp3"), action_off=-0.25))
    assert found["action_l1"] == pytest.approx(0.25, rel=1e-5)


def test_only_executed_actions_count_and_only_demonstrated_ones() -> None:
    for rows in (slice(0, NOW), slice(NOW + EXECUTED, HORIZON)):
        off = {"action_off": torch.zeros(HORIZON, 1).index_fill(0, torch.arange(HORIZON)[rows], 9.0)}
        assert errors(rolling(), oracle(tiny_settings("dp3"), **off))["action_l1"] < 1e-6
    # Of a demonstration of two steps, three of four executed actions have no truth where now is the last.
    short = random_buffer([("roll", 2)])
    off = {"action_off": torch.tensor([0.0, 3.0, 9.0, 9.0, 9.0, 9.0, 9.0, 9.0])[:, None]}
    windows = {"episode": np.zeros(1, int), "now": np.ones(1, int), "run": np.zeros(1, int)}
    settings = tiny_settings("dp3")
    builder = BatchBuilder(short, ChannelSpec(), settings, short.tasks)
    found = validate(oracle(settings, **off), builder, WindowIndex(**windows), torch.device("cpu"))
    assert found["action_l1"] == pytest.approx(3)


def test_doing_nothing_and_repeating_the_last_action_in_closed_form() -> None:
    """Action t is (t, 2 t, 0, 10) / 10: at t from now to now + 3, and held from now - 1."""
    found = errors(rolling(), oracle(tiny_settings("dp3")), rows=[5, 12])
    wanted = np.mean([(3 * (now + k) + 10) / 10 / 4 for now in (5, 12) for k in range(EXECUTED)])
    assert found["action_l1_zero"] == pytest.approx(wanted, rel=1e-5)
    assert found["action_l1_hold"] == pytest.approx(np.mean([3 * k / 10 / 4 for k in (1, 2, 3, 4)]), rel=1e-5)


def test_a_position_off_by_so_much_is_off_by_that_many_mm() -> None:
    """An error of the first displacement is one of all later positions; one before now is none."""
    off = {"flow_off": (0.003, 0.0, -0.004), "from_row": NOW, "to_row": NOW + 1}
    found = errors(rolling(), oracle(tiny_settings("fdp"), **off))
    assert found["flow_moving_mm"] == pytest.approx(5, rel=1e-4)
    assert found["flow_static_mm"] == pytest.approx(5, rel=1e-4)
    before = errors(rolling(), oracle(tiny_settings("fdp"), **off | {"from_row": 0, "to_row": NOW}))
    assert before["flow_moving_mm"] < 1e-4


def test_errors_of_displacements_add_up_along_the_way() -> None:
    found = errors(rolling(), oracle(tiny_settings("fdp"), flow_off=(0.0, 0.002, 0.0)), rows=[5])
    wanted = np.mean([2 * k for k in range(1, HORIZON - NOW + 1)])
    assert found["flow_moving_mm"] == pytest.approx(wanted, rel=1e-4)


def test_standing_still_and_going_on_as_before_in_closed_form() -> None:
    found = errors(rolling(), oracle(tiny_settings("fdp")), rows=[5, 12, 20])
    steps = np.arange(1, HORIZON - NOW + 1)
    assert found["flow_moving_mm_zero"] == pytest.approx(1e3 * STEP_M * steps.mean(), rel=1e-4)
    assert found["flow_moving_mm_constant"] < 1e-3, "what moves uniformly goes on as before"
    assert found["flow_static_mm_zero"] == found["flow_static_mm_constant"] == 0


def test_before_the_first_step_nothing_is_known_of_the_velocity() -> None:
    found = errors(rolling(), oracle(tiny_settings("fdp")), rows=[0])
    assert found["flow_moving_mm_constant"] == found["flow_moving_mm_zero"] > 1


def test_near_the_end_only_what_the_labels_cover_counts() -> None:
    """From row 26 of 30 the points move three more times."""
    found = errors(rolling(), oracle(tiny_settings("fdp"), flow_off=(0.0, 0.0, 0.001)), rows=[26])
    assert found["flow_moving_mm"] == pytest.approx(np.mean([1, 2, 3]), rel=1e-4)
    assert found["flow_moving_mm_zero"] == pytest.approx(10 * np.mean([1, 2, 3]), rel=1e-4)


def test_what_moves_is_told_from_what_does_not_by_5_mm() -> None:
    buffer = rolling(1)
    tracks = np.array(buffer.tracks)
    t = np.arange(LENGTH)
    tracks[:, 4, 2] = np.where(t >= 10, 0.0051, 0)  # once, when t gets to 10
    tracks[:, 5, 2] = np.where(t >= 10, 0.0049, 0)
    buffer = replace(buffer, tracks=tracks)
    found = errors(buffer, oracle(tiny_settings("fdp")), rows=[9])
    steps = np.arange(1, HORIZON - NOW + 1)
    assert found["flow_moving_mm_zero"] == pytest.approx((4 * 10 * steps.mean() + 5.1) / 5, rel=1e-3)
    assert found["flow_static_mm_zero"] == pytest.approx(4.9, rel=1e-3)


def test_points_that_have_no_label_weight_do_not_count() -> None:
    buffer = rolling(1)
    buffer.visible[:, 1:] = False
    settings = tiny_settings("fdp", "motion.occluded_weight=0.0")
    found = errors(buffer, oracle(settings, flow_off=(0.001, 0.0, 0.0), from_row=NOW, to_row=NOW + 1), rows=[5])
    assert found["flow_moving_mm"] == pytest.approx(1, rel=1e-3)
    assert "flow_static_mm" not in found, "none of those is seen"
    # Where a point is out of sight once, what follows is not known either: positions add up.
    buffer.visible[8, 0] = False
    found = errors(buffer, oracle(settings), rows=[5])
    assert found["flow_moving_mm_zero"] == pytest.approx(np.mean([10, 20]), rel=1e-3)


def test_the_position_of_an_object_is_off_by_so_many_mm() -> None:
    settings = tiny_settings("mba")
    found = errors(rolling(), oracle(settings, pose_off=(0.0, 0.006, 0.008)))
    assert found["pose_mm"] == pytest.approx(10, rel=1e-4)
    now = errors(rolling(), oracle(settings, pose_off=(0.0, 0.006, 0.008), to_row=NOW + 1))
    assert now["pose_mm"] < 1e-4, "where it is now is no prediction"
    found = errors(rolling(), oracle(settings), rows=[5, 26])
    steps = [*range(1, HORIZON - NOW), 1, 2, 3]
    assert found["pose_mm_zero"] == pytest.approx(10 * np.mean(steps), rel=1e-4)
    assert found["pose_mm_constant"] < 1e-3


def test_a_real_policy_has_the_same_errors_each_time() -> None:
    torch.manual_seed(0)
    policy = make_policy(tiny_spec(tiny_settings("fdp")))
    first = errors(random_buffer(), policy)
    torch.manual_seed(1)
    assert errors(random_buffer(), policy) == first
    assert first["action_l1"] > 0.01


def test_of_many_windows_some_are_looked_at_evenly_spaced() -> None:
    seen: list[float] = []

    class Counting(Oracle):
        def plan(self, context: ObservationBatch, generators: Generators = None) -> ActionPlan:
            assert len(context.observed) <= 64
            seen.extend(context.state[context.observed[:, -1], 0].tolist())
            return super().plan(context, generators)

    settings = tiny_settings("dp3")
    buffer = random_buffer([("roll", 1003)], points=24)
    buffer.state[:, 0] = np.arange(1003)
    assert len(every_window(buffer, settings).now) == 1000
    errors(buffer, Counting(tiny_spec(settings)))
    assert len(seen) == len(set(seen)) == 256
    assert (seen[0], seen[-1]) == (0, 999)
    assert set(np.diff(seen)) <= {3, 4}


def test_windows_are_weighed_alike_however_they_are_portioned() -> None:
    """Means are over all that counts, not over portions."""
    buffer = rolling(3)
    demos = tuple(EpisodeSlice("roll", d.seed, d.start, d.stop) for d in buffer.episodes)
    policy = oracle(tiny_settings("fdp"), flow_off=(0.001, 0.0, 0.0))
    whole = errors(replace(buffer, episodes=demos), policy)
    windows = every_window(buffer, policy.spec.settings)
    assert len(windows.now) == 81
    steps = [np.arange(1, min(HORIZON - NOW, LENGTH - 1 - now) + 1) for now in range(27)]
    assert whole["flow_static_mm"] == pytest.approx(np.concatenate(steps).mean(), rel=1e-4)
