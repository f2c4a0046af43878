"""Films of MetaWorld's experts as a real robot's demonstrations would be recorded, and their exact labels."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree

from flowlab import Rejected, Stage
from flowlab.config import Settings
from flowlab.demonstrations import QueriedDemo
from flowlab.errors import DataError
from flowlab.pipeline.stages.labeled import labeled
from flowlab.provenance import Provenance
from flowlab.recordings.recording import Recording
from flowlab.recordings.writing import write_rgbd_recording
from flowlab.records import Episode, Frame, Queries
from flowlab.sim.exact_tracks import RigidFlowSettings, label
from flowlab.sim.expert import Expert
from flowlab.sim.pose_actions import PoseActions, PoseArm
from flowlab.sim.recorder import EpisodeRecorder, Rollout, TaskSimulator
from flowlab.sim.scene import Poses
from flowlab.sim.scene_settings import CameraSettings, SceneSettings
from flowlab.sim.sensor import PRESETS, Sensor

FIRST_TRIAL = 1_000_000
"""Trials are layouts from here on; demonstrations those from 0 on."""
MAX_STEPS = 200
"""Control steps that an expert, and a policy, have: DP3's and 3D FDP's limit."""
_HOLD = 10
"""Control steps that a demonstration goes on once its task is solved."""
_SHADOW_PX = 1024
"""Of the picture that shadows come from, as in the procedural scenes."""
_DEPTH_UNIT_M = 0.001
"""Of depth pictures: what real cameras count in."""


@dataclass(frozen=True, slots=True)
class Setup:
    """A task as somebody set it up: one place for everything, from which its object is moved by a centimeter."""

    name: str
    """MetaWorld's."""
    stands_for: str
    """The paper's."""
    seed: int
    """Of the layout: the first on which MetaWorld's expert solves twelve of twelve so moved."""
    efforts: tuple[float, float]
    """Of its gripper, open and closed, as the expert has them; where he never moves it, both ends of the range."""


SETUPS = {
    s.name: s
    for s in (
        Setup("assembly", "Assemble", 0, (0.0, 0.6)),
        Setup("disassemble", "Disassemble", 2, (0.0, 0.8)),
        Setup("button-press", "Press", 0, (0.0, 1.0)),
        Setup("pick-out-of-hole", "Pull & Grasp", 0, (0.0, 0.1)),
        Setup("door-open", "Open", 0, (-1.0, 1.0)),
        Setup("peg-insert-side", "Hang", 1, (-1.0, 0.6)),
        Setup("shelf-place", "Shelve", 1, (-1.0, 0.7)),
        Setup("faucet-open", "Non-prehensile", 0, (-1.0, 1.0)),
    )
}


class FilmSettings(Settings):
    """How demonstrations are filmed, and trials seen: the same camera, with the same errors."""

    size: tuple[int, int] = (320, 240)
    """Width and height of the pictures [px]."""
    sensor: Literal["kinect", "stereo", "tof", "clean"] = "kinect"
    """How the camera errs."""
    every: int = Field(default=3, gt=0)
    """Control steps of MetaWorld to a picture and an action: 3 are 26.7 pictures a second."""
    position: Literal["absolute", "relative"] = "absolute"
    """How actions say where the hand goes; see :class:`flowlab.sim.pose_actions.PoseActions`."""
    moved_m: Annotated[float, Field(ge=0)] = 0.01
    """The object begins up to so much from its place along x and y [m]."""

    def studio(self, task: str, *, color: bool) -> "Studio":
        """A task before the camera; without color it needs no OpenGL."""
        camera = CameraSettings(width=self.size[0], height=self.size[1])
        renderer: Literal["gl", "zbuffer"] = "gl" if color else "zbuffer"
        scene = SceneSettings(camera=camera, renderer=renderer, rgb=color, markers=False)
        simulator = TaskSimulator(task, scene)
        simulator.simulation.model.vis.quality.shadowsize = _SHADOW_PX  # a picture costs a third less so
        actions = PoseActions(position=self.position, every=self.every, efforts=SETUPS[task].efforts)
        return Studio(self, SETUPS[task], simulator, PoseArm(simulator.simulation, actions))


@dataclass(frozen=True, slots=True)
class Studio:
    """A task before the camera: laid out by number, demonstrated by MetaWorld's expert, or left to a policy."""

    settings: FilmSettings
    setup: Setup
    simulator: TaskSimulator
    arm: PoseArm

    def begin(self, number: int) -> EpisodeRecorder:
        """The task's layout of a number: the object somewhere near its place."""
        reach = self.settings.moved_m
        x, y = np.random.default_rng([self.setup.seed, number]).uniform(-reach, reach, 2).tolist()
        return self.simulator.begin(self.setup.seed, (x, y))

    def layouts(self, first: int) -> Iterator[int]:
        """The numbers from one on whose layouts MetaWorld takes."""
        for number in count(first):
            try:
                self.begin(number)
            except DataError:
                continue
            yield number

    def sensor(self, number: int) -> "NoisyCamera":
        """The camera, with errors of its own for every layout."""
        return NoisyCamera(Sensor(PRESETS[self.settings.sensor], number))

    def demonstrate(self, number: int) -> Rollout | None:
        """The expert's attempt, a row for every picture: state, and the action up to the next. None if it fails."""
        live, states, actions = self.expert(number)
        if live.unstable or sum(live.success) < _HOLD:
            return None
        return _thinned(live.rollout(), self.settings.every, np.stack(states), np.stack(actions))

    def expert(self, number: int) -> tuple[EpisodeRecorder, list[np.ndarray], list[np.ndarray]]:
        """The expert's attempt, with the state before and the action after every picture.

        He acts at every control step, as an operator's hand moves between pictures; his gripper only opens or closes.
        """
        live, expert, arm = self.begin(number), Expert(self.simulator.simulation), self.arm
        states, actions = list[np.ndarray](), list[np.ndarray]()
        while len(live.success) < MAX_STEPS and sum(live.success) < _HOLD:
            states.append(arm.state)
            start, effort = arm.target, 0.0
            for _ in range(self.settings.every):
                step = arm.binary(expert.act())
                effort = float(step[3])
                live.step(step)
            actions.append(arm.action(start, effort))
        return live, states, actions

    def repeat(self, number: int, actions: np.ndarray) -> EpisodeRecorder:
        """A demonstration's actions, carried out on a layout without looking."""
        live = self.begin(number)
        for action in actions:
            for step in self.arm.steps(action):
                live.step(step)
        return live

    def film(self, folder: Path, rollout: Rollout, number: int) -> None:
        """Write a demonstration as the camera saw it, a plain recording."""
        camera = self.sensor(number)
        frames = [camera.look(rollout.frame(t)) for t in range(len(rollout))]
        write_rgbd_recording(
            folder,
            rgb=(f.rgb for f in frames if f.rgb is not None),
            depth=(f.depth for f in frames),
            camera=rollout.camera,
            time_s=rollout.time_s,
            state=rollout.state,
            action=rollout.action,
            success=True,
            task=rollout.task,
            depth_unit_m=_DEPTH_UNIT_M,
        )


@dataclass(frozen=True, slots=True)
class NoisyCamera:
    """What a camera makes of perfect pictures, given in order; nobody tells whose surface a pixel shows."""

    sensor: Sensor

    def look(self, frame: Frame) -> Frame:
        """The picture with the camera's errors, depth in whole millimeters."""
        depth = self.sensor.depth(frame.depth, frame.rgb)
        rgb = None if frame.rgb is None else self.sensor.rgb(frame.rgb)
        whole = (np.rint(depth / _DEPTH_UNIT_M) * _DEPTH_UNIT_M).astype(np.float32)
        return Frame(whole, frame.camera, rgb=rgb)


def _thinned(rollout: Rollout, every: int, state: np.ndarray, action: np.ndarray) -> Rollout:
    """A row for every picture instead of for every control step."""
    poses = Poses(*(getattr(rollout.poses, name)[::every] for name in Poses.__slots__))
    return replace(
        rollout,
        time_s=rollout.time_s[::every],
        state=state,
        action=action,
        success=rollout.success[every - 1 :: every],
        object_pose=None if rollout.object_pose is None else rollout.object_pose[::every],
        poses=poses,
    )


class ExactTracks(Stage):
    """The same query points, carried by the simulated bodies that the camera saw there; nothing else is known better.

    The demonstration of a film is done again, which goes the same way.
    """

    stage: str = "exact-tracks"
    of = Recording
    film: FilmSettings = FilmSettings()
    """As it was filmed."""

    def process(self, record: QueriedDemo) -> Episode:
        """Find what every query lies on, and go with it."""
        demo = record.observed.demo
        assert isinstance(demo, Recording)
        studio = self._studio(demo.task)
        again = studio.demonstrate(int(demo.path.name))
        if again is None or not np.array_equal(again.state, demo.state):
            raise Rejected("the expert did something else before the camera; film it again with these settings")
        frames = [again.frame(t) for t in range(len(again))]
        queries = owned(record.queries, frames[0])
        depth = np.stack([f.depth for f in frames])
        owner = np.stack([f.owner for f in frames if f.owner is not None])
        return labeled(replace(record, queries=queries), label(again, queries, depth, owner, RigidFlowSettings()))

    def _studio(self, task: str) -> Studio:
        if task not in _studios:
            _studios.clear()
            _studios[task] = self.film.studio(task, color=False)
        return _studios[task]

    def describe(self, provenance: Provenance, task: str) -> Provenance:
        """The tracks are exact."""
        return provenance.model_copy(update={"tracks": "exact"})


_studios: dict[str, Studio] = {}


def owned(queries: Queries, first: Frame) -> Queries:
    """Queries, with whose surface each is: that of the nearest point which the first picture truly shows."""
    v, u = np.nonzero(first.depth > 0)
    assert first.owner is not None
    true = first.camera.unproject(np.stack([u, v], -1).astype(np.float64), first.depth[v, u].astype(np.float64))
    _, nearest = cKDTree(true).query(queries.xyz_world)
    return replace(queries, owner=first.owner[v, u][nearest], entities=first.entities)
