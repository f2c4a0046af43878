"""What is seen of a simulated scene, and what its numbers mean."""

from typing import Annotated, Any, Literal

from pydantic import Field, PlainSerializer

from flowlab.config import Settings
from flowlab.provenance import Channels

ACTION_SIZE = 4
"""Hand displacement in x, y, z (1 is 1 cm) and gripper effort, each in [-1, 1]."""


class CameraSettings(Settings):
    """The camera of a simulated scene."""

    name: str = "corner2"
    """A camera of MetaWorld's models."""
    position: tuple[float, float, float] | None = (0.6, 0.295, 0.8)
    """Moves the camera there [m]; DP3's and 3D FDP's position. null leaves it where the model has it."""
    width: int = Field(default=128, gt=0)
    """[px]"""
    height: int = Field(default=128, gt=0)
    """[px]"""


class SceneSettings(Settings):
    """What the camera is shown, and in which frame the labels are given."""

    camera: CameraSettings = CameraSettings()
    """Where it is looked at from."""
    renderer: Literal["zbuffer", "gl"] = "zbuffer"
    """``zbuffer`` needs no OpenGL; ``gl`` is MuJoCo's own renderer. They agree (see the tests)."""
    rgb: bool = False
    """Also take color pictures; needs ``gl``."""
    markers: bool = True
    """Draw goal markers. In reach, push and pick-place they are all that shows the goal."""
    hidden_bodies: Annotated[frozenset[str], PlainSerializer(sorted)] = frozenset()
    """Bodies not to draw."""
    convention: Literal["flowlab", "dp3"] = "flowlab"
    """``dp3`` reproduces DP3's camera: its rotated, camera-centered frame and its half-pixel shift."""


_WORLD_FRAMES = {
    "flowlab": "MetaWorld's own: z up, table top at z = 0 in most tasks, the robot's base at the origin facing +y",
    "dp3": "DP3's: centered at the camera and turned about 130 degrees about z; robot state stays in MetaWorld's",
}


def describe_scene(settings: SceneSettings) -> dict[str, Any]:
    """What the episodes of a scene are and what their numbers mean: all of their
    :class:`~flowlab.provenance.Provenance` that does not depend on the camera's model."""
    frame = "simulator" if settings.convention == "dp3" else "world"  # DP3 turns the clouds, and not the state
    position, displacement = {"kind": "position", "unit": "m"}, {"kind": "displacement", "unit": "cm"}
    return {
        "kind": "simulated",
        "simulator": "metaworld",
        "scene": settings.model_dump(mode="json"),
        "world_frame": _WORLD_FRAMES[settings.convention],
        "state": (
            Channels(name="hand", index=(0, 1, 2), frame=frame, **position),
            Channels(name="right finger", index=(3, 4, 5), frame=frame, **position),
            Channels(name="left finger", index=(6, 7, 8), frame=frame, **position),
        ),
        "action": (
            Channels(name="hand", index=(0, 1, 2), frame=frame, **displacement),
            Channels(name="gripper", index=(3,), kind="effort", frame="", unit="1"),
        ),
        "action_limits": ((-1.0,) * ACTION_SIZE, (1.0,) * ACTION_SIZE),
    }
