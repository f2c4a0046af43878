"""Demonstrations that are made up, for policies to be tried on."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from flowlab.data.batch_builder import BatchBuilder
from flowlab.data.batches import Batch
from flowlab.data.channels import ChannelSpec
from flowlab.data.needs import Needs
from flowlab.data.normalizer import Normalizer, Scale
from flowlab.data.replay_buffer import EpisodeSlice, ReplayBuffer
from flowlab.data.window_sampler import index_windows
from flowlab.policies.base import PolicyNetwork
from flowlab.policies.profiles import load_settings
from flowlab.policies.spec import PolicySpec
from flowlab.records import Role

TASKS = ("pour", "roll")
LENGTHS = (24, 18, 21)
"""Steps of each made-up demonstration."""
STATE, ACTION = 5, 4
"""Numbers of its state, and of its action."""
PICTURE = 32
"""Height and width of its pictures [px]."""


@dataclass(frozen=True, slots=True)
class Problem:
    """A policy with random weights, and demonstrations to learn."""

    policy: PolicyNetwork
    batch: Batch
    """Every window of the demonstrations."""


def make_problem(policy: type[PolicyNetwork], settings: Sequence[str] = ()) -> Problem:
    """Demonstrations in which the state tells the action, with all that the policy needs, and nothing else.

    Args:
        policy: The class.
        settings: Changes to its settings, ``key.path=value``.
    """
    name = f"{policy.__module__}:{policy.__qualname__}"
    chosen = load_settings("fast", name, ["batch.windows=8", "batch.segment=2", *settings])
    buffer = make_buffer(chosen.needs)
    spec = PolicySpec(
        settings=chosen,
        state_width=STATE,
        action_width=ACTION,
        tasks=TASKS,
        channels=ChannelSpec(),
        normalizer=_normalizer(chosen.needs),
        observer=None,
        queries={} if chosen.needs.flow is None else chosen.needs.flow.query_settings,
    )
    windows = index_windows(buffer, range(len(LENGTHS)), chosen.n_action_steps)
    torch.manual_seed(0)
    return Problem(policy(spec), BatchBuilder(buffer, spec.channels, chosen, TASKS).build(windows))


def make_buffer(needs: Needs) -> ReplayBuffer:
    """The demonstrations: smooth random states, from which everything else follows."""
    rng = np.random.default_rng(0)
    ends = np.cumsum(LENGTHS).tolist()
    starts = [0, *ends[:-1]]
    frames = ends[-1]
    points = needs.point_cloud.points if needs.point_cloud is not None else 1
    queries = needs.flow.points if needs.flow is not None else 1
    state = np.cumsum(rng.normal(0, 0.1, (frames, STATE)), 0)
    away = state[:, None, :3]
    tracks = rng.normal(0, 0.3, (1, queries, 3)) + away
    ramp = np.linspace(0, 1, PICTURE)[None, :, None, None] * (1 + np.tanh(state[:, None, None, :3])) / 2
    picture = np.broadcast_to(ramp, (frames, PICTURE, PICTURE, 3))
    return ReplayBuffer(
        episodes=tuple(
            EpisodeSlice(TASKS[k % 2], k, start, stop) for k, (start, stop) in enumerate(zip(starts, ends, strict=True))
        ),
        point_cloud=(rng.normal(0, 0.3, (1, points, 3)) + away).astype(np.float32),
        state=state.astype(np.float32),
        action=np.tanh(state[:, :ACTION]).astype(np.float32),
        tracks=tracks.astype(np.float32),
        visible=rng.random((frames, queries)) < 0.8,
        sigma=np.zeros((frames, queries), np.float32),
        object_pose=np.concatenate([state[:, :3], np.tile(np.eye(3)[:2].ravel(), (frames, 1))], 1).astype(np.float32),
        queries=tracks[starts].astype(np.float32),
        query_role=np.full((len(LENGTHS), queries), Role.OBJECT),
        query_count=np.full((len(LENGTHS), 1), queries),
        rgb=(255 * picture).astype(np.uint8) if needs.rgb else None,
        depth=(0.5 + picture[..., 0]).astype(np.float32) if needs.depth else None,
    )


def _normalizer(needs: Needs) -> Normalizer:
    same = Scale(offset=(0.0,) * 3, unit=(1.0,) * 3)
    return Normalizer(
        position=same,
        state=Scale(offset=(0.0,) * STATE, unit=(1.0,) * STATE),
        action=Scale(offset=(0.0,) * ACTION, unit=(1.0,) * ACTION),
        flow=None if needs.flow is None else same,
        flow_clip=None if needs.flow is None else 3.0,
    )
