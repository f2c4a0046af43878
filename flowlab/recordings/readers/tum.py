"""The layout of the TUM RGB-D benchmark: ``rgb.txt`` and ``depth.txt`` list pictures with their times."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flowlab.errors import DataError
from flowlab.recordings.base import SampleStream, Streams
from flowlab.recordings.image_files import color_stream, depth_stream
from flowlab.recordings.intrinsics import Intrinsics
from flowlab.recordings.poses import pose_stream, read_poses
from flowlab.recordings.recording_yaml import TRUE_TRACKS, Metadata
from flowlab.recordings.stamps import Timing
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import is_path_inside, shown
from flowlab.untrusted import read_text

GROUND_TRUTH = "groundtruth.txt"
LISTS = ("rgb.txt", "depth.txt")
ASSOCIATIONS = ("associations.txt", "associated.txt", "associate.txt")
DEPTH_FACTOR = 5000
"""Counts per meter of the benchmark's depth pictures."""
KINECTS = {
    "freiburg1": Intrinsics(
        fx=517.3, fy=516.5, cx=318.6, cy=255.3, width=640, height=480,
        distortion=(0.2624, -0.9531, -0.0054, 0.0026, 1.1633),
    ),
    "freiburg2": Intrinsics(
        fx=520.9, fy=521.0, cx=325.1, cy=249.7, width=640, height=480,
        distortion=(0.2312, -0.7849, -0.0033, -0.0001, 0.9172),
    ),
    "freiburg3": Intrinsics(fx=535.4, fy=539.2, cx=320.1, cy=247.6, width=640, height=480),
}  # fmt: skip
"""The benchmark's own calibration of the three color cameras; their sequences carry these names."""

_OF_BENCHMARK = re.compile(r"rgbd_dataset_(freiburg[123])(_|$)")
"""What the benchmark's own sequences are called; other recordings may be of Freiburg, too."""


class TUMReader:
    """Reads sequences of the benchmark, and what is recorded in its layout."""

    name = "tum"
    expects = "a folder with rgb.txt and depth.txt, or associations.txt"
    fallback = False

    def probe(self, path: Path) -> bool:
        """Whether it has the lists."""
        return _both(path) or _associations(path) is not None

    def read(self, path: Path, given: Metadata) -> Streams:
        """The streams; both lists where there are, else the pairs of the associations."""
        if _both(path):
            lists = [*LISTS]
            color, depth = (_entries(path / name, 2) for name in lists)
        else:
            file = _associations(path)
            if file is None:
                raise DataError(f"{path}: has neither rgb.txt and depth.txt nor {ASSOCIATIONS[0]}")
            pairs, lists = _entries(file, 4), [file.name, file.name]
            if pairs and "depth" in pairs[0][1].lower() and "depth" not in pairs[0][3].lower():  # as ICL-NUIM has it
                pairs = [(*p[2:], *p[:2]) for p in pairs]
            color, depth = [p[:2] for p in pairs], [p[2:] for p in pairs]
        known = [("the custom of TUM RGB-D", Metadata(depth_unit_m=1 / DEPTH_FACTOR))]
        found = _OF_BENCHMARK.match(path.resolve().name)
        camera = None if found is None else found[1]
        if camera is not None:
            known.append((f"TUM RGB-D's calibration of {camera}", Metadata(intrinsics=KINECTS[camera])))
        files = [[path / entry[1] for entry in entries] for entries in (color, depth)]
        poses, checks = _ground_truth(path / GROUND_TRUTH)
        return Streams(
            color_stream(files[0], *_stamps(lists[0], color)),
            depth_stream(files[1], *_stamps(lists[1], depth)),
            known=tuple(known),
            registered=True,
            checks=checks,
            used=(*lists, GROUND_TRUTH, TRUE_TRACKS, *(Path(entry[1]).as_posix() for entry in (*color, *depth))),
            passed_over=_passed_over(lists, color, depth),
            poses=poses,
        )


def _passed_over(
    lists: Sequence[str], color: Sequence[tuple[str, ...]], depth: Sequence[tuple[str, ...]]
) -> tuple[tuple[str, str], ...]:
    """What such folders have beside what is used."""
    known = [("accelerometer.txt", "how the camera was accelerated")]
    # Associations leave out pictures without a partner, and lists what the camera dropped.
    folders = {Path(entry[1]).parent.as_posix() for entry in (*color, *depth)}
    named = " and ".join(dict.fromkeys(lists))
    known += [(f"{folder}/*.png", f"not in {named}") for folder in sorted(folders - {"."})]
    if lists[0] == lists[1]:
        return (*known, *((name, f"{lists[0]} is used") for name in (*LISTS, *ASSOCIATIONS)))
    return (*known, *((name, "the lists are used") for name in ASSOCIATIONS))


def _ground_truth(file: Path) -> tuple[SampleStream | None, tuple[Check, ...]]:
    """The poses of the color camera, where the file is a list of them: ``timestamp tx ty tz qx qy qz qw``."""
    if not file.is_file():
        return None, ()
    first = next((x.split() for x in read_text(file).splitlines() if x.strip() and not x.lstrip().startswith("#")), [])
    try:
        numbers = [float(x) for x in first]
    except ValueError:
        numbers = []
    if len(numbers) != 8:
        says = (f"{file.name} is not used: its first line is not 'timestamp tx ty tz qx qy qz qw' "
                f"({shown(' '.join(first))})")  # fmt: skip
        return None, (Check("poses", Verdict.DOUBTFUL, says),)
    own, T = read_poses(file)
    assert own is not None
    return pose_stream(file.name, own[0], T, own[1]), ()


def _both(path: Path) -> bool:
    """Whether both lists are there."""
    return all((path / name).is_file() for name in LISTS)


def _associations(path: Path) -> Path | None:
    """The file of associations; None where there is none."""
    return next((path / name for name in ASSOCIATIONS if (path / name).is_file()), None)


def _entries(file: Path, width: int) -> list[tuple[str, ...]]:
    """Lines of a list, in its order."""
    found = []
    for number, line in enumerate(read_text(file).splitlines(), 1):
        parts = tuple(line.split())
        if not parts or parts[0].startswith("#"):
            continue
        try:
            times = [float(parts[i]) for i in range(0, width, 2)]
        except (ValueError, IndexError):
            times = []
        if len(parts) != width or not np.isfinite(times or [np.nan]).all():
            raise DataError(f"{file}: line {number} is not {' '.join(['time file'] * (width // 2))}: {shown(line)}")
        if not all(is_path_inside(name) for name in parts[1::2]):
            raise DataError(f"{file}: line {number} names {shown(line)}, expected files in the recording's folder")
        found.append(parts)
    if not found:
        raise DataError(f"{file}: lists no picture")
    return found


def _stamps(name: str, entries: Sequence[tuple[str, ...]]) -> tuple[np.ndarray, Timing]:
    """The stamps of a list, as they stand there."""
    texts = [entry[0] for entry in entries]
    return np.array(texts, np.float64), Timing(name, unit=None, integers=all(t.isdecimal() for t in texts))
