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
            f"{gl_advice(os.environ['MUJOCO_GL'])}"
        ) from error


def gl_advice(backend: str) -> str:
    """What to do where an OpenGL back end of MuJoCo cannot be loaded."""
    packages = {"egl": "libegl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}
    if backend.lower() == "glfw":
        return "set MUJOCO_GL=egl: glfw needs a display (DISPLAY) and the package libglfw3"
    return f"install it with 'apt-get install {packages.get(backend.lower(), 'libegl1 libgl1-mesa-dri libosmesa6')}'"
