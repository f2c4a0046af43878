"""What flowlab says of recordings that are wrong, and of the same ones before that.

    python benchmarks/wrong_recordings.py --recordings DIR
    python benchmarks/wrong_recordings.py --recordings DIR --scenes kitchen --films 6 --mistakes none "poses backward"
    python benchmarks/wrong_recordings.py --recordings DIR --clips CLIP...

Films procedural scenes with a camera that stands still, one that is held by hand and one that is carried past, the
last two with poses; simulates tasks of MetaWorld; makes every mistake of ``mistakes.py`` with each of them; reads what
comes of it as ``flowlab track-real`` does before it tracks; and counts the verdicts. *Unsaid* are recordings of which
nothing is refused or doubtful. No check was made with the seeds that are the default. Needs OpenGL.
"""

import argparse
import json
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from mistakes import MISTAKES, Film

from flowlab.errors import DataError
from flowlab.grading.scenes.camera_paths import CameraMotion
from flowlab.grading.scenes.families import FAMILIES
from flowlab.grading.scenes.film import FilmSettings, make_film
from flowlab.grading.simulate import SimulatedRecording, simulate_recording
from flowlab.recordings.parsing import RecordingSettings, parse_recording
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.sim.sensor import KINECT

CAMERAS: tuple[CameraMotion, ...] = ("fixed", "hand-held, poses known", "traveling, poses known")
TASKS = ("assembly", "basketball", "door-open", "drawer-open", "faucet-open", "hammer", "pick-place", "push")
_SAID = (Verdict.REFUSED, Verdict.DOUBTFUL)


@dataclass(frozen=True)
class Said:
    """What was said of a recording."""

    recording: str
    mistake: str
    refused: tuple[str, ...]
    """What is, by the words of the checks; ``reading`` where it could not be read at all."""
    doubtful: tuple[str, ...]

    @property
    def verdict(self) -> str:
        """The worst of it."""
        return "refused" if self.refused else "doubtful" if self.doubtful else "unsaid"


def main() -> None:
    """Make the recordings, and all mistakes with each; print what was said."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, required=True, help="folder to keep the true recordings in")
    parser.add_argument("--scenes", nargs="*", default=list(FAMILIES), choices=FAMILIES, help="families of scenes")
    parser.add_argument("--tasks", nargs="*", default=list(TASKS), help="of MetaWorld")
    parser.add_argument("--seed", type=int, default=3000, help="of the first film of a family")
    parser.add_argument("--films", type=int, default=1, help="of a family, with each camera")
    parser.add_argument("--clips", nargs="*", type=Path, default=[], help="plain folders of real recordings, too")
    parser.add_argument("--mistakes", nargs="*", default=list(MISTAKES), choices=MISTAKES)
    parser.add_argument("--json", type=Path, help="where to write what was said of each")
    asked, began = parser.parse_args(), time.process_time()
    said = [
        _say(folder.name, name, MISTAKES[name].make(film))
        for folder in [*_made(asked), *asked.clips]
        for film in [_read(folder)]
        for name in asked.mistakes
        if MISTAKES[name].concerns(film)
    ]
    _print_table(said)
    print(f"{len(said)} recordings, {time.process_time() - began:.0f} s of CPU time")
    if asked.json is not None:
        asked.json.write_text(json.dumps([asdict(s) for s in said], indent=1))


def _made(asked: argparse.Namespace) -> Iterator[Path]:
    """The true recordings, as they are made."""
    for k, task in enumerate(asked.tasks):
        folder = asked.recordings / task
        simulate_recording(folder, task, asked.seed + k, SimulatedRecording(sensor=KINECT))
        yield folder
    for seed in range(asked.seed, asked.seed + asked.films):
        for family in asked.scenes:
            for camera in CAMERAS:
                folder = asked.recordings / f"{family}-{seed}-{camera.split(',')[0]}"
                make_film(folder, family, seed, FilmSettings(camera=camera))
                yield folder


def _read(folder: Path) -> Film:
    """A recording that flowlab takes as it is."""
    source = parse_recording(folder, RecordingSettings())
    known, seen = source.metadata, source.frame_check
    K = known.intrinsics
    assert K is not None
    assert known.depth_unit_m is not None
    return Film(
        tuple(np.ascontiguousarray(source.streams.color.read(int(k))[..., ::-1]) for k in seen.color),
        tuple(source.streams.depth.read(int(k)) for k in seen.depth),
        tuple(source.streams.color.time_s[seen.color].tolist()),
        np.array([[K.fx, 0, K.cx], [0, K.fy, K.cy], [0, 0, 1.0]]),
        known.depth_unit_m,
        seen.T_world_cam,
        seen.T_world_cam is None,
        None if seen.T_world_cam is not None or known.T_world_cam is None else np.array(known.T_world_cam),
        source.rows().state if source.streams.state else None,
    )


def _say(recording: str, mistake: str, film: Film) -> Said:
    """What flowlab says of a recording before it tracks it."""
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "recording"
        film.write(folder)
        settings = RecordingSettings()
        try:
            source = parse_recording(folder, settings)
            checks = list(source.checks)
            source.check_bad_frames(settings)
            if source.frame_check.bad:
                checks.append(Check("frames", Verdict.DOUBTFUL, "some are bad and left out"))
        except DataError:
            checks = [Check("reading", Verdict.REFUSED, "it cannot be read, or has too many bad frames")]
    refused, doubtful = (tuple(dict.fromkeys(c.about for c in checks if c.verdict is v)) for v in _SAID)
    print(f"{recording}: {mistake}: refused {list(refused)}, doubtful {list(doubtful)}", flush=True)
    return Said(recording, mistake, refused, doubtful)


def _print_table(said: list[Said]) -> None:
    """A row for each mistake: how many recordings were refused, doubtful or neither, and by what."""
    print("\n| mistake | recordings | refused | doubtful | unsaid | by |\n|---|---|---|---|---|---|")
    for name in dict.fromkeys(s.mistake for s in said):
        mine = [s for s in said if s.mistake == name]
        counts = [sum(s.verdict == v for s in mine) for v in ("refused", "doubtful", "unsaid")]
        by = Counter(about for s in mine for about in s.refused or s.doubtful)
        print(
            "|",
            " | ".join(map(str, [name, len(mine), *counts, ", ".join(f"{a} {n}" for a, n in by.most_common())])),
            "|",
        )


if __name__ == "__main__":
    main()
