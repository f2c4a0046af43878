"""Frames of color and depth that are paired by their numbers: whether these count the same frames."""

import numpy as np
from jaxtyping import Float64

from flowlab.recordings.verdicts import Check, Verdict


def check_numbers(color: Float64[np.ndarray, "N"], depth: Float64[np.ndarray, "M"], name: str, stated: bool) -> Check:
    """Whether the frame numbers of color and depth are those of one counter.

    Numbers that begin at the same and do not end at the same, or that begin one apart, or are shifted as a whole, may
    have been given to each stream by itself: then depth belongs to another color picture than its number says.

    Args:
        color: Of the color pictures, rising.
        depth: Of the depth pictures or of samples of state, rising.
        name: What these are called: depth, say.
        stated: Whether the user says how they belong together, with ``depth_offset_s`` or ``state_offset_s``.
    """
    span = f"color has the numbers {color[0]:g} to {color[-1]:g}, {name} {depth[0]:g} to {depth[-1]:g}"
    key = "depth_offset_s" if name == "depth" else "state_offset_s"
    first, last = depth[0] - color[0], depth[-1] - color[-1]
    if stated:
        return Check("numbers", Verdict.OK, f"{span}, paired as '{key}' says")
    why = ""
    if first == last == 0:
        verdict = "the same"
    elif not len(np.intersect1d(color, depth)):
        why = "no picture of one has the number of one of the other"
    elif {color[0], depth[0]} == {0, 1} or first * last > 0 or (abs(first) == 1 and last == 0):
        why = "they may be counted from different ones"
    elif first == 0:
        why = "each stream may have been counted by itself, and frames be missing at the start of one"
    else:
        verdict = "one counter's, by where they begin, end and have holes"
    if not why:
        return Check("numbers", Verdict.OK, f"{span}: {verdict}")
    return Check(
        "numbers",
        Verdict.REFUSED,
        f"{span}: {why}; if equal numbers belong together, write '{key}: 0', else how many seconds to add to the "
        f"times of {name}, or give the times of both in files",
    )
