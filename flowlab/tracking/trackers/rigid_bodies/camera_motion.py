"""How a camera moves whose poses nobody knows: most of what it sees stands still, and moves before it as one."""

from dataclasses import replace

import numpy as np

from flowlab.tracking.trackers.rigid_bodies.bodies import changed_body, new_body
from flowlab.tracking.trackers.rigid_bodies.features import ClipFeatures
from flowlab.tracking.trackers.rigid_bodies.motion_segmentation import MotionGrid, segment_motion
from flowlab.tracking.trackers.rigid_bodies.pose_tracking import track_poses

_POINTS = 1000
"""Points the whole scene is followed by."""
_SOME_FRAMES = 3
"""Every how many frames are enough to tell roughly what stands still."""
_MIN_STATIC_SHARE = 0.25
"""Of the scene that must be found to stand still before a motion that is to be the camera's."""


def with_camera_motion(
    pictures: ClipFeatures, grid: MotionGrid, rng: np.random.Generator
) -> tuple[ClipFeatures, MotionGrid]:
    """The clip with the motion of what stands still, where a camera moves and its poses are not given.

    The whole first frame is followed as if it were one body; then, without what is seen not to move with it.

    Args:
        pictures: The clip.
        grid: What of it stands still before a camera that is taken to stand still, too.
        rng: Chooses the pixels that are followed.

    Returns:
        The clip and what of it stands still; as they were where much of it does before a camera at rest, or where
        little does before a camera that moves.
    """
    if pictures.still is not None or grid.static.any() or not grid.valid.any():
        return pictures, grid
    scene = new_body(pictures, grid, grid.valid)
    for every in (_SOME_FRAMES, 1):
        scene = track_poses(pictures, [scene], rng, _POINTS)[0]
        moving = replace(pictures, still=scene.motion, still_is_fitted=True)
        found = segment_motion(moving, every)
        if found.static.sum() < _MIN_STATIC_SHARE * found.valid.sum():
            return pictures, grid
        scene = changed_body(moving, found, found.static, scene.motion)
    return moving, found
