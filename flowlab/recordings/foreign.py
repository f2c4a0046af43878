"""Formats that are known by sight and not read: what each is, and the way on."""

from collections.abc import Callable
from pathlib import Path

from flowlab.recordings.folder_files import entries
from flowlab.recordings.readers.hdf5_file import is_hdf5

_PLAIN = "write its color and depth pictures as PNG into color/ and depth/ with a recording.yaml (docs/recordings.md)"
_BY_SUFFIX = {
    (".r3d",): f"is a recording of Record3D, which is not read; unzip it, and {_PLAIN}",
    (".mkv",): f"is a video (of an Azure Kinect, say), which is not read; unpack it with 'ffmpeg -i', and {_PLAIN}",
    (".mp4", ".avi", ".mov"): f"is a video, which is not read, and holds no depth; {_PLAIN}",
    (".sens",): f"is of ScanNet, a format that is not read; {_PLAIN}, or an .npz file per episode",
    (".svo", ".svo2", ".oni", ".rrd", ".tfrecord", ".parquet", ".klg"): f"is of a format that is not read; {_PLAIN}",
    (".zst", ".zstd"): "is compressed; unpack it with 'zstd -d FILE'",
    (".bz2",): "is compressed; unpack it with 'bunzip2 -k FILE'",
    (".gz", ".tgz"): "is compressed; unpack it with 'gunzip -k FILE' or 'tar -xzf FILE'",
    (".xz", ".lz4"): "is compressed; unpack it",
    (".zip", ".tar", ".7z", ".rar"): "is an archive; unpack it",
    (".active",): "is a bag that was never closed; close it with 'rosbag reindex FILE'",
}  # fmt: skip

_HDF5 = {
    True: "is HDF5, which is read as a recording of its own (docs/hdf5.md)",
    False: "is called as HDF5 is, but its content is none; if it was cut short, copy it again",
}


def foreign_format(path: Path) -> str:
    """What a file or folder is that no reader reads, and the way on; empty where that is not known.

    Args:
        path: The file or folder.
    """
    if path.is_dir():
        return next((says for looks_like, says in _FOLDERS if looks_like(path)), "")
    suffix = path.suffix.lower()
    if suffix in (".h5", ".hdf5", ".hdf"):
        return _HDF5[is_hdf5(path)]
    says = next((says for suffixes, says in _BY_SUFFIX.items() if suffix in suffixes), "")
    return says.replace("FILE", path.name)


def _seven_scenes(folder: Path) -> bool:
    """``frame-000000.color.png`` and its kind, all in one folder."""
    return any(n.startswith("frame-") and n.endswith((".depth.png", ".depth.proj.png")) for n in entries(folder))


def _stray_scanner(folder: Path) -> bool:
    return (folder / "rgb.mp4").is_file() and (folder / "depth").is_dir()


_FOLDERS: tuple[tuple[Callable[[Path], bool], str], ...] = (
    (_seven_scenes, "has the layout of 7-Scenes, which is not read; move *.color.png into color/ and *.depth.png into "
                    "depth/, with a recording.yaml (depth_unit_m: 0.001, fps: 30, intrinsics)"),
    (_stray_scanner, "is of Stray Scanner, which keeps color as a video; unpack it with 'mkdir color; ffmpeg -i rgb.mp4 "  # noqa: E501
                     "-start_number 0 color/%06d.png', and add a recording.yaml"),
)  # fmt: skip
