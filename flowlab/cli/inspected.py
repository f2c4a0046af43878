"""What a dry run says of recordings: JSON values, or lines for people."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from flowlab.errors import UsageError
from flowlab.perception.observer import Box
from flowlab.pipeline.inspection import InspectedRecording
from flowlab.recordings.recording import StreamInfo
from flowlab.storage.recorded import Recorded
from flowlab.text import counted, file_name

_SHOWN = 5
"""Bad frames that people are shown of one recording; JSON has all."""


def facts_of(one: InspectedRecording) -> dict[str, Any]:
    """What was recognized of a recording, or only its problem."""
    found, about = one.description, {"recording": one.recorded.source, "task": one.recorded.task}
    if found is None:
        return about | {"problem": one.problem}
    return about | {
        "reader": found.reader,
        "rows": found.rows,
        "streams": [_stream(s) for s in found.streams],
        "sync_ms": {name: [round(1e3 * s, 2) for s in both] for name, both in found.sync_s.items()},
        "color_size": list(found.color_size),
        "depth_size": list(found.depth_size),
        "frame_size": None if found.frame_size is None else list(found.frame_size),
        "depth_unit_m": found.depth_unit_m,
        "calibration": dict(found.origin),
        "state_width": found.state_width,
        "action_width": found.action_width,
        "state_names": list(found.state_names),
        "action_names": list(found.action_names),
        "bad_frames": [[b.name, b.reason] for b in found.bad],
        "checks": [check.to_json() for check in found.checks],
        "problem": found.problem,
    }


def sheet_paths(png: Path, recordings: Sequence[Recorded]) -> dict[Recorded, Path]:
    """Where the sheet of each recording is drawn: ``png`` of the only one, else a name with that of the recording."""
    if png.suffix.lower() != ".png":
        raise UsageError(
            f"{png}: a sheet is a picture whose name ends with .png, as in --png {png.with_suffix('.png')}"
        )
    if len(recordings) == 1:
        return {recordings[0]: png}
    paths: dict[Recorded, Path] = {}
    for one in recordings:
        name = png.with_name(f"{png.stem}-{file_name(f'{one.task}-{one.name}')}.png")
        paths[one] = name.with_stem(f"{name.stem}-{one.seed}") if name in paths.values() else name
    return paths


def draw_sheet(one: InspectedRecording, png: Path, crop: Box | None) -> None:
    """Draw the sheet of a recording."""
    from flowlab.viz.recording_sheet import draw_recording_sheet

    found, preview = one.description, one.preview
    assert preview is not None
    checks = () if found is None else found.checks
    rows = "" if found is None else f"   {counted(found.rows, 'row')}, read as a {found.reader} recording"
    title = f"{one.recorded.task}/{one.recorded.name}{rows}"
    draw_recording_sheet(preview, png, title=title, checks=checks, problem=one.problem, crop=crop)


def _stream(s: StreamInfo) -> dict[str, Any]:
    about = {"stream": s.name, "count": s.count, "fps": round(s.fps, 2)}
    return {**about, "first_s": s.first_s, "last_s": s.last_s, "gaps_s": [list(gap) for gap in s.gaps]}


def lines_of(facts: dict[str, Any]) -> Iterator[str]:
    """The same for people: first the recording, then a line for everything known of it."""
    rows = f", {counted(facts['rows'], 'row')}, read as a {facts['reader']} recording" if "reader" in facts else ""
    yield f"{facts['recording']}: task '{facts['task']}'{rows}"
    if "reader" in facts:
        for name, value in _known(facts):
            yield f"  {name:<12} {value}"
    if facts["problem"]:
        yield f"  {'problem':<12} {facts['problem']}"
    if "sheet" in facts:
        yield f"  {'sheet':<12} {facts['sheet']}"


def _known(facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for s in facts["streams"]:
        yield s["stream"], f"{s['count']} at {s['fps']:g} per second, {_gaps(s['gaps_s'])}"
    for name, (median, most) in facts["sync_ms"].items():
        yield "sync", f"{name} is {median:g} ms from its color frame in the median, {most:g} ms at most"
    yield "pictures", ", ".join(f"{what} {'x'.join(map(str, facts[f'{what}_size']))}" for what in ("color", "depth"))
    yield "depth unit", f"{facts['depth_unit_m']} m" if facts["depth_unit_m"] else "not known"
    places: dict[str, list[str]] = {}
    for key, place in facts["calibration"].items():
        places.setdefault(place, []).append(key)
    yield "known", "; ".join(f"{', '.join(keys)} from {place}" for place, keys in places.items()) or "nothing else"
    yield "robot", f"state of {counted(facts['state_width'], 'number')}, action of {facts['action_width']}"
    for name, reason in facts["bad_frames"][:_SHOWN]:
        yield "bad frame", f"{name}: {reason}"
    if len(facts["bad_frames"]) > _SHOWN:
        yield "bad frames", f"{len(facts['bad_frames']) - _SHOWN} more; --json lists all"
    for check in facts["checks"]:
        yield check["verdict"], f"{check['about']}: {check['says']}"


def _gaps(gaps: list[list[float]]) -> str:
    if not gaps:
        return "no gaps"
    start, length = max(gaps, key=lambda gap: gap[1])
    return f"{counted(len(gaps), 'gap')}, the longest of {length:.2f} s at {start:.2f} s"
