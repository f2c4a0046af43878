"""Drive a robot with a trained policy: a frame and a state in, an action out, step by step."""

import time
from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np
import torch
from jaxtyping import Float, Float32

from flowlab.deployment.runner import PolicyRunner
from flowlab.errors import DataError, UsageError, unknown_name
from flowlab.geometry.camera import Camera
from flowlab.perception.observer import Box, Observer, ObserverSettings
from flowlab.policies.base import PolicyNetwork
from flowlab.policies.checkpoint import load_policy
from flowlab.records import Entity, Frame, Queries, Role

_RGBD = 640, 480
"""Width and height of the picture that a warm-up makes up."""


class Policy:
    """A trained policy in one episode after the other.

    Called at every control step, and plans only when a plan is due: in between it hands out what it planned before.
    """

    def __init__(self, network: PolicyNetwork, task: str, seed: int = 0, execute: int | None = None) -> None:
        self.network = network
        self.task = task
        self._seed, self._execute = seed, execute
        self.reset(seed)

    @classmethod
    def load(
        cls,
        run: Path | str,
        task: str | None = None,
        device: str = "cpu",
        seed: int = 0,
        execute: int | None = None,
    ) -> Self:
        """The policy of a run's folder, with its newest weights, or of one checkpoint.

        ``task`` is needed where it was trained on several, ``seed`` sets the noise of the first episode, ``execute`` is
        how many steps of every plan are executed, by default as many as in training. Raises :class:`DataError` where
        there is no policy, and :class:`UsageError` where an argument does not fit it.
        """
        _check_device(device)
        network = load_policy(Path(run), device).policy
        s = network.spec.settings
        most = s.horizon - s.n_obs_steps + 1
        if execute is not None and not 1 <= execute <= most:
            raise UsageError(f"{run}: execute is {execute}, and plans reach {most} steps ahead; use 1 to {most}")
        return cls(network, _choose_task(network.spec.tasks, task, run), seed, execute)

    def reset(self, seed: int | None = None) -> None:
        """Begin a new episode, whose plans have the noise of ``seed``; without one, of the seed after the last."""
        self._seed = self._seed + 1 if seed is None else seed
        self._actor = PolicyRunner(self.network.spec, self.task, self._seed, self._execute)
        self.step = 0
        """Of the episode: which step the next action is for."""
        self.planned_at: int | None = None
        """The step that the last plan was made at; None before the first."""
        self.flow: Float32[np.ndarray, "T M 3"] | None = None
        """How the last plan expects the query points to move [m], world frame: row k is the displacement during step
        ``planned_at + k``. None before the first plan, and for policies that predict no flow."""

    @property
    def queries(self) -> Queries | None:
        """The points that ``flow`` is about, where they were in the episode's first frame; the first ``count`` are
        distinct. None before that, and for policies that predict no flow."""
        return self._actor.queries

    @property
    def n_action_steps(self) -> int:
        """Steps of every plan that are executed."""
        return self._actor.n_action_steps

    @property
    def wants_frame(self) -> bool:
        """Whether the frame of this step will be looked at; if not, none need be taken."""
        return self._actor.needs_frame

    def act(self, observation: Frame | None, state: Float[np.ndarray, "S"]) -> Float32[np.ndarray, "A"]:
        """The action of this step, in the units of the training data; not clipped to any limits.

        ``observation`` is what the camera sees now: depth in meters, and a camera whose pose is given in the dataset's
        world frame; it may be None where ``wants_frame`` is False. ``state`` is the robot's, laid out as in the
        training data. Raises :class:`UsageError` where one of them does not fit, and :class:`DataError` where the frame
        shows nothing; the step is then still to be done, with another frame, say.
        """
        state = self._check_state(state)
        if self.wants_frame:
            self._see(self._actor, self._check_frame(observation), state)
        if self._actor.plan_is_due:
            self.flow = self._plan(self._actor)
            self.planned_at = self.step
        self.step += 1
        return self._actor.act()

    def warm_up(self, frame: Frame | None = None) -> float:
        """Do all that is slow the first time, before the robot moves; returns how long a step with a plan takes [s].

        Compiles (once on a machine) or loads what numba made, loads libraries, lets torch set itself up. The episode
        is left as it is. ``frame`` is best one of the robot's camera, which then is also found to show something; else
        one is made up, of 640 x 480 pixels.
        """
        frame = _made_up(self._observer_settings.crop_for(self.task)) if frame is None else self._check_frame(frame)
        state = np.asarray(self.network.spec.normalizer.state.offset, np.float32)
        took = 0.0
        for _ in range(2):
            actor = PolicyRunner(self.network.spec, self.task, 0, self._execute)
            began = time.perf_counter()
            self._see(actor, frame, state)
            self._plan(actor)
            took = time.perf_counter() - began
        return took

    def _see(self, actor: PolicyRunner, frame: Frame, state: Float32[np.ndarray, "S"]) -> None:
        try:
            actor.see(frame, state)
        except DataError as error:
            nothing = not len(Observer(self._observer_settings, self.task).cloud(frame).xyz_world)
            reason = _why_nothing(frame, self._observer_settings.crop_for(self.task)) if nothing else str(error)
            raise DataError(f"step {self.step}: {reason}") from error

    def _plan(self, actor: PolicyRunner) -> Float32[np.ndarray, "T M 3"] | None:
        """Plan, and return the predicted flow from now on."""
        device = next(self.network.parameters()).device
        plan = self.network.plan(actor.context().to(device), actor.noise)
        actor.follow(plan)
        return None if plan.flow is None else plan.flow[0, self.network.spec.settings.n_obs_steps - 1 :].cpu().numpy()

    @property
    def _observer_settings(self) -> ObserverSettings:
        return ObserverSettings.model_validate(self.network.spec.observer)

    def _check_state(self, state: Float[np.ndarray, "S"]) -> Float32[np.ndarray, "S"]:
        found, width = np.asarray(state), self.network.spec.state_width
        if found.shape != (width,):
            raise UsageError(
                f"step {self.step}: state has the shape {found.shape}, and the policy was trained on states of shape "
                f"({width},); give the same numbers in the same order"
            )
        if not np.isfinite(found).all():
            raise UsageError(f"step {self.step}: state[{np.argmin(np.isfinite(found))}] is no finite number: {found}")
        return found.astype(np.float32)

    def _check_frame(self, frame: Frame | None) -> Frame:
        """The frame, laid out in memory as the Observer's code was compiled for: else it would be, again, now."""
        if frame is None:
            raise UsageError(
                f"step {self.step}: the policy looks at the frame of this step, and got None; take one whenever "
                "policy.wants_frame is True"
            )
        depth, camera = np.asarray(frame.depth), frame.camera
        if depth.shape != (camera.height, camera.width):
            raise UsageError(
                f"step {self.step}: depth has the shape {depth.shape}, and its camera has {camera.height} rows and "
                f"{camera.width} columns; give the camera of this very picture"
            )
        if depth.dtype.kind != "f":
            raise UsageError(
                f"step {self.step}: depth is {depth.dtype}; give meters as float32, of millimeters "
                "(depth / 1000).astype(np.float32)"
            )
        for name, shape in (("K", (3, 3)), ("T_world_cam", (4, 4))):
            if np.shape(getattr(camera, name)) != shape:
                raise UsageError(
                    f"step {self.step}: camera.{name} has the shape {np.shape(getattr(camera, name))}, expected {shape}"
                )
        plain = replace(camera, K=_plain(camera.K, np.float64), T_world_cam=_plain(camera.T_world_cam, np.float64))
        return replace(frame, depth=_plain(depth, np.float32), camera=plain)


def _check_device(name: str) -> None:
    """Raises :class:`UsageError` where torch cannot compute on a device."""
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:  # the latter where torch was built without CUDA
        raise UsageError(f"device is '{name}', which PyTorch cannot use here; use cpu, cuda or cuda:1") from error


def _choose_task(known: tuple[str, ...], asked: str | None, run: Path | str) -> str:
    if asked is None and len(known) > 1:
        raise UsageError(f"{run}: was trained on several tasks; give one as task=, of {', '.join(known)}")
    if asked is not None and asked not in known:
        raise UsageError(f"{run}: {unknown_name('task that it was trained on', asked, known)}")
    return known[0] if asked is None else asked


def _plain(array: np.ndarray, kind: type[np.floating]) -> np.ndarray:
    """Of a type, writeable and in C order; the same array where it is so already."""
    return np.require(array, kind, ["C", "W"])


def _why_nothing(frame: Frame, crop: Box) -> str:
    """What to look at where no point of a frame lies in the crop."""
    v, u = np.nonzero(frame.depth > 0)
    if not len(v):
        return "the frame has no depth reading at all; look at what the camera gives"
    xyz = frame.camera.unproject(np.stack([u, v], -1), frame.depth[v, u])
    return (
        f"the frame shows nothing in the policy's workspace, {_extent(np.array([crop.low, crop.high]))}; its points "
        f"are at {_extent(xyz)}: look whether depth is in meters, and camera.T_world_cam leads to the world frame of "
        "the training data"
    )


def _extent(xyz: np.ndarray) -> str:
    low, high = xyz.min(0), xyz.max(0)
    return ", ".join(f"{axis} {low[a]:.2f} to {high[a]:.2f}" for a, axis in enumerate("xyz")) + " m"


def _made_up(crop: Box) -> Frame:
    """A block on a table in the middle of the crop, from above."""
    low, high = np.array(crop.low), np.array(crop.high)
    middle, size = (low + high) / 2, high - low
    away = size[:2].max()
    looking_down = np.diag([1.0, -1, -1, 1])
    looking_down[:3, 3] = middle
    looking_down[2, 3] += away
    width, height = _RGBD
    camera = Camera.from_fovy(width, height, 50.0, looking_down)
    depth = np.full((height, width), away, np.float32)
    depth[height // 4 : -height // 4, width // 4 : -width // 4] -= min(size[2] / 4, away / 4)
    block = (Entity("block", "block", Role.OBJECT),)  # what owns a pixel is asked for by some policies
    return Frame(depth, camera, np.zeros(depth.shape, np.int16), block)
