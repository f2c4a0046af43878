"""Pictures by MuJoCo's own OpenGL renderer: the second opinion on depth, and the only source of color."""

import atexit
import importlib
import os
import weakref
from typing import Any

import mujoco
import numpy as np
from jaxtyping import UInt8

from flowlab.errors import MissingLibraryError
from flowlab.geometry.camera import Camera
from flowlab.records import Frame
from flowlab.sim.scene import Poses, Scene
from flowlab.sim.scene_settings import SceneSettings

_INSTALL = (
    "OpenGL cannot be used here ({reason}); install it with 'apt-get install libegl1 libgl1-mesa-dri' "
    "(or set MUJOCO_GL=osmesa after 'apt-get install libosmesa6'), or use --renderer zbuffer, which needs none"
)


class GLRenderer:
    """Renders a scene with OpenGL from recorded poses; one serves all episodes of its scene."""

    def __init__(self, scene: Scene, camera: Camera, settings: SceneSettings) -> None:
        self.scene, self.camera, self._settings = scene, camera, settings
        self._data = mujoco.MjData(scene.model)
        mujoco.mj_forward(scene.model, self._data)
        self._options = mujoco.MjvOption()
        if not settings.markers:
            self._options.sitegroup[:] = 0
        choose_context()
        self._renderer = mujoco.Renderer(scene.model, camera.height, camera.width)
        # At exit the context must go before the display it is of, which went to MuJoCo's own exit handler.
        atexit.register(_close_if_alive, weakref.ref(self))

    def close(self) -> None:
        """Give the OpenGL context back."""
        self._renderer.close()

    def color(self, poses: Poses) -> UInt8[np.ndarray, "v u rgb"]:
        """The color picture alone: a third of the work."""
        self._place(poses)
        return self._renderer.render().copy()

    def frame(self, poses: Poses) -> Frame:
        """Depth, owners and, if asked for, color of the scene with everything at the given poses."""
        self._place(poses)
        self._renderer.enable_depth_rendering()
        depth = self._renderer.render().copy()
        self._renderer.disable_depth_rendering()
        self._renderer.enable_segmentation_rendering()
        number, kind = np.moveaxis(self._renderer.render(), -1, 0)
        self._renderer.disable_segmentation_rendering()
        owner = np.full(number.shape, -1, np.int16)
        # As plain numbers: comparing an array with MuJoCo's own enumeration takes milliseconds.
        is_geom, is_site = kind == int(mujoco.mjtObj.mjOBJ_GEOM), kind == int(mujoco.mjtObj.mjOBJ_SITE)
        owner[is_geom], owner[is_site] = number[is_geom], number[is_site] + self.scene.model.ngeom
        depth[owner < 0] = 0
        rgb = self._renderer.render().copy() if self._settings.rgb else None
        return Frame(depth, self.camera, owner, self.scene.entities, rgb)

    def _place(self, poses: Poses) -> None:
        """Put everything at the given poses."""
        d = self._data
        d.geom_xpos[:], d.geom_xmat[:] = poses.geom_pos, poses.geom_mat
        d.site_xpos[:], d.site_xmat[:] = poses.site_pos, poses.site_mat
        d.cam_xpos[:], d.cam_xmat[:] = poses.cam_pos, poses.cam_mat
        self._renderer.update_scene(d, self._settings.camera.name, self._options)


def _close_if_alive(renderer: weakref.ref[GLRenderer]) -> None:
    alive = renderer()
    if alive is not None:
        alive.close()


def choose_context() -> Any:
    """Make MuJoCo use the back end of MUJOCO_GL, or EGL, which works without a display; returns its contexts' class.

    MuJoCo itself chooses when it is first imported, and then a window system; too early, and the wrong one
    for a machine without a screen.
    """
    backend = os.environ.get("MUJOCO_GL") or "egl"
    try:
        context = importlib.import_module(f"mujoco.{backend}").GLContext
        probe = context(1, 1)
        probe.make_current()
        mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100).free()
        probe.free()
    except Exception as error:  # every back end fails in its own way
        raise MissingLibraryError(_INSTALL.format(reason=f"{backend}: {error}")) from error
    mujoco.gl_context.GLContext = context
    return context
