"""What a recording with known truth says of its own making: its scene, its seed, its sensor, its camera."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from pydantic import ValidationError

from flowlab.grading.ground_truth import MADE_WITH, scene_of
from flowlab.grading.scenes.camera_paths import CameraMotion
from flowlab.untrusted import read_json

BY_SEED = "drawn by the seed"
"""The sensor of a film that nobody chose one for."""
OTHER = "of other settings"
"""A simulated sensor whose settings are no preset's."""


@dataclass(frozen=True, slots=True)
class Origin:
    """Where a recording with known truth comes from."""

    scene: str
    """The family of procedural scenes or the task that it is of; empty for a recording of somebody's own."""
    seed: int | None
    """Of what was simulated."""
    sensor: str
    """Name of the preset of the simulated camera's errors; empty for a real camera."""
    camera: str = ""
    """How the camera of a film was asked to move; empty where its seed drew that, and for what is no film."""


def origin_of(recording: Path) -> Origin:
    """What is kept beside a recording of how it was made."""
    made = recording / MADE_WITH
    values = read_json(made, "simulate it again") if made.is_file() else {}
    made_with = values.get("made_with") if isinstance(values, Mapping) else None
    if not isinstance(made_with, Mapping):
        return Origin(scene_of(recording), None, "")
    seed, settings = made_with.get("seed"), made_with.get("settings")
    sensor = camera = ""
    if isinstance(settings, Mapping):
        sensor, asked = _sensor_name(settings.get("sensor")), settings.get("camera")
        camera = next((name for name in get_args(CameraMotion) if name == asked), "")
    return Origin(scene_of(recording), seed if type(seed) is int else None, sensor, camera)


def _sensor_name(sensor: Any) -> str:
    """The preset that kept settings are of: films keep its name, tasks its values."""
    from flowlab.sim.sensor import PRESETS, SensorSettings

    if sensor is None:
        return BY_SEED
    if isinstance(sensor, str):
        return sensor if sensor in PRESETS else OTHER
    try:
        settings = SensorSettings.model_validate(sensor)
    except ValidationError:
        return OTHER
    return next((name for name, preset in PRESETS.items() if preset == settings), OTHER)


def seeds_in_words(seeds: Sequence[int]) -> str:
    """Distinct seeds, as short as can be."""
    found = sorted(set(seeds))
    if len(found) < 2:
        return "".join(f"seed {seed}" for seed in found)
    if len(found) <= 3:
        return f"seeds {', '.join(map(str, found))}"
    if found[-1] - found[0] == len(found) - 1:
        return f"seeds {found[0]} to {found[-1]}"
    return f"{len(found)} seeds from {found[0]} to {found[-1]}"


def sizes_in_words(sizes: Sequence[tuple[int, int]]) -> str:
    """Distinct widths and heights of pictures, from the smallest to the largest."""
    found = sorted(set(sizes), key=lambda size: size[0] * size[1])
    words = [f"{width} × {height}" for width, height in ([found[0], found[-1]] if len(found) > 1 else found)]
    return f"{' to '.join(words)} px"
