"""Accuracy and cost of labeling recordings: `bodies`, and what a user would do otherwise, on the same pictures.

    python benchmarks/track.py --recordings DIR [--real CLIP...] [--scenes FAMILY...] [--json FILE]

Simulated: the eight tasks of tests of the method, seed 0, 320x240, a Kinect-like sensor and a clean one (needs OpenGL
for color). Scenes: six films of each family, of seeds that no tracker was made with. Real: any recordings with a
``ground_truth.npz``. Each table has the paper's chunks with Lucas-Kanade and the nearest pixel's depth (the naive way),
the same with flowlab's lifting, and ``rigid-bodies``. Two metric rules are printed: TAPVid-3D as published, and that of
the targets (image side by width, first frame left out). "wrong" is the share of seen positions whose error is above
20 mm and above 4 times the stated one.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2

from flowlab.grading.grade import TrackerGrade, grade_tracker, read_clip
from flowlab.grading.metrics import average, measure
from flowlab.grading.scenes.families import FAMILIES, FIRST_REPORTED_SEED
from flowlab.grading.scenes.film import make_film
from flowlab.grading.simulate import SimulatedRecording, simulate_recording
from flowlab.grading.tapvid import MetricSettings
from flowlab.sim.sensor import CLEAN, KINECT
from flowlab.tracking.base import Tracker, make_tracker
from flowlab.tracking.chunking import ChunkSettings
from flowlab.tracking.lifting import LiftSettings

TASKS = ("assembly", "basketball", "door-open", "drawer-open", "faucet-open", "hammer", "pick-place", "push")
REPORTED_SEEDS = range(FIRST_REPORTED_SEED, FIRST_REPORTED_SEED + 6)
NEAREST_PIXEL = LiftSettings(window_px=0, jump_m=1e6)
"""The depth at the point's pixel, whatever it belongs to."""
_CHUNKS, _LIFTING = ChunkSettings(), LiftSettings()
TARGET_RULE = MetricSettings(image_side="width", count_query_frame=False)


@dataclass(frozen=True)
class Way:
    """One way to label."""

    name: str
    tracker: Tracker
    chunks: ChunkSettings = _CHUNKS
    lifting: LiftSettings = _LIFTING


def ways() -> list[Way]:
    """What is compared."""
    follow, bodies = make_tracker("lucas-kanade"), make_tracker("rigid-bodies")
    return [
        Way("LK, nearest pixel", follow, lifting=NEAREST_PIXEL),
        Way("LK, stride 16", follow, ChunkSettings(stride=16)),
        Way("LK, stride 8", follow),
        Way("LK, stride 1 (paper)", follow, ChunkSettings(stride=1)),
        Way("rigid-bodies", bodies),
    ]


def main() -> None:
    """Make what is missing, grade, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, required=True, help="folder to keep simulated recordings in")
    parser.add_argument("--real", type=Path, nargs="*", default=[], help="recordings with ground truth")
    parser.add_argument("--scenes", nargs="*", choices=FAMILIES, default=[], help="families of procedural scenes")
    parser.add_argument("--no-tasks", action="store_true", help="leave out MetaWorld's tasks")
    parser.add_argument("--json", type=Path, help="write all figures here")
    parser.add_argument("--only", help="only the way of this name")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    sensors = () if arguments.no_tasks else ("kinect", "clean")
    groups = {name: _simulated(arguments.recordings, name) for name in sensors}
    groups |= {family: _filmed(arguments.recordings, family) for family in arguments.scenes}
    groups |= {clip.name: [clip] for clip in arguments.real}
    figures: dict[str, Any] = {}
    for name, recordings in groups.items():
        print(f"\n{name}: {len(recordings)} recordings")
        print(_HEADER)
        for way in ways():
            if arguments.only in (None, way.name):
                grades = grade_tracker(recordings, way.tracker, way.chunks, way.lifting)
                figures.setdefault(name, {})[way.name] = _figures(grades, recordings)
                print(_row(way.name, figures[name][way.name]), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=1))


def _simulated(folder: Path, kind: str) -> list[Path]:
    settings = SimulatedRecording(sensor={"kinect": KINECT, "clean": CLEAN}[kind])
    places = [folder / f"{task}-{kind}" for task in TASKS]
    for task, place in zip(TASKS, places, strict=True):
        simulate_recording(place, task, 0, settings)
    return places


def _filmed(folder: Path, family: str) -> list[Path]:
    places = {seed: folder / f"{family}-{seed}" for seed in REPORTED_SEEDS}
    for seed, place in places.items():
        make_film(place, family, seed)
    return list(places.values())


def _figures(grades: TrackerGrade, recordings: Sequence[Path]) -> dict[str, Any]:
    rows = [
        measure(g.estimate, g.truth, read_clip(path).camera, TARGET_RULE)
        for g, path in zip(grades.rows, recordings, strict=True)
    ]
    target = average(rows, grades.mean.calibration)
    return {"ms_per_frame": grades.ms_per_frame, "tapvid3d": grades.mean.to_json(), "target": target.to_json()}


_HEADER = (
    f"{'':22s} {'all: med':>8s} {'<20mm':>6s} {'p95':>6s} | {'moving: med':>11s} {'<20mm':>6s} {'<40mm':>6s} | "
    f"{'object <20':>10s} | {'APD':>5s} {'AJ':>5s} {'OA':>5s} | {'TAPVid-3D APD':>13s} {'AJ':>5s} | "
    f"{'<1 sigma':>8s} {'rank':>5s} {'wrong':>6s} | {'ms/frame':>8s}"
)


def _row(name: str, figures: dict[str, Any]) -> str:
    target, tapvid = figures["target"], figures["tapvid3d"]["tapvid"]

    def part(group: str, key: str, width: int, places: int = 2) -> str:
        values = target.get(group)
        return f"{'-' if not values else format(values[key], f'.{places}f'):>{width}}"

    columns = (
        f"{name:22s}",
        part("all", "median_mm", 8, 1),
        part("all", "within_20mm", 6),
        part("all", "p95_mm", 6, 0) + " |",
        part("moving", "median_mm", 11, 1),
        part("moving", "within_20mm", 6),
        part("moving", "within_40mm", 6) + " |",
        part("object", "within_20mm", 10) + " |",
        *(part("tapvid", key, 5, 3) for key in ("apd", "average_jaccard", "occlusion_accuracy")),
        f"| {tapvid['apd']:13.3f} {tapvid['average_jaccard']:5.3f} |",
        part("calibration", "within_1_sigma", 8),
        part("calibration", "rank_correlation", 5),
        f"{target.get('confidently_wrong', float('nan')):6.2%} |",
        f"{figures['ms_per_frame']:8.1f}",
    )
    return " ".join(columns)


if __name__ == "__main__":
    main()
