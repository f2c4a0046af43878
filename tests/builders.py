"""Networks small enough to be quick, and demonstrations made of random numbers, for the tests of training."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from synthetic import make_episode

from flowlab.data.batch_builder import BatchBuilder
from flowlab.data.batches import Batch
from flowlab.data.channels import ChannelSpec
from flowlab.data.normalizer import Normalizer, Scale
from flowlab.data.replay_buffer import EpisodeSlice, ReplayBuffer
from flowlab.data.training_settings import TrainSettings
from flowlab.data.window_sampler import WindowIndex, index_windows
from flowlab.nets.diffusion import NoiseSampler
from flowlab.policies.base import PolicySpec
from flowlab.policies.profiles import load_settings
from flowlab.records import Episode, Role

MLP = "{kind: mlp, widths: [16, 16], step_embedding: 8}"
UNET = "{kind: unet, widths: [8, 16], step_embedding: 8}"
_SMALL = (
    "horizon=8",
    "n_action_steps=4",
    "encoder.points=24",
    "encoder.subset=null",
    "encoder.octaves=1",
    "encoder.relative=false",
    "encoder.widths=[16, 16]",
    "encoder.features=8",
    "encoder.state_widths=[8, 8]",
    f"action={MLP}",
    "diffusion.train_steps=20",
    "diffusion.inference_steps=5",
    "batch.windows=8",
    "batch.segment=2",
    "batch.draws=2",
    "batch.shift_m=0",
    "batch.turn_deg=0",
)
_SMALL_MOTION = ("motion.features=8", f"motion.denoiser={MLP}")
_SMALL_FLOW = ("motion.points=6", "motion.subset=null")
NORMALIZER = Normalizer(
    position=Scale(offset=(0.1, -0.2, 0.3), unit=(0.5, 0.5, 0.5)),
    state=Scale(offset=tuple(np.linspace(-0.3, 0.3, 9).tolist()), unit=tuple(np.linspace(0.5, 2, 9).tolist())),
    action=Scale(offset=(0.3, -0.1, 0.2, 0.5), unit=(2.0, 1.5, 1.0, 0.5)),
    flow=Scale(offset=(0, 0, 0), unit=(0.02, 0.02, 0.02)),
    flow_clip=3.0,
)
HAND = ChannelSpec(gripper=(0, 1, 2), state_positions=((0, 1, 2), (3, 4, 5)), action_position=(0, 1, 2))
"""Of a state that begins with two positions, the gripper's and another, and of an action that begins with one."""


def tiny_settings(policy: str, *overrides: str, profile: str = "fast") -> Any:
    """The settings of a profile with everything small."""
    motion = {"dp3": (), "mba": _SMALL_MOTION, "fdp": _SMALL_MOTION + _SMALL_FLOW}[policy]
    return load_settings(profile, policy, [*_SMALL, *motion, *overrides])


def tiny_spec(settings: TrainSettings, **changes: Any) -> PolicySpec:
    """What a policy for :func:`random_buffer` is built from."""
    values: dict[str, Any] = {
        "settings": settings,
        "state_width": 9,
        "action_width": 4,
        "tasks": ("pour", "roll"),
        "channels": ChannelSpec(),
        "normalizer": NORMALIZER,
        "observer": None,
        "queries": {},
    }
    return PolicySpec(**{**values, **changes})


def random_buffer(
    demos: Sequence[tuple[str, int]] = (("pour", 14), ("pour", 9), ("roll", 11)), *, points: int = 24, queries: int = 6
) -> ReplayBuffer:
    """Demonstrations of (task, length); every number is random, so that none is taken for another."""
    rng = np.random.default_rng(0)
    ends = np.cumsum([n for _, n in demos]).tolist()
    frames = ends[-1]
    tracks = rng.normal(0, 0.02, (frames, queries, 3)).cumsum(0)
    starts = [0, *ends[:-1]]
    role = rng.choice([Role.OBJECT, Role.ROBOT, Role.PROP, -1], (len(demos), queries))
    role[:, 0] = Role.OBJECT
    return ReplayBuffer(
        episodes=tuple(
            EpisodeSlice(task, seed, start, stop)
            for seed, ((task, _), start, stop) in enumerate(zip(demos, starts, ends, strict=True))
        ),
        point_cloud=rng.normal(0, 0.3, (frames, points, 3)).astype(np.float32),
        state=rng.normal(0, 0.3, (frames, 9)).astype(np.float32),
        action=rng.uniform(-1, 1, (frames, 4)).astype(np.float32),
        tracks=tracks.astype(np.float32),
        visible=rng.random((frames, queries)) < 0.7,
        sigma=rng.uniform(0, 0.02, (frames, queries)).astype(np.float32),
        object_pose=rng.normal(0, 0.3, (frames, 9)).astype(np.float32),
        queries=tracks[starts].astype(np.float32),
        query_role=role,
        query_count=np.full((len(demos), 1), queries),
    )


def recorded(seed: int, *, away: float = 0.0, action: Callable[[np.ndarray], np.ndarray] | None = None) -> Episode:
    """As of a recording: the gripper holds the ball; ``away`` moves it from there [m], along z.

    The state is position, quaternion and opening; so is the action, of where the gripper is a step later.
    """
    episode = make_episode(seed)
    assert episode.object_pose is not None
    position = episode.object_pose[:, :3] + np.array([0, 0, away], np.float32)
    rng = np.random.default_rng(seed)
    rest = rng.normal(size=(len(episode), 5)).astype(np.float32)
    then = np.concatenate([position[1:], position[-1:]])
    sent = then if action is None else action(position)
    return replace(
        episode,
        state=np.concatenate([position, rest], 1),
        action=np.concatenate([sent.astype(np.float32), rest], 1),
    )


def every_window(buffer: ReplayBuffer, settings: TrainSettings) -> WindowIndex:
    """All windows of all demonstrations, as one run."""
    return index_windows(buffer, list(range(len(buffer.episodes))), settings.n_action_steps)


def random_batch(settings: TrainSettings, channels: ChannelSpec | None = None) -> Batch:
    """All windows of :func:`random_buffer`."""
    buffer = random_buffer()
    return BatchBuilder(buffer, channels or ChannelSpec(), settings, buffer.tasks).build(every_window(buffer, settings))


def sampler(seed: int = 0, part: slice | None = None) -> NoiseSampler:
    return NoiseSampler(torch.Generator().manual_seed(seed), part=part)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)
