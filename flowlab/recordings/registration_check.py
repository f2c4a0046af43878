"""Whether depth is seen from the color camera: edges of depth against edges of color, over shift and scale."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Float32
from scipy import fft

from flowlab.recordings.depth_aside import DepthAside
from flowlab.recordings.image_files import exif_turns
from flowlab.recordings.lens import undistorted_rays
from flowlab.recordings.picture_samples import PictureSample
from flowlab.recordings.verdicts import Check, Verdict

if TYPE_CHECKING:
    from flowlab.recordings.parsing import ParsedRecording

_FRAMES = 6
"""So many frames are looked at."""
_SCALES = np.exp(np.linspace(-0.3, 0.3, 21))
"""Depth is tried at these sizes around the middle of the picture."""
_SHIFT = 0.15
"""Shifts up to this share of the width are tried."""
_GAP = 12
"""Readings that lie apart by no more pixels without one are compared, too."""
_JUMP = 0.05
"""Where depth jumps by this share there is the edge of a thing."""
_EDGES = 60
"""Fewer pixels of edges tell nothing."""
_CLARITY = (4.0, 5.0)
"""The best place is above all places by so many standard deviations, for a doubt and for a refusal."""
_GAIN = (0.12, 0.35)
"""Likewise, it is this much better than where depth lies."""
_LIES = 0.25
"""Where edges of depth lie on those of color, these are as strong, in standard deviations of the picture."""
_STRAIGHT, _TURNED = 0.6, 1.5
"""Where they are as strong as that, depth is not turned; else it is where they are so many times as strong turned."""
_CLEAR, _CLEAR_SHARE = 40.0, 0.03
"""A gradient of a smoothed picture, by Sobel, is no noise beyond this; so many pixels have one, or all is dim."""
_SHARE = (0.012, 0.03)
"""Likewise, the worst corner is this far off, of the picture's width."""


@dataclass(frozen=True, slots=True)
class Misalignment:
    """How depth must be moved so that its edges lie on those of color, by the picture's middle."""

    shift_px: tuple[float, float]
    """In pixels of the source."""
    scale: float
    share: float
    """How far the worst corner is off, of the picture's width."""
    clarity: float
    """How many standard deviations the best place is above all places."""
    gain: float
    """How much better the best place is than where depth lies, 0 to 1 and more."""
    here: float
    """How strong edges of color are where those of depth lie, in standard deviations of all."""
    textured: bool
    """Whether color has edges that are no noise."""

    @property
    def lies_nowhere(self) -> bool:
        """Whether edges of depth lie on none of color's, though there are some."""
        return self.textured and self.here < _LIES


def estimate_misalignment(samples: Sequence[PictureSample]) -> Misalignment | None:
    """How far depth is from lying on color; None where there are not enough edges to tell."""
    some = [samples[k] for k in np.unique(np.linspace(0, len(samples) - 1, min(_FRAMES, len(samples))).astype(int))]
    pairs = [(depth_edges(s.depth), _color_edges(s.gray)) for s in some if s.depth.shape == s.gray.shape]
    pairs = [(d, c) for d, c in pairs if np.count_nonzero(d) >= _EDGES]
    if not pairs:
        return None
    width = pairs[0][0].shape[2]
    reach = max(2, round(_SHIFT * width))
    scores = _scores(pairs, reach)
    at = np.unravel_index(scores.argmax(), scores.shape)
    spread, mean = float(scores.std()), float(scores.mean())
    k, dy, dx = int(at[0]), int(at[1]) - reach, int(at[2]) - reach
    middle = len(_SCALES) // 2
    here = float(scores[middle - 1 : middle + 2, reach - 1 : reach + 2, reach - 1 : reach + 2].max())
    best, factor = float(scores[at]), some[0].color_factor
    off = np.hypot(*(np.abs([dx, dy]) + abs(_SCALES[k] - 1) * np.array(pairs[0][0].shape[:0:-1]) / 2))
    return Misalignment(
        (dx * factor, dy * factor),
        float(_SCALES[k]),
        float(off / width),
        (best - mean) / spread if spread > 0 else 0.0,
        (best - here) / (best - mean) if best > mean else 0.0,
        here / max(float(np.mean([c.std() for _, c in pairs])), 1e-6),
        bool(np.mean([_clear_share(s.gray) for s in some]) >= _CLEAR_SHARE),
    )


def depth_edges(counts: np.ndarray) -> Float32[np.ndarray, "2 H W"]:
    """Where the nearer side of a jump in depth lies: across columns, and across rows.

    Args:
        counts: Depth in any unit; what is not above 0 is no reading.

    Returns:
        1 at edges, else 0.
    """
    depth = np.where(np.isfinite(counts) & (counts > 0), counts, 0).astype(np.float32)
    return np.stack([_jumps(depth), _jumps(depth.T).T])


def _jumps(depth: np.ndarray) -> np.ndarray:
    """Jumps from a reading to the next one of its row."""
    edges = np.zeros(depth.shape, np.float32)
    valid, column = depth > 0, np.arange(depth.shape[1])
    last = np.maximum.accumulate(np.where(valid, column, -1), axis=1)
    before = np.concatenate([np.full((len(depth), 1), -1), last[:, :-1]], axis=1)
    row, at = np.nonzero(valid & (before >= 0) & (column - before <= _GAP))
    left, right = depth[row, before[row, at]], depth[row, at]
    for near, far, place in ((left, right, before[row, at]), (right, left, at)):
        jump = far - near > _JUMP * near
        edges[row[jump], place[jump]] = 1
    return edges


def _color_edges(gray: np.ndarray) -> Float32[np.ndarray, "2 H W"]:
    """Strength of edges across columns and across rows, weak ones raised, mean 0."""
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 0.8)
    found = np.stack([np.abs(cv2.Sobel(smooth, cv2.CV_32F, 1, 0)), np.abs(cv2.Sobel(smooth, cv2.CV_32F, 0, 1))])
    found = found / (found + 20)
    return (found - found.mean((1, 2), keepdims=True)).astype(np.float32)


def _clear_share(gray: np.ndarray) -> float:
    """The share of the pixels at edges that are no noise."""
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 1.5)
    return float((np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)) > _CLEAR).mean())


def _scores(pairs: Sequence[tuple[np.ndarray, np.ndarray]], reach: int) -> np.ndarray:
    """Mean strength of color edges under depth edges, at every scale, and for every shift (dy, dx) within reach."""
    rows = np.r_[-reach : reach + 1]
    total = np.zeros((len(_SCALES), len(rows), len(rows)))
    for depth, color in pairs:
        height, width = depth.shape[1:]
        size = (cv2.getOptimalDFTSize(height + reach), cv2.getOptimalDFTSize(width + reach))
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        spectrum = fft.rfft2(color, size)
        for k, scale in enumerate(_SCALES):
            place = np.column_stack([scale * np.eye(2), middle * (1 - scale)])
            moved = np.stack([cv2.warpAffine(d, place, (width, height), flags=cv2.INTER_LINEAR) for d in depth])
            near = fft.irfft2((np.conj(fft.rfft2(moved, size)) * spectrum).sum(0), size)
            total[k] += near[np.ix_(rows, rows)] / max(float(moved.sum()), 1.0)
    return total / len(pairs)


_TURNS: dict[str, tuple[slice, slice]] = {
    "upside down": (slice(None, None, -1), slice(None)),
    "mirrored": (slice(None), slice(None, None, -1)),
    "turned by half a turn": (slice(None, None, -1), slice(None, None, -1)),
}


def _fits_turned(samples: Sequence[PictureSample], straight: Misalignment | None) -> str:
    """How depth lies if its edges lie on those of color only when it is turned or mirrored; empty where it does not."""
    if straight is None or straight.here >= _STRAIGHT or not straight.textured:
        return ""
    for how, turn in _TURNS.items():
        turned = estimate_misalignment([replace(s, depth=s.depth[turn]) for s in samples])
        if turned is None or turned.here < max(_STRAIGHT, _TURNED * straight.here) or turned.clarity < _CLARITY[0]:
            continue
        if turned.gain <= _GAIN[0] or turned.share <= _SHARE[0]:
            return (f", but edges of depth lie on those of color as if depth were {how} ({turned.here:.2f} standard "
                    f"deviations above the mean, {straight.here:.2f} as it is)")  # fmt: skip
    return ""


def check_registration(source: "ParsedRecording") -> Check:
    """Whether depth lies on color, by what is said of it and by the pictures."""
    how, stated = _how(source)
    samples, seen, turned = source.frame_check.samples, source.frame_check, _turned(source)
    if how is None:
        return Check("registration", Verdict.DOUBTFUL, "depth is seen from a camera of its own, and not registered yet")
    if source.metadata.depth_intrinsics is not None and source.metadata.T_color_depth is not None:
        samples = tuple(_registered(source))
    elif seen.color_size != seen.depth_size:
        (w, h), (width, height) = seen.depth_size, seen.color_size
        return Check("registration", Verdict.REFUSED, f"depth has pictures of {w}x{h}, color of {width}x{height}, so "
                     f"it is not registered to color{turned}; give 'depth_intrinsics' and 'T_color_depth' in "
                     f"{source.write_to}")  # fmt: skip
    found = estimate_misalignment(samples)
    verdict, says = _judged(found, stated, seen.aside)
    if verdict is not Verdict.OK and (how_turned := _fits_turned(samples, found)):
        verdict, says = max(verdict, Verdict.DOUBTFUL, key=lambda v: v.severity), how_turned
    if verdict in (Verdict.REFUSED, Verdict.DOUBTFUL) or (turned and verdict is not Verdict.OK):
        advice = "give 'depth_intrinsics' and 'T_color_depth', or record depth that is aligned to color: see"
        if source.metadata.T_color_depth is not None:
            advice = "correct 'depth_intrinsics' or 'T_color_depth' in"
        elif turned:
            advice = "turn the pictures themselves, as depth is, and remove that note; intrinsics are those in"
        return Check("registration", max(verdict, Verdict.DOUBTFUL, key=lambda v: v.severity),
                     f"{how}{says}{turned}; {advice} {source.write_to}")  # fmt: skip
    return Check("registration", verdict, f"{how}{says}{turned and f'{turned}, and is taken as it is stored'}")


def _judged(found: Misalignment | None, stated: bool, aside: DepthAside | None) -> tuple[Verdict, str]:
    """What the pictures say: depth that is off by little, or not clearly, is let pass."""
    untold = Verdict.OK if stated else Verdict.ASSUMED
    if found is None:
        return _by_changes(aside) or (untold, "; too few edges in the pictures to tell")
    where = (f"moved by ({found.shift_px[0]:g}, {found.shift_px[1]:g}) px and sized by {found.scale:.2f} "
             f"(gain {found.gain:.2f}, clarity {found.clarity:.1f})")  # fmt: skip
    for k, verdict in ((1, Verdict.REFUSED), (0, Verdict.DOUBTFUL)):
        elsewhere = found.gain > _GAIN[k] and found.share > _SHARE[k] and found.clarity > _CLARITY[k]
        if elsewhere and (found.clarity > _CLARITY[1] or found.lies_nowhere):
            return verdict, f", but edges of depth fit those of color best when {where}"
    if found.clarity >= _CLARITY[0] and (found.gain <= _GAIN[0] or found.share <= _SHARE[0]):
        return Verdict.OK, ", and the pictures agree: edges of depth lie on those of color"
    if found.lies_nowhere:
        return Verdict.DOUBTFUL, (f", but edges of depth lie on none of color's ({found.here:.2f} standard deviations "
                                  f"above the mean, expected {_LIES} and more), and fit nowhere else: it may be "
                                  "turned, mirrored, or of another camera or time")  # fmt: skip
    nowhere = f"; edges of depth fit edges of color nowhere well enough to tell (clarity {found.clarity:.1f})"
    return _by_changes(aside) or (untold, nowhere)


def _by_changes(aside: DepthAside | None) -> tuple[Verdict, str] | None:
    """What is told by where the pictures change; None where it is nothing."""
    if aside is None or aside.lies is None:
        return None
    if aside.lies:
        return (
            Verdict.OK,
            f", and the pictures agree: depth changes where color does (correlation {aside.correlation:.2f})",
        )
    right, down = (f"{100 * share:.0f} %" for share in aside.shift)
    return Verdict.DOUBTFUL, (f", but depth changes where color does when moved by {right} of the width and {down} of "
                              f"the height (correlation {aside.correlation:.2f})")  # fmt: skip


def _turned(source: "ParsedRecording") -> str:
    """What files of color say of how to turn them, which flowlab does not do; empty where they say nothing."""
    name = source.streams.color.names[0]
    if source.path.is_dir() and exif_turns(source.path / name):
        return f"; {name} has a note that it is to be turned when it is shown (EXIF orientation)"
    return ""


def _how(source: "ParsedRecording") -> tuple[str | None, bool]:
    """How depth comes to be seen from the color camera, and whether that was stated; None where it does not."""
    known = source.metadata
    if known.depth_intrinsics is not None and known.T_color_depth is not None:
        return "depth is registered to color by flowlab", True
    if known.depth_intrinsics is not None or known.T_color_depth is not None or source.streams.registered is False:
        return None, True
    if source.streams.registered:
        return "depth is registered to color, as the layout says", True
    return "depth is taken as registered to color: same size, nothing said", False


def _registered(source: "ParsedRecording") -> list[PictureSample]:
    """The samples with depth as the color camera sees it, by the nearest pixel of small pictures."""
    known, found = source.metadata, []
    camera, color, T = known.depth_intrinsics, known.intrinsics, np.array(known.T_color_depth)
    if camera is None or color is None:
        return []
    for s in source.frame_check.samples:
        v, u = np.nonzero(np.isfinite(s.depth) & (s.depth > 0))
        z = s.depth[v, u] * (known.depth_unit_m or 1.0)
        pixels = np.stack([u, v], -1) * s.depth_factor + (s.depth_factor - 1) // 2
        rays = undistorted_rays(camera.lens, camera.K, camera.distortion, pixels)
        at = np.concatenate([rays, np.ones((len(rays), 1))], 1) * z[:, None] @ T[:3, :3].T + T[:3, 3]
        at = at[at[:, 2] > 0]
        place = (at[:, :2] / at[:, 2:] * [color.fx, color.fy] + [color.cx, color.cy] + 0.5) / s.color_factor
        u, v = np.floor(place).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < s.gray.shape[1]) & (v < s.gray.shape[0])
        depth = np.full(s.gray.shape, np.inf)
        np.minimum.at(depth, (v[inside], u[inside]), at[inside, 2])
        found.append(replace(s, depth=np.where(np.isfinite(depth), depth, 0), depth_factor=s.color_factor))
    return found
