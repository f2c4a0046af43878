"""A tracker of your own: it follows pixels, and flowlab makes 3D flow of them.

    python examples/03_own_tracker.py recordings/pour-003 data/pour
    PYTHONPATH=examples flowlab grade --tracker 03_own_tracker:Patches --tasks drawer-open

The fields of a tracker are its options. ``open`` is called once for a recording; the session it returns is asked to
follow points through parts of it. A query is (t, x, y): the frame, and the pixel there, (0, 0) the center of the first.
At its own frame a point is where it was asked for, and visible; before it, it is held there and not visible.

A package that offers the class as an entry point makes it known by name::

    [project.entry-points."flowlab.trackers"]
    patches = "my_package.patches:Patches"
"""

import sys

import cv2
import numpy as np

import flowlab
from flowlab.records import Clip, Tracks2D
from flowlab.testing.trackers import check_tracker
from flowlab.tracking.base import Session, Tracker


class Patches(Tracker):
    """Looks for the square around a point again, near where it was in the frame before."""

    name = "patches"
    license = "MIT"

    radius: int = 7
    """Half the side of the square [px], and how far a point may go from frame to frame."""

    def open(self, clip: Clip) -> Session:
        """Get ready to track points of a clip."""
        return PatchSession(clip, self.radius)


class PatchSession:
    """The frames of a clip in gray."""

    def __init__(self, clip: Clip, radius: int) -> None:
        self.gray = [cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY) for rgb in clip.rgb]
        self.radius = radius

    def track(self, queries_txy: np.ndarray, start: int, stop: int) -> Tracks2D:
        """Follow points through frames ``start`` to ``stop - 1``."""
        xy = np.repeat(queries_txy[None, :, 1:], stop - start, axis=0)  # held where nothing else is said
        confidence = np.zeros(xy.shape[:2], np.float32)
        for m, (t, x, y) in enumerate(queries_txy):
            row = int(t) - start
            confidence[row, m] = 1
            patch = self.cut(int(t), (x, y), self.radius)
            for k in range(row + 1, stop - start):
                near = self.cut(start + k, xy[k - 1, m], 2 * self.radius)
                _, score, _, found = cv2.minMaxLoc(cv2.matchTemplate(near, patch, cv2.TM_CCOEFF_NORMED))
                xy[k, m] = xy[k - 1, m] + np.array(found) - self.radius
                confidence[k, m] = max(score, 0)
        return Tracks2D(xy, confidence > 0.5, confidence)

    def cut(self, t: int, xy: tuple[float, float], radius: int) -> np.ndarray:
        """The square around a point of a frame."""
        return cv2.getRectSubPix(self.gray[t], (2 * radius + 1, 2 * radius + 1), (float(xy[0]), float(xy[1])))


if __name__ == "__main__":
    check_tracker(Patches)  # the same checks that flowlab's own trackers pass
    recording, out = sys.argv[1:]
    dataset = flowlab.label([recording], out, tracker="03_own_tracker:Patches", settings=["track.options.radius=9"])
    print(dataset)
    for episode in dataset:
        sigma = episode.tracks.quality.sigma
        print(f"{episode.task}: half of all positions are stated to {1000 * np.median(sigma):.1f} mm or better")
