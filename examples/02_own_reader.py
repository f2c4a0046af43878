"""A reader of your own: recordings in your layout become datasets.

    python examples/02_own_reader.py
    PYTHONPATH=examples flowlab track-real pour.log --reader 02_own_reader:LogReader --dry-run

The layout here is what a small recorder may write: a folder ``*.log`` with ``frames.jsonl``, a line for every instant,
and the pictures that the lines name. A reader says which recordings are its own, and finds their streams; pictures are
decoded when they are asked for. Pairing the streams, finding bad frames, undistorting and shrinking is flowlab's work.

A package that offers the class as an entry point has it asked like flowlab's own readers, without ``--reader``::

    [project.entry-points."flowlab.readers"]
    log = "my_package.log_reader:LogReader"
"""

import json
import tempfile
from pathlib import Path

import cv2
import numpy as np

from flowlab.errors import DataError
from flowlab.recordings.base import SampleStream, Streams
from flowlab.recordings.image_files import color_stream, depth_stream
from flowlab.recordings.recording import RecordingSettings, describe
from flowlab.recordings.recording_yaml import Intrinsics, Metadata
from flowlab.testing.readers import check_reader


class LogReader:
    """Reads folders with a line of JSON for every instant."""

    name = "log"
    expects = "a folder *.log with frames.jsonl"
    fallback = False  # nothing of another layout looks like this

    def probe(self, path: Path) -> bool:
        """Whether it is one, by its name and that of the file."""
        return path.suffix == ".log" and (path / "frames.jsonl").is_file()

    def read(self, path: Path, given: Metadata) -> Streams:
        """The streams; what is damaged is told in a sentence, never a traceback."""
        try:
            lines = [json.loads(line) for line in (path / "frames.jsonl").read_text().splitlines()]
            time_s = np.array([line["time_s"] for line in lines], float)
            color, depth = ([path / line[name] for line in lines] for name in ("color", "depth"))
            gripper = np.array([[line["gripper_m"]] for line in lines], np.float32)
            camera = Intrinsics(**lines[0]["camera"])
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise DataError(f"{path}: its frames.jsonl is not what the recorder writes ({error})") from error
        return Streams(
            color_stream(color, time_s),
            depth_stream(depth, time_s),
            state=(SampleStream("gripper", time_s, gripper),),
            known=(("frames.jsonl", Metadata(intrinsics=camera, depth_unit_m=0.001)),),
            registered=True,
        )


def write_example(folder: Path) -> Path:
    """A recording of half a second, as the recorder would write it."""
    folder.mkdir()
    camera = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5}
    lines = []
    for t in range(15):
        rgb = np.random.default_rng(t).integers(0, 255, (48, 64, 3), np.uint8)
        cv2.imwrite(str(folder / f"c{t}.png"), rgb)
        cv2.imwrite(str(folder / f"d{t}.png"), np.full((48, 64), 800 + t, np.uint16))
        instant = {"time_s": t / 30, "color": f"c{t}.png", "depth": f"d{t}.png", "gripper_m": 0.04, "camera": camera}
        lines.append(json.dumps(instant))
    (folder / "frames.jsonl").write_text("\n".join(lines) + "\n")
    return folder


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        recording = write_example(Path(place) / "pour.log")
        check_reader(LogReader, recording)  # the same checks that flowlab's own readers pass
        about = describe(recording, RecordingSettings(reader="02_own_reader:LogReader"))
        print(f"read by '{about.reader}': {about.rows} rows, a state of {about.state_width} number")
        for stream in about.streams:
            print(f"  {stream.name}: {stream.count} at {stream.fps:.0f} per second")
