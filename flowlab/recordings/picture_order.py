"""Whether pictures are in the order in which they were taken: one that moves looks like the one before it."""

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np
from jaxtyping import Float32, Float64, Int64

from flowlab.recordings.content import PictureDigest
from flowlab.recordings.verdicts import Check, Verdict

ABOUT = "order of pictures"
_COMPONENTS, _PIXELS = 8, 1024
"""Pictures are told apart by so many components that vary most, of so many pixels at most: noise is spread over all."""
_NEAR = 0.2
"""Logarithm of depth that counts as no more: what comes or goes."""
_FEWEST = 30
_SMOOTHER = (0.8, 0.7)
"""In the order of their numbers pictures follow one another by less than this share of what they do as they are: then
their names were sorted as text, which is doubtful and refused. (Of 350 films in their order the least is 0.95.)"""
_JUMP, _JUMPS = 2.0, 4
"""And so many fewer steps are so many times as long as they are then in the mean: a flash makes two."""
_FIRST, _STEP = (0, 1), (1, 2, 3, 5, 10)
"""What numbers may begin with, and rise by."""
_ALIKE, _APART = 0.8, 2.5
"""In no order are pictures where those any number of rows apart differ by this share of what any two do, at least, and
one row apart by so many times what each does from the two most like it: of color and of depth, since a lamp that
flickers changes color, too. That is doubtful, for a camera that trembles before a still scene does the same."""
_ROWS = 500
"""So many rows tell that."""
_NOTHING = 1e-6
"""Pictures that differ by less from row to row are one."""


def check_order(color: Sequence[PictureDigest], depth: Sequence[PictureDigest]) -> Check:
    """Whether pictures are in the order in which they were taken.

    Args:
        color: What is kept of the color picture of every row.
        depth: Likewise of depth.
    """
    if len(color) < _FEWEST:
        return Check(ABOUT, Verdict.ASSUMED, f"{len(color)} rows are too few to tell it, so it is taken as it is")
    gray, counts = (np.stack([d.small for d in kept]).astype(np.float32) for kept in (color, depth))
    seen = {"color": _components(gray), "depth": _components(_log_depth(counts))}
    moving = {name: pictures for name, pictures in seen.items() if _steps(pictures).mean() > _NOTHING}
    if not moving:
        return Check(ABOUT, Verdict.ASSUMED, "nothing moves that would tell it, so it is taken as it is")
    faults = [fault for name, pictures in moving.items() for fault in _as_text(name, pictures)]
    if not faults and all(_is_in_none(pictures) for pictures in seen.values()):
        says = (
            "the pictures seem to be in no order: the next is no more like one than any other, and some are much more"
        )
        faults = [(Verdict.DOUBTFUL, says)]
    if not faults:
        return Check(ABOUT, Verdict.OK, "they are not as numbers sorted as text would have them, nor in none at all")
    return Check(
        ABOUT,
        max((verdict for verdict, _ in faults), key=lambda v: v.severity),
        f"{'; '.join(says for _, says in faults)}; name the files such that they sort in the order of their times",
    )


def _as_text(name: str, pictures: Float64[np.ndarray, "T C"]) -> Iterator[tuple[Verdict, str]]:
    """Whether the numbers of pictures were sorted as text."""
    as_it_is = _steps(pictures)
    orders = {(first, step): _by_number(len(pictures), first, step) for first, step in product(_FIRST, _STEP)}
    (first, step), sorted_steps = min(
        ((numbers, _steps(pictures[order])) for numbers, order in orders.items()), key=lambda x: float(x[1].sum())
    )
    share = float(sorted_steps.sum() / as_it_is.sum())
    jump = _JUMP * sorted_steps.mean()
    if share < _SMOOTHER[0] and (as_it_is > jump).sum() - (sorted_steps > jump).sum() >= _JUMPS:
        some = ", ".join(sorted(str(first + step * k) for k in range(len(pictures)))[:4])
        verdict = Verdict.REFUSED if share < _SMOOTHER[1] else Verdict.DOUBTFUL
        yield verdict, (f"{name}: the pictures seem to be sorted by their numbers as text ({some}, ...): sorted as "
                        f"numbers, each differs by {share:.2f} of that from the one before it")  # fmt: skip


def _is_in_none(pictures: Float64[np.ndarray, "T C"]) -> bool:
    """Whether pictures are in no order at all."""
    some = pictures[:_ROWS]
    squares = (some**2).sum(1)
    apart = np.sqrt(np.maximum(squares[:, None] + squares - 2 * some @ some.T, 0))
    any_two = float(apart.sum()) / (len(some) * (len(some) - 1))
    by_lag = [float(np.diagonal(apart, k).mean()) for k in range(1, len(some) // 2 + 1)]
    np.fill_diagonal(apart, np.inf)
    nearest = float(np.partition(apart, 1, axis=1)[:, :2].mean())
    return min(by_lag) > _ALIKE * any_two and by_lag[0] > _APART * nearest > 0


def _components(pictures: Float32[np.ndarray, "T h w"]) -> Float64[np.ndarray, "T C"]:
    """How pictures differ from their mean, by what varies most."""
    flat = pictures.reshape(len(pictures), -1)
    flat = flat[:, :: -(-flat.shape[1] // _PIXELS)].astype(np.float64)
    flat -= flat.mean(0)
    return flat @ np.linalg.eigh(flat.T @ flat)[1][:, -_COMPONENTS:]


def _log_depth(counts: Float32[np.ndarray, "T h w"]) -> Float32[np.ndarray, "T h w"]:
    """How far from where each pixel mostly is; 0 where there is no reading."""
    read = np.isfinite(counts) & (counts > 0)
    known = np.where(read, counts, np.nan)
    middle = np.nanmedian(np.where(read.any(0), known, 1), axis=0)
    return np.where(read, np.log(np.where(read, counts, 1) / middle), 0).clip(-_NEAR, _NEAR).astype(np.float32)


def _steps(path: Float64[np.ndarray, "T C"]) -> Float64[np.ndarray, "N"]:
    """How far it is from each to the next."""
    return np.asarray(np.linalg.norm(np.diff(path, axis=0), axis=1))


def _by_number(count: int, first: int, step: int) -> Int64[np.ndarray, "T"]:
    """Where each of so many pictures is once their numbers were sorted as text."""
    return np.argsort(sorted(range(count), key=lambda k: str(first + step * k)))
