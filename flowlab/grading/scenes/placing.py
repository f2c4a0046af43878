"""Where things of a procedural scene are put, so that none passes through another."""

from collections.abc import Callable, Sequence

import numpy as np

from flowlab.grading.scenes.motions import Motion, progress, still
from flowlab.grading.scenes.textures import Look
from flowlab.grading.scenes.things import Solid, Thing, place, strip

PATTERNED: tuple[Look, ...] = ("textured", "textured", "striped", "mirrored", "plain")
_TRIES = 60


def is_free(things: Sequence[Thing], candidate: Thing) -> bool:
    """Whether a thing never comes so near another that they could pass through each other."""
    for other in things:
        apart = np.linalg.norm(candidate.path[:, :3, 3] - other.path[:, :3, 3], axis=-1)
        if apart.min() < candidate.reach + other.reach:
            return False
    return True


def add(
    things: list[Thing],
    rng: np.random.Generator,
    steps: int,
    motion: Motion,
    make: Callable[[], tuple[Solid, ...]],
    spread_m: float = 0.28,
) -> None:
    """Put a thing on the table where it and its motion have room; where there is none, it is left out."""
    for _ in range(_TRIES):
        solids = make()
        x, y = rng.uniform(-spread_m, spread_m, 2)
        height = max(_height(s) for s in solids)
        start = place(x, y, height, angles=(0, 0, rng.uniform(-np.pi, np.pi)))
        thing = Thing(f"thing {len(things)}", solids, motion(still(start, steps), rng))
        if is_free(things, thing):
            things.append(thing)
            return


def _height(solid: Solid) -> float:
    """How high the thing's center must lie for the solid to rest on the table [m]."""
    corners = np.array(np.meshgrid(*[(-s, s) for s in solid.size])).reshape(3, -1)
    return float(-(solid.at[:3, :3] @ corners)[2].min() - solid.at[2, 3])


def random_look(rng: np.random.Generator) -> Look:
    """Of a thing."""
    return PATTERNED[int(rng.integers(len(PATTERNED)))]


def pick(rng: np.random.Generator, motions: Sequence[Motion]) -> Motion:
    """One of some motions."""
    return motions[int(rng.integers(len(motions)))]


def bending(rng: np.random.Generator, steps: int, things: Sequence[Thing]) -> list[Thing]:
    """A strip that somebody lifts at one end, where there is room for it."""
    for _ in range(_TRIES):
        x, y = rng.uniform(-0.25, 0.25, 2)
        start = place(x, y, 0.005, angles=(0, 0, rng.uniform(-np.pi, np.pi)))
        curl = rng.uniform(0.1, 0.3) * progress(steps, 0.2, 0.5) - rng.uniform(0, 0.2) * progress(steps, 0.6, 0.9)
        boards = strip(int(rng.integers(5, 9)), rng.uniform(0.02, 0.05), random_look(rng), still(start, steps), curl)
        if all(is_free(things, board) for board in boards):
            return boards
    return []
