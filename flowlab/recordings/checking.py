"""Every check of a recording, in one place, through which all layouts pass."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from flowlab.recordings.camera_check import check_camera
from flowlab.recordings.depth_unit_check import check_depth_unit
from flowlab.recordings.left_out import check_widths_known, find_left_out
from flowlab.recordings.motion_check import check_motion
from flowlab.recordings.number_check import check_numbers
from flowlab.recordings.pose_check import check_poses_fit
from flowlab.recordings.registration_check import check_registration
from flowlab.recordings.robot_check import check_robot
from flowlab.recordings.verdicts import Check, Verdict
from flowlab.recordings.world_check import check_world

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording


def check_recording(source: "ParsedRecording") -> Iterator[Check]:
    """What is looked at in a recording whose layout is understood, and what came of it."""
    yield from _geometry(source)
    yield from check_widths_known(source)
    yield from check_numbers(source)
    yield from find_left_out(source)


def _geometry(source: "ParsedRecording") -> Iterator[Check]:
    """Cameras, depth, and where the camera stands; nothing of what is not known, or not seen."""
    seen, known = source.frame_check, source.metadata
    if not seen.samples:
        return
    cameras = [
        check
        for about, camera, size in (
            ("intrinsics", known.intrinsics, seen.color_size),
            ("depth_intrinsics", known.depth_intrinsics, seen.depth_size),
        )
        if camera is not None
        for check in check_camera(about, camera, size, source.write_to)
    ]
    yield from cameras
    yield from check_depth_unit(source)
    if any(check.verdict is Verdict.REFUSED for check in cameras):
        return  # what follows is seen through these
    yield check_registration(source)
    yield from check_world(source)
    camera = check_motion(source) if seen.T_world_cam is None else check_poses_fit(source)
    yield camera
    if camera.verdict in (Verdict.OK, Verdict.ASSUMED):  # else what moves is not told from what only seems to
        yield from check_robot(source)
