"""Loading MuJoCo, which may fail for a setting that has nothing to do with what is wanted of it."""

import os

from flowlab.errors import MissingLibraryError


def load_mujoco() -> None:
    """Import MuJoCo before anything else does.

    Raises:
        MissingLibraryError: It cannot load the OpenGL that ``MUJOCO_GL`` names, which it does on import, needed or not.
    """
    try:
        import mujoco  # noqa: F401
    except Exception as error:
        if "MUJOCO_GL" not in os.environ:
            raise
        raise MissingLibraryError(
            f"MuJoCo cannot load OpenGL as MUJOCO_GL={os.environ['MUJOCO_GL']} asks ({error}); unset MUJOCO_GL, or "
            "install it with 'apt-get install libegl1 libgl1-mesa-dri libosmesa6'"
        ) from error
