"""A recording that is a part of a file or of a dataset, as one episode of many is: ``demos.hdf5/data/demo_3``."""

from pathlib import Path

from flowlab.untrusted import is_there

FOLDER_INDEX = "meta/info.json"
"""What a folder has whose recordings lie together in its files, as those of LeRobot do."""


def split_path(path: Path) -> tuple[Path, str]:
    """The file or folder that a recording lies in, and which part of it the recording is.

    Args:
        path: Of the recording.

    Returns:
        A path that the file system knows, and the rest with ``/`` between its parts, empty for the whole; where there
        is nothing at the path, the path itself.
    """
    if not is_there(path):
        for above in path.parents:
            if is_there(above):
                holds = above.is_file() or is_there(above / FOLDER_INDEX)
                return (above, path.relative_to(above).as_posix()) if holds else (path, "")
    return path, ""


def place_of(path: Path) -> Path:
    """The file or folder that a recording lies in."""
    return split_path(path)[0]
