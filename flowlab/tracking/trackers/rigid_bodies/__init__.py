"""``rigid-bodies``: an RGB-D tracker without weights. A few rigid motions, fitted to the whole clip, carry every point.

What the first frame shows is divided into what stays, what moves and what cannot be told
(:mod:`.motion_segmentation`). Tracked seeds (:mod:`.proposals`) and small regions that moved propose motions; each
is tracked through the clip, always aligning its frame-0 pixels by color, depth and free space
(:mod:`.pose_tracking`), and looked for when it is lost (:mod:`.recovery`); every pixel takes the motion that explains
it best over all frames (:mod:`.assignment`); neighbors that one motion explains are merged (:mod:`.merging`).
:mod:`.fit` does all that in turn. A query then goes where its body goes (:mod:`.propagation`).
"""

from flowlab.tracking.trackers.rigid_bodies.tracker import RigidBodies

__all__ = ["RigidBodies"]
