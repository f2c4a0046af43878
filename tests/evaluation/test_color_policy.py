"""A policy on pictures is shown them, in simulation and on a robot; one sentence says where there are none."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from builders import NORMALIZER
from synthetic import CAMERA

from flowlab.data.batches import Batch, ObservationBatch
from flowlab.data.channels import ChannelSpec
from flowlab.data.needs import Needs
from flowlab.data.training_settings import BatchSettings, TrainSettings
from flowlab.deployment.robot_policy import Policy
from flowlab.errors import DataError, MissingLibraryError, UsageError
from flowlab.evaluation.checkpoints import find_checkpoint
from flowlab.evaluation.evaluate import evaluate
from flowlab.evaluation.rollout import SimulatorPool, roll_out
from flowlab.evaluation.trials import Trial
from flowlab.nets.diffusion import NoiseSampler
from flowlab.policies.base import ActionPlan, Generators, Losses, PolicyNetwork, PolicySpec
from flowlab.policies.checkpoint import save_weights
from flowlab.policies.run_config import RunConfig
from flowlab.policies.run_folder import start_folder
from flowlab.policies.trained import TrainedPolicy
from flowlab.records import Frame
from flowlab.sim.recorder import EpisodeRecorder, TaskSimulator
from flowlab.sim.scene_settings import CameraSettings, SceneSettings


class PictureSettings(TrainSettings):
    """Of a policy that sees pictures, and no cloud."""

    policy: str = "test_color_policy:Picture"
    horizon: int = 4
    n_action_steps: int = 3
    batch: BatchSettings = BatchSettings(shift_m=0, turn_deg=0)

    @property
    def needs(self) -> Needs:
        return Needs(rgb=True, depth=True)


class Picture(PolicyNetwork):
    """Moves up, and remembers what it was shown."""

    title = "Pictures"
    settings_class = PictureSettings

    def __init__(self, spec: PolicySpec) -> None:
        super().__init__(spec)
        self.up = torch.nn.Parameter(torch.tensor([0.0, 0, 1, 0]))
        self.shown: list[ObservationBatch] = []

    def compute_loss(self, batch: Batch, noise: NoiseSampler, windows: int) -> Losses:
        return Losses(self.up.sum(), {})

    def plan(self, context: ObservationBatch, generators: Generators = None) -> ActionPlan:
        self.shown.append(context)
        return ActionPlan(self.up.detach().expand(len(context.observed), self.spec.settings.horizon, -1))


def spec() -> PolicySpec:
    return PolicySpec(
        settings=PictureSettings(),
        state_width=9,
        action_width=4,
        tasks=("reach",),
        channels=ChannelSpec(),
        normalizer=NORMALIZER,
        observer=None,
        queries={},
    )


def scene(**changes: Any) -> SceneSettings:
    return SceneSettings(camera=CameraSettings(width=48, height=36), **changes)


def trained(folder: Path, settings: SceneSettings) -> Path:
    about = TrainedPolicy(
        policy=spec(), dataset="d", fingerprint="f", scene=settings.model_dump(mode="json"), versions={}
    )
    run = RunConfig(
        dataset=folder, steps=1, train=(0,), held_out=(), threads=1, device="cpu", precision="fp32", logs=(),
        began_from=None,
    )  # fmt: skip
    start_folder(folder, about, run, {})
    save_weights(folder, Picture(spec()), 1)
    return folder


def test_it_is_shown_the_pictures_of_its_own_frames() -> None:
    """Those that the simulator takes at the steps that a plan looks at, to the last bit."""
    colored = scene(renderer="gl", rgb=True)
    try:
        recorder = TaskSimulator("reach", colored).begin(1_000_000)
    except MissingLibraryError as error:
        pytest.skip(str(error))
    policy = Picture(spec())
    (tried,) = roll_out(policy, SimulatorPool("reach", colored), [Trial("reach", 0, 0)], max_steps=7)
    frames = [recorder.frame()]
    for action in tried.rollout.action:
        recorder.step(action)
        frames.append(recorder.frame())
    assert len(policy.shown) == 3, "a plan every three steps"
    for k, shown in enumerate(policy.shown):
        assert shown.points.shape[1:] == (0, 3), "it needs no cloud"
        assert shown.rgb is not None
        assert shown.depth is not None
        for row, step in zip(shown.observed[0].tolist(), (max(3 * k - 1, 0), 3 * k), strict=True):
            np.testing.assert_array_equal(shown.rgb[row], frames[step].rgb)
            np.testing.assert_array_equal(shown.depth[row], frames[step].depth)


def test_a_scene_without_color_is_refused(tmp_path: Path) -> None:
    run = trained(tmp_path / "run", scene())
    with pytest.raises(DataError, match="needs color, and the scene that it was trained in has none; train it on a"):
        evaluate(run, episodes=1)
    colored = trained(tmp_path / "colored", scene(renderer="gl", rgb=True))
    assert find_checkpoint(colored).scene == scene(renderer="gl", rgb=True)


def test_a_frame_without_color_is_refused_and_the_step_is_still_to_be_done() -> None:
    policy = Policy(Picture(spec()), "reach")
    depth = np.ones((CAMERA.height, CAMERA.width), np.float32)
    with pytest.raises(UsageError, match="step 0: the policy needs color, and the frame has none; give it as rgb"):
        policy.act(Frame(depth, CAMERA), np.zeros(9))
    rgb = np.full((CAMERA.height, CAMERA.width, 3), 7, np.uint8)
    np.testing.assert_array_equal(policy.act(Frame(depth, CAMERA, rgb=rgb), np.zeros(9)), [0, 0, 1, 0])
    assert policy.step == 1
    assert policy.warm_up() > 0


class BlindSettings(PictureSettings):
    """Of a policy that sees nothing but the state."""

    policy: str = "test_color_policy:Blind"

    @property
    def needs(self) -> Needs:
        return Needs()


class Blind(Picture):
    """Moves up, eyes shut."""

    settings_class = BlindSettings


def test_a_policy_that_needs_no_picture_wants_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither on a robot nor in simulation, where then none is rendered."""
    network = Blind(spec().model_copy(update={"settings": BlindSettings()}))
    policy = Policy(network, "reach")
    for step in range(7):
        assert not policy.wants_frame
        state = np.full(9, step, np.float32)
        np.testing.assert_array_equal(policy.act(None, state), [0, 0, 1, 0])
    assert [shown.state[:, 0].tolist() for shown in network.shown] == [[0, 0], [2, 3], [5, 6]]

    def rendered(recorder: EpisodeRecorder) -> Frame:
        raise AssertionError("a frame was rendered")

    monkeypatch.setattr(EpisodeRecorder, "frame", rendered)
    (tried,) = roll_out(network, SimulatorPool("reach", scene()), [Trial("reach", 0, 0)], max_steps=4)
    assert len(tried.rollout.action) == 4
