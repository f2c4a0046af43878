"""What a graded recording says of its own making."""

import json
from pathlib import Path
from typing import Any

import pytest

from flowlab.grading.ground_truth import MADE_WITH
from flowlab.grading.origin import BY_SEED, OTHER, Origin, origin_of, seeds_in_words, sizes_in_words
from flowlab.grading.simulate import SimulatedRecording


def task(sensor: str) -> dict[str, Any]:
    """What is kept of a simulated recording of a task."""
    settings = SimulatedRecording.with_camera(sensor, (320, 240))
    return {"task": "hammer", "seed": 3, "settings": json.loads(settings.model_dump_json())}


@pytest.mark.parametrize(
    ("made_with", "expected"),
    [
        (task("kinect"), Origin("hammer", 3, "kinect")),
        (task("clean"), Origin("hammer", 3, "clean")),
        ({"task": "hammer", "seed": 3, "settings": {"sensor": {"axial_noise": 9.0}}}, Origin("hammer", 3, OTHER)),
        ({"task": "hammer", "seed": 3, "settings": {"sensor": {"no": "such"}}}, Origin("hammer", 3, OTHER)),
        ({"scenes": "thin", "seed": 1000, "settings": {"sensor": "tof"}}, Origin("thin", 1000, "tof")),
        ({"scenes": "thin", "seed": 1000, "settings": {"sensor": None}}, Origin("thin", 1000, BY_SEED)),
        ({"scenes": "thin", "seed": 7, "settings": {"camera": "traveling"}}, Origin("thin", 7, BY_SEED, "traveling")),
        ({"scenes": "thin", "seed": 7, "settings": {"camera": "a" * 9999}}, Origin("thin", 7, BY_SEED)),
        ({"scenes": "thin", "seed": True, "settings": [1]}, Origin("thin", None, "")),
        ({"scenes": 5, "seed": "x", "settings": {"sensor": "x" * 9999}}, Origin("", None, OTHER)),
        (None, Origin("", None, "")),
        ("text", Origin("", None, "")),
    ],
)
def test_scene_seed_and_sensor_are_what_was_kept(made_with: object, expected: Origin, tmp_path: Path) -> None:
    (tmp_path / MADE_WITH).write_text(json.dumps({"made_with": made_with}))
    assert origin_of(tmp_path) == expected


def test_a_recording_of_ones_own_says_nothing(tmp_path: Path) -> None:
    assert origin_of(tmp_path) == Origin("", None, "")


@pytest.mark.parametrize(
    ("seeds", "words"),
    [
        ([], ""),
        ([4, 4], "seed 4"),
        ([1, 0], "seeds 0, 1"),
        (range(1000, 1006), "seeds 1000 to 1005"),
        ([0, 2, 3, 9], "4 seeds from 0 to 9"),
    ],
)
def test_seeds_are_said_shortly(seeds: list[int], words: str) -> None:
    assert seeds_in_words(seeds) == words


def test_sizes_are_said_from_the_smallest_to_the_largest() -> None:
    assert sizes_in_words([(320, 240)] * 2) == "320 × 240 px"
    assert sizes_in_words([(640, 480), (160, 120), (320, 240)]) == "160 × 120 to 640 × 480 px"
