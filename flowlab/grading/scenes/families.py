"""Families of procedural scenes: what stands, moves, hides and bends in each, drawn anew for every seed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from flowlab.errors import UsageError
from flowlab.grading.scenes.loose_things import clutter, flat, large, plain, rolling, swarm, tabletop, thin
from flowlab.grading.scenes.motions import Path, carried, lift, progress, rest, shifted, slide, spin, still, turned
from flowlab.grading.scenes.placing import PATTERNED, add, bending, is_free, pick, random_look
from flowlab.grading.scenes.textures import Look
from flowlab.grading.scenes.things import Solid, Thing, cup, finger, hand, joined, place
from flowlab.records import Role

FIRST_REPORTED_SEED = 1000
"""Seeds below are for making trackers and calibrating what they state, seeds from here on for reporting."""


@dataclass(frozen=True, slots=True)
class Family:
    """A kind of scene."""

    name: str
    holds: str
    """What is in it, in words."""
    make: Callable[[np.random.Generator, int], list[Thing]]
    """Its things, of so many frames."""
    held_out: bool = False
    """Whether it is never used for making or calibrating a tracker, so that it tells what becomes of unknown scenes."""
    looks: tuple[Look, ...] = PATTERNED
    """Of table and walls."""


def _hands(rng: np.random.Generator, steps: int) -> list[Thing]:
    things: list[Thing] = []
    for _ in range(rng.integers(2, 5)):
        add(things, rng, steps, rest, lambda: joined(rng, random_look(rng)), spread_m=0.25)
    if not things:
        return things
    palm, fingers, held = _grasp(rng, steps, things[0])
    return [held, *things[1:], palm, *fingers]


def _grasp(rng: np.random.Generator, steps: int, thing: Thing) -> tuple[Thing, list[Thing], Thing]:
    """A hand that comes, closes over a thing, carries it, sets it down, and leaves."""
    begin, end = int(0.3 * steps), int(0.8 * steps)
    at = thing.path[0, :3, 3]
    heading = rng.uniform(-0.6, 0.6)
    grasping = place(at[0], at[1], at[2] + thing.reach * 0.5 + 0.02, angles=(rng.uniform(-0.7, -0.3), 0, heading))
    back = np.array([np.sin(heading), -np.cos(heading), 0.6])
    come, go = 1 - progress(steps, 0.02, 0.28), progress(steps, 0.82, 0.99)
    over = progress(steps, 0.33, 0.78)
    raised = rng.uniform(0.04, 0.15) * np.sin(np.pi * over)
    way = rng.uniform(-0.15, 0.15, 2)
    offset = 0.5 * (come + go)[:, None] * back + np.stack([over * way[0], over * way[1], raised], -1)
    path = turned(shifted(still(grasping, steps), offset), np.array([0, 0, 1.0]), rng.uniform(-0.8, 0.8) * over)
    palm = Thing("palm", hand(rng), path, Role.ROBOT)
    closing = progress(steps, 0.24, 0.3) - progress(steps, 0.8, 0.86)
    fingers = []
    for k, side in enumerate((-0.03, -0.01, 0.01, 0.03)):
        bend = np.stack([place(side, 0.045, 0, angles=(-0.3 - 0.9 * float(c), 0, 0)) for c in closing])
        fingers.append(Thing(f"finger {k}", finger(rng.uniform(0.06, 0.08)), path @ bend, Role.ROBOT))
    return palm, fingers, thing.along(carried(thing.path, path, begin, end))


def _kitchen(rng: np.random.Generator, steps: int) -> list[Thing]:
    things: list[Thing] = []
    add(things, rng, steps, _pour, lambda: cup(rng, random_look(rng)))
    for _ in range(rng.integers(1, 4)):
        add(things, rng, steps, pick(rng, (rest, slide, lift)), lambda: cup(rng, random_look(rng)))
    things += bending(rng, steps, things)
    add(things, rng, steps, rest, lambda: (Solid("box", (0.12, 0.1, 0.006), look=random_look(rng)),))
    if rng.random() < 0.5 and things:
        palm, fingers, held = _grasp(rng, steps, things[0].along(still(things[0].path[0], steps)))
        things = [held, *things[1:], palm, *fingers]
    return things


def _pour(path: Path, rng: np.random.Generator) -> Path:
    """Lifted, tilted for a while, and set down again."""
    up = progress(len(path), 0.1, 0.35) - progress(len(path), 0.75, 0.95)
    tilt = progress(len(path), 0.35, 0.5) - progress(len(path), 0.6, 0.75)
    raised = shifted(path, np.stack([0 * up, 0 * up, rng.uniform(0.1, 0.2) * up], -1))
    return turned(raised, np.array([*rng.standard_normal(2), 0]), rng.uniform(0.8, 1.6) * tilt)


def _articulated(rng: np.random.Generator, steps: int) -> list[Thing]:
    """A box with a door or a lid on a hinge, and a drawer on rails; things before them."""
    width, depth, height = rng.uniform(0.1, 0.16), rng.uniform(0.08, 0.12), rng.uniform(0.1, 0.16)
    case = place(rng.uniform(-0.1, 0.1), 0.1, height, angles=(0, 0, rng.uniform(-0.4, 0.4)))
    look, t = random_look(rng), 0.006
    walls = (
        Solid("box", (width, depth, t), place(0, 0, -height + t), look),
        Solid("box", (width, depth, t), place(0, 0, height - t), look),
        Solid("box", (t, depth, height), place(-width + t, 0, 0), look),
        Solid("box", (t, depth, height), place(width - t, 0, 0), look),
        Solid("box", (width, t, height), place(0, depth - t, 0), look),
        Solid("box", (width, depth, t), place(0, 0, 0), look),
    )
    things = [Thing("case", walls, still(case, steps), Role.PROP)]
    things.append(_door(rng, steps, case, width, depth, height))
    things.append(_drawer(rng, steps, case, width, depth, height))
    for _ in range(rng.integers(0, 3)):
        before = [Thing("room", (Solid("box", (width, depth + 0.25, height)),), still(case, steps))]
        add(before, rng, steps, pick(rng, (slide, spin, rest)), lambda: joined(rng, random_look(rng)), spread_m=0.4)
        things += [x for x in before[1:] if is_free(things, x)]
    return things


def _door(rng: np.random.Generator, steps: int, case: Float[np.ndarray, "4 4"], w: float, d: float, h: float) -> Thing:
    """Before the upper half of a case: it turns about its left edge, or, as a flap, about its lower one."""
    shut = case @ place(0, -d - 0.004, h / 2)
    solids = (
        Solid("box", (w, 0.004, h / 2 - 0.004), look=random_look(rng)),
        Solid("box", (0.006, 0.012, 0.03), place(w * 0.75, -0.014, 0), "plain"),
    )
    s = progress(steps, rng.uniform(0.05, 0.3), rng.uniform(0.5, 0.95))
    if rng.random() < 0.6:
        pivot, axis = shut @ np.array([-w, 0, 0, 1]), case[:3, 2]
        return Thing("door", solids, turned(still(shut, steps), axis, -rng.uniform(0.6, 1.7) * s, pivot[:3]))
    pivot, axis = shut @ np.array([0, 0, -h / 2 + 0.004, 1]), case[:3, 0]
    return Thing("flap", solids, turned(still(shut, steps), axis, rng.uniform(0.5, 1.4) * s, pivot[:3]))


def _drawer(
    rng: np.random.Generator, steps: int, case: Float[np.ndarray, "4 4"], w: float, d: float, h: float
) -> Thing:
    """In the lower half of a case: it comes out, and sometimes goes back."""
    look, t = random_look(rng), 0.004
    solids = (
        Solid("box", (w - 0.014, t, h / 2 - 0.012), place(0, -d, 0), look),
        Solid("box", (w - 0.02, d - 0.02, t), place(0, 0, -h / 2 + 0.02), look),
        Solid("box", (0.03, 0.008, 0.006), place(0, -d - 0.012, 0), "plain"),
    )
    s = progress(steps, rng.uniform(0.05, 0.4), rng.uniform(0.5, 0.7))
    if rng.random() < 0.4:
        s = s - progress(steps, 0.75, 0.95)
    out = -case[:3, 1] * rng.uniform(0.06, 0.14)
    return Thing("drawer", solids, shifted(still(case @ place(0, 0, -h / 2), steps), s[:, None] * out))


FAMILIES = MappingProxyType(
    {
        f.name: f
        for f in (
            Family("tabletop", "things slid, pushed, turned and lifted on a table", tabletop),
            Family("hands", "a hand that closes over a thing, carries it and sets it down", _hands),
            Family("clutter", "many things that hide each other, leave and come back; a strip that bends", clutter),
            Family("thin", "rods, boards and plates", thin),
            Family(
                "plain", "things of one color before walls of one color, some of them large", plain, looks=("plain",)
            ),
            Family("flat", "cards and sheets that are slid and lifted; a strip that bends", flat),
            Family("rolling", "balls and cylinders that roll, or turn where they stand", rolling),
            Family("swarm", "many small things that move, each for itself", swarm),
            Family("large", "things that fill much of the picture", large),
            Family("kitchen", "cups that are lifted and poured, a cloth that bends, a hand", _kitchen, held_out=True),
            Family("articulated", "doors, flaps and drawers", _articulated, held_out=True),
        )
    }
)
"""By name. Of those that are held out nothing may be learned, by a seed or by looking."""


def making_films(seeds: Sequence[int]) -> list[tuple[str, int]]:
    """The films that a tracker may be made and calibrated with.

    Args:
        seeds: Of each family.

    Returns:
        Families that are not held out, each with every seed.

    Raises:
        UsageError: A seed is one of those for reporting.
    """
    if reported := [seed for seed in seeds if seed >= FIRST_REPORTED_SEED]:
        raise UsageError(
            f"seed {reported[0]} is for reporting; make and calibrate with seeds below {FIRST_REPORTED_SEED}"
        )
    return [(f.name, seed) for f in FAMILIES.values() if not f.held_out for seed in seeds]
