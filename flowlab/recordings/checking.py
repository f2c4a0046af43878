"""Every check of a recording, in one place, through which all layouts pass."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from flowlab.recordings.left_out import check_widths_known, find_left_out
from flowlab.recordings.verdicts import Check, Verdict

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording


def check_recording(source: "ParsedRecording") -> Iterator[Check]:
    """What is looked at in a recording whose layout is understood, and what came of it."""
    yield _registration(source)
    yield from check_widths_known(source)
    yield from find_left_out(source)


def _registration(source: "ParsedRecording") -> Check:
    """Whether depth is seen from the color camera, and how that is known."""
    known = source.metadata
    if known.depth_intrinsics is not None or known.T_color_depth is not None or source.streams.registered is False:
        return Check("registration", Verdict.OK, "depth is registered to color by flowlab")
    if source.streams.registered:
        return Check("registration", Verdict.OK, "depth is registered to color, as the layout says")
    return Check("registration", Verdict.ASSUMED, "depth is taken as registered to color: same size, nothing said")
