"""``bodies``: an RGB-D tracker without weights. A few rigid motions, fitted to the whole clip, carry every point.

The first frame is divided into what stays, what moves and what cannot be told (:mod:`.segments`). Followed
seeds and small things that moved propose motions (:mod:`.seeds`, :mod:`.fit`); each is followed through the
clip, always aligning its frame-0 pixels by color, depth and free space (:mod:`.following`); every pixel takes
the motion that explains it best over all frames (:mod:`.labels`); neighbors that one motion explains are
merged. A query then goes where its body goes.
"""

from flowlab.tracking.trackers.rigid_bodies.tracker import RigidBodies

__all__ = ["RigidBodies"]
