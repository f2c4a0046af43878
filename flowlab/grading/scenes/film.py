"""Films of procedural scenes: recordings with exact tracks of what nobody tuned a tracker to."""

import json
from functools import partial
from pathlib import Path

import numpy as np
from pydantic import Field

from flowlab.config import Settings
from flowlab.errors import UsageError, unknown_name
from flowlab.geometry.camera import Camera
from flowlab.grading.graded_recording import QueryMix, made_once, write_graded
from flowlab.grading.scenes.camera_paths import CameraMotion, CameraPath, fixed_camera, hand_held, held_still, traveling
from flowlab.grading.scenes.families import FAMILIES, Family
from flowlab.grading.scenes.world import CAMERA, body_name, build_world, poses_of
from flowlab.perception.observer import Box, ObserverSettings
from flowlab.records import Role
from flowlab.sim.recorder import Rollout
from flowlab.sim.render.gl import GLRenderer
from flowlab.sim.scene import Scene
from flowlab.sim.scene_settings import CameraSettings, SceneSettings
from flowlab.sim.sensor import PRESETS

_SIZES = ((160, 120), (320, 240), (320, 240), (640, 480))
_FPS = 15.0
_DISTANCE_M = (0.5, 1.1)
"""From the camera to the middle of the table."""
_EVERYTHING = Box(low=(-4.0, -4.0, -2.0), high=(4.0, 4.0, 4.0))


_MOTIONS: dict[CameraMotion, tuple[CameraPath, bool]] = {
    "fixed": (held_still, False),
    "hand-held": (hand_held, False),
    "hand-held, poses known": (hand_held, True),
    "traveling": (traveling, False),
    "traveling, poses known": (traveling, True),
}
"""The path of the camera, and whether the recording has its poses."""


class FilmSettings(Settings):
    """How a film of a procedural scene is made; what is null is drawn by its seed."""

    sensor: str | None = None
    """Name of a preset of a depth camera's errors."""
    size: tuple[int, int] | None = None
    """Width and height of its pictures [px]."""
    camera: CameraMotion | None = None
    """Whether it stands still; if not, whether it is carried past the scene, and whether its poses are recorded."""
    frames: int = Field(default=0, ge=0)
    """How long it is; 0 draws 40 to 80."""
    queries: QueryMix = QueryMix(background_share=0.35, object_share=0.5)
    """Which points have their truth recorded."""


def film_settings(sensor: str | None, size: tuple[int, int] | None, camera: str | None) -> FilmSettings:
    """Settings with a camera that somebody typed; raises :class:`UsageError` where there is none of that name."""
    if camera is not None and camera not in _MOTIONS:
        raise unknown_name("camera", camera, _MOTIONS)
    return FilmSettings.model_validate({"sensor": sensor, "size": size, "camera": camera})


def make_film(folder: Path, family: str, seed: int, settings: FilmSettings = FilmSettings()) -> bool:
    """Film a procedural scene into a plain folder with ``ground_truth.npz``.

    Args:
        folder: Where to. One that was made like this with the same settings is left alone, one made with others is
            replaced.
        family: One of :data:`~flowlab.grading.scenes.families.FAMILIES`.
        seed: Of all that is drawn.
        settings: How it is filmed.

    Returns:
        Whether it was filmed now.

    Raises:
        UsageError: There is no such family or sensor.
        DataError: Something else is in the way, or there is no point to grade.
    """
    check_film(family, settings)
    made_with = {"scenes": family, "seed": seed, "settings": json.loads(settings.model_dump_json())}
    return made_once(folder, made_with, partial(_film, FAMILIES[family], seed, settings))


def check_film(family: str, settings: FilmSettings) -> None:
    """Raise :class:`UsageError` where there is no such family or sensor."""
    if family not in FAMILIES:
        raise unknown_name("family of scenes", family, FAMILIES)
    if settings.sensor is not None and settings.sensor not in PRESETS:
        raise unknown_name("sensor", settings.sensor, PRESETS)


def _film(family: Family, seed: int, settings: FilmSettings, into: Path) -> int:
    """Write the film, and return how many queries had to be left out."""
    rng = np.random.default_rng([seed, *family.name.encode()])
    names = sorted(PRESETS)
    sensor = settings.sensor or names[rng.integers(len(names))]
    size = settings.size or _SIZES[rng.integers(len(_SIZES))]
    kinds: tuple[CameraMotion, ...] = ("fixed", "fixed", "hand-held", "hand-held, poses known")
    camera = settings.camera or kinds[rng.integers(len(kinds))]
    steps = settings.frames or int(rng.integers(40, 81))
    path, poses_known = _MOTIONS[camera]
    rollout = stage(family, seed, rng, size, steps, path)
    observer = ObserverSettings(crop=_EVERYTHING, drop_background=False)
    return write_graded(into, rollout, PRESETS[sensor], observer, settings.queries, poses_known=poses_known)


def stage(
    family: Family, seed: int, rng: np.random.Generator, size: tuple[int, int], steps: int, path: CameraPath
) -> Rollout:
    """A scene of a family as a demonstration that can be pictured, with exact poses.

    Args:
        family: Which.
        seed: Stated in the demonstration.
        rng: What everything is drawn from.
        size: Width and height of its pictures [px].
        steps: Frames.
        path: How the camera moves.

    Returns:
        A demonstration without state or actions.
    """
    things = family.make(rng, steps)
    if not things:
        raise UsageError(f"{family.name} seed {seed}: nothing found room; try another seed")
    fovy = float(rng.uniform(38, 58))
    start = fixed_camera(rng, np.array([0.0, 0.0, 0.03]), _DISTANCE_M)
    poses_cam = path(start, steps, rng)
    model = build_world(things, family.looks, fovy, rng)
    robots = frozenset(body_name(k, thing) for k, thing in enumerate(things) if thing.role == Role.ROBOT)
    scene = Scene(model, robot_roots=robots)
    camera = Camera.from_fovy(*size, fovy, poses_cam[0])
    shown = SceneSettings(camera=CameraSettings(name=CAMERA, position=None), renderer="gl", rgb=True)
    return Rollout(
        task=family.name,
        seed=seed,
        camera=camera,
        time_s=np.arange(steps) / _FPS,
        state=np.zeros((steps, 0), np.float32),
        action=np.zeros((steps, 0), np.float32),
        success=np.ones(steps, bool),
        poses=poses_of(model, things, poses_cam),
        scene=scene,
        renderer=GLRenderer(scene, camera, shown),
        T_world_sim=np.eye(4),
        T_world_cam=None if path is held_still else poses_cam,
    )
