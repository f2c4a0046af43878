"""Pictures that are not new though they differ from the one before: older ones, parts of them, and new encodings."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int64

from flowlab.recordings.content import PictureDigest, has_noise, is_equal, runs

_JUMP = 2.5
"""A sequence without noise that comes again is told by this many times the usual change where it begins or ends."""
_RUN = 3
"""So many rows are no accident."""
_NOISE = 0.3
"""Where noise changes so many pixels of a tile, no tile comes again by chance."""
_CHANGES = 5
"""A tile has changed so often, or nothing is known of it."""
_PART = (4, 0.1)
"""So many tiles, and this share of those with noise, are no accident."""
_CODED = 0.4
"""Where so many pictures have tiles of earlier ones, it is a video's encoder that leaves out what changes little."""
_QUIET = 0.75
"""Share of the pixels, those that change least, by which noise is measured beside a thing that moves."""
_BELOW = 0.7
"""Pictures that change by less than this share of their film's noise are one, encoded anew."""
_RESTS = 0.8
"""Where the other stream changes by less than this share of what it does, it is the camera or the scene that rests."""
_EVEN = 1.5
"""Noise changes pictures by about the same from one to the next."""


def older_pictures(kept: Sequence[PictureDigest], noisy: bool, change: Float64[np.ndarray, "N"]) -> dict[int, int]:
    """Rows that show a picture of long before, with others between, and the first row that showed it.

    Where pictures have noise none comes again by itself. Without noise a motion may come back to where it was; a
    sequence that does is played again where the pictures jump at its start or its end.
    """
    first: dict[int, int] = {}
    older: dict[int, int] = {}
    for row, picture in enumerate(kept):
        start = first.setdefault(picture.checksum, row)
        between = (kept[k].checksum != picture.checksum for k in range(start + 1, row))
        if is_equal(kept[start], picture) and any(between):
            older[row] = start
    return older if noisy else dict(_played_again(older, change))


def _played_again(older: dict[int, int], change: Float64[np.ndarray, "N"]) -> Iterator[tuple[int, int]]:
    """Those of sequences that come again as a whole, after a jump or before one."""
    usual = float(np.median(change[change > 0])) if (change > 0).any() else np.inf
    rows = [row for row in older if older.get(row - 1) != older[row] - 1]
    for start in rows:
        stop = start
        while older.get(stop) == older[start] + stop - start:
            stop += 1
        beside = [change[start - 1], *change[stop - 1 : stop]]
        if stop - start >= _RUN and max(beside) > _JUMP * usual:
            yield from ((row, older[row]) for row in range(start, stop))


def repeated_parts(kept: Sequence[PictureDigest], skip: Bool[np.ndarray, "T"]) -> dict[int, float]:
    """Rows of which a part is that of an earlier picture bit by bit, though it has noise, and the share of that part.

    Args:
        kept: Of a film whose pictures have noise.
        skip: Rows whose whole picture is an earlier one.
    """
    if len({k.small.shape for k in kept}) != 1 or len({len(k.tiles) for k in kept}) != 1:
        return {}
    tiles = np.array([k.tiles for k in kept])
    telling = _tiles_with_noise(kept, tiles)
    if telling.sum() < _PART[0]:
        return {}
    again = np.stack([_seen_before(column) for column in tiles[:, telling].T], 1)
    count = np.where(skip, 0, again.sum(1))
    if (count[~skip] > 0).mean() > _CODED:
        return {}
    rows = np.flatnonzero((count >= _PART[0]) & (count >= _PART[1] * telling.sum()))
    return {int(row): float(again[row].mean()) for row in rows} if len(rows) >= _RUN else {}


def _quiet_change(kept: Sequence[PictureDigest]) -> Float64[np.ndarray, "N"] | None:
    """By how much the quieter part of each picture differs from the one before; None of pictures of several sizes."""
    if len({k.small.shape for k in kept}) != 1:
        return None
    small = np.array([k.small for k in kept], np.float32)
    change = np.sort(np.abs(np.diff(small, axis=0)).reshape(len(small) - 1, -1), axis=1)
    return np.asarray(change[:, : max(1, int(_QUIET * change.shape[1]))].mean(1), np.float64)


def _tiles_with_noise(kept: Sequence[PictureDigest], tiles: Int64[np.ndarray, "T K"]) -> Bool[np.ndarray, "K"]:
    """Which tiles change in many of their pixels wherever they change at all."""
    differ = np.diff(np.array([k.small for k in kept]), axis=0) != 0
    side = int(np.sqrt(tiles.shape[1]))
    share = np.stack(
        [t.mean((1, 2)) for rows in np.array_split(differ, side, 1) for t in np.array_split(rows, side, 2)]
    )
    new = ((tiles[1:] != tiles[:-1]) & (tiles[1:] != 0) & (tiles[:-1] != 0)).T
    often = [n.sum() >= _CHANGES and np.median(d[n]) >= _NOISE for d, n in zip(share, new, strict=True)]
    return np.array(often, bool)


def _seen_before(column: Int64[np.ndarray, "T"]) -> Bool[np.ndarray, "T"]:
    """Whether each has come earlier; never what is nothing."""
    _, first, which = np.unique(column, return_index=True, return_inverse=True)
    seen: np.ndarray = (first[which] < np.arange(len(column))) & (column != 0)
    return seen


def encoded_anew(kept: Sequence[PictureDigest], other: Sequence[PictureDigest]) -> list[tuple[int, int]]:
    """First and last row of runs that change by far less than the noise of the others, as of one encoded again.

    Args:
        kept: Of a stream.
        other: Of the other stream in the same rows: where that rests too, it is the scene that does.
    """
    quiet = _quiet_change(kept)
    if quiet is None:
        return []
    small = np.array([k.small for k in kept], np.float32)
    low = quiet < _BELOW * np.median(quiet)
    beside = _quiet_change(other)
    if beside is not None:
        low &= beside >= _RESTS * np.median(beside)
    found = [(a, b) for a, b in runs(low) if b - a >= _RUN]
    others = np.concatenate([[True], ~low])
    if not found or not has_noise(small[others]):
        return []
    floor, most = np.quantile(quiet[~low], (0.05, 0.9))
    if most > _EVEN * floor:  # it is motion that changes them, which may stop
        return []
    return [(a, b) for a, b in found if quiet[a:b].max() < _BELOW * floor]
