"""``.bag`` files of the RealSense SDK, through Open3D: extracted once into a cache, then read from there."""

import hashlib
import os
from pathlib import Path

from flowlab.errors import DataError, MissingLibraryError
from flowlab.files import new_folder
from flowlab.limits import MAX_ARRAY_BYTES
from flowlab.recordings.base import Streams
from flowlab.recordings.readers.open3d_json import open3d_calibration
from flowlab.recordings.readers.plain import read_folder
from flowlab.recordings.recording_yaml import FILE_NAME, Metadata
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.text import cut
from flowlab.untrusted import check_regular, read_json

_MAGIC = b"#ROSBAG V2.0\n"
_SDK_TOPIC = b"topic=/device_"


class RealSenseReader:
    """Reads what realsense-viewer and the SDK record."""

    name = "realsense"
    expects = "a .bag file of the RealSense SDK"
    fallback = False

    def probe(self, path: Path) -> bool:
        """Whether it is a bag whose topics are the SDK's."""
        return path.suffix == ".bag" and path.is_file() and is_sdk_bag(path)

    def read(self, path: Path, given: Metadata) -> Streams:
        """The streams; Open3D pairs the frames and registers depth to color, and gives no time but the rate."""
        if not is_sdk_bag(path):
            raise DataError(f"{path}: is no bag of the RealSense SDK; a general ROS bag is read by the reader 'ros'")
        folder = extracted(path)
        known, told, unread = open3d_calibration(folder, given.ignore)
        fps = given.fps or next((m.fps for _, m in known if m.fps), None)
        if fps is None:
            raise DataError(
                f"{path}: its frame rate is not known; write 'fps: 30' into {path.stem}.yaml or {FILE_NAME}"
            )
        # The folder is Open3D's: what the user calls the folders of other recordings does not matter here.
        streams = read_folder(folder, Metadata(), fps, known)
        lost = _lost(folder, len(streams.color), fps)
        return Streams(
            streams.color, streams.depth, known=known, registered=True,
            checks=(Check("frame rate", Verdict.ASSUMED, "times are frame numbers over the frame rate"), *told, *lost),
            unread=unread,
        )  # fmt: skip


def is_sdk_bag(path: Path) -> bool:
    """Whether a ROS 1 bag has the topics of the RealSense SDK, by the list of topics at its end."""
    try:
        check_regular(path, MAX_ARRAY_BYTES)  # to open a pipe would wait for its other end
        with path.open("rb") as file:
            head = file.read(4096)
            if not head.startswith(_MAGIC):
                return False
            file.seek(_index_position(head))
            topics = file.read(1 << 20)
            file.seek(0)
            return _SDK_TOPIC in (topics or file.read(1 << 20))  # cut short, it has topics at its start only
    except (OSError, ValueError, DataError):  # an index that lies beyond what a file can have
        return False


def _index_position(head: bytes) -> int:
    """Where the list of topics begins; a bag that was never closed has none, and is searched from its start."""
    field = b"index_pos="
    at = head.find(field) + len(field)
    return int.from_bytes(head[at : at + 8], "little") if at >= len(field) else 0


def extracted(path: Path) -> Path:
    """The folder into which a bag was extracted, now or on an earlier run; it is there whole or not at all."""
    stat = path.stat()
    key = hashlib.sha256(f"{path.resolve()} {stat.st_size} {stat.st_mtime_ns}".encode()).hexdigest()[:16]
    folder = cache() / f"{path.stem}-{key}"
    if folder.is_dir():
        return folder
    try:
        with new_folder(folder) as temporary:
            _extract(path, temporary)
    except OSError as error:
        if not folder.is_dir():  # else another process was faster, with the same content
            raise DataError(f"{path}: cannot be extracted to {folder} ({error.strerror or error})") from error
    return folder


def cache() -> Path:
    """Where bags are extracted to: below ``XDG_CACHE_HOME``, which is ``~/.cache`` where it is not set."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "flowlab" / "realsense"


def _extract(path: Path, folder: Path) -> None:
    """Write every pair of frames as Open3D does: JPEG color, 16-bit depth, ``intrinsic.json``."""
    try:
        import open3d as o3d
    except (ImportError, OSError) as error:
        raise MissingLibraryError(
            f"{path}: reading it needs Open3D, which cannot be loaded ({error}); 'apt-get install libusb-1.0-0' "
            "gives the library it misses most often"
        ) from error
    reader = o3d.t.io.RSBagReader()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        try:
            if not reader.open(str(path)):
                raise DataError(
                    f"{path}: Open3D cannot open it; it may be cut short or use formats other than RGB8 and Z16"
                )
            # Frame by frame, a slow consumer makes the SDK drop frames; save_frames does the least in between.
            reader.save_frames(str(folder))
        except RuntimeError as error:
            raise DataError(f"{path}: Open3D cannot read it ({cut(' '.join(str(error).split()))})") from error
        finally:
            if reader.is_opened():
                reader.close()
    _drop_repeats(folder)
    if not any((folder / "color").glob("*")):
        raise DataError(f"{path}: holds no pair of color and depth frames")


def _drop_repeats(folder: Path) -> None:
    """Delete pairs that come again later, and close the gaps in the numbers.

    Open3D plays from the start twice, and may put a frame of the first time before those of the second. No two
    frames of a sensor have the same noise, so the same bytes are the same frame.
    """
    last: dict[bytes, Path] = {}
    for color in sorted((folder / "color").iterdir()):
        depth = _depth_of(color)
        digest = hashlib.sha256(color.read_bytes() + (depth.read_bytes() if depth.is_file() else b"")).digest()
        last.pop(digest, None)
        last[digest] = color
    for color in set((folder / "color").iterdir()) - set(last.values()):
        _depth_of(color).unlink(missing_ok=True)
        color.unlink()
    for number, color in enumerate(last.values()):
        for file in (_depth_of(color), color):
            if file.is_file():
                file.rename(file.with_stem(f"{number:05d}"))


def _depth_of(color: Path) -> Path:
    """The depth picture that belongs to a color picture."""
    return color.parent.with_name("depth") / f"{color.stem}.png"


def _lost(folder: Path, frames: int, fps: float) -> tuple[Check, ...]:
    """A doubt where the bag is longer than its frames."""
    values = read_json(folder / "intrinsic.json")
    length_us = values.get("stream_length_usec", 0) if isinstance(values, dict) else 0
    length_s = length_us / 1e6 if isinstance(length_us, int | float) else 0.0
    expected = int(length_s * fps)
    if frames >= 0.95 * expected:
        return ()
    says = (f"{frames} frames came of about {expected} in {length_s:.1f} s; the others were dropped or had no partner, "
            "and color may be paired with depth a few frames apart: read the bag on an idle machine")  # fmt: skip
    return (Check("frames", Verdict.DOUBTFUL, says),)
