"""Families of procedural scenes in which loose things lie on a table, drawn anew for every seed."""

import numpy as np

from flowlab.grading.scenes.motions import leave, lift, push, rest, roll, slide, spin
from flowlab.grading.scenes.placing import add, bending, pick, random_look
from flowlab.grading.scenes.things import Solid, Thing, joined, place, random_solid


def tabletop(rng: np.random.Generator, steps: int) -> list[Thing]:
    """Things slid, pushed, turned and lifted; others that rest."""
    things: list[Thing] = []
    for _ in range(rng.integers(1, 6)):
        add(things, rng, steps, pick(rng, (slide, push, spin, lift)), lambda: joined(rng, random_look(rng)))
    for _ in range(rng.integers(0, 3)):
        add(things, rng, steps, rest, lambda: joined(rng, random_look(rng)))
    return things


def clutter(rng: np.random.Generator, steps: int) -> list[Thing]:
    """Many things, some of which leave and come back; sometimes a strip that bends."""
    things: list[Thing] = []
    for motion in (leave, push, lift, slide, spin)[: rng.integers(2, 6)]:
        add(things, rng, steps, motion, lambda: joined(rng, random_look(rng)), spread_m=0.22)
    if rng.random() < 0.5:
        things += bending(rng, steps, things)
    for _ in range(rng.integers(4, 8)):
        add(things, rng, steps, rest, lambda: joined(rng, random_look(rng)), spread_m=0.35)
    return things


def thin(rng: np.random.Generator, steps: int) -> list[Thing]:
    """Rods, boards, and plates that stand on an edge."""

    def rod() -> tuple[Solid, ...]:
        length, thick = rng.uniform(0.06, 0.14), rng.uniform(0.002, 0.006)
        if rng.random() < 0.5:
            return (Solid("box", (length, thick, thick), look=random_look(rng)),)
        if rng.random() < 0.5:
            return (Solid("box", (length, rng.uniform(0.03, 0.06), 0.002), look=random_look(rng)),)
        upright = place(0, 0, 0, angles=(rng.uniform(0.2, 1.2), 0, 0))
        return (Solid("box", (length, rng.uniform(0.03, 0.06), 0.002), upright, random_look(rng)),)

    things: list[Thing] = []
    for _ in range(rng.integers(1, 5)):
        add(things, rng, steps, pick(rng, (slide, push, spin, lift)), rod)
    return things


def plain(rng: np.random.Generator, steps: int) -> list[Thing]:
    """Things of one color, some of them large."""

    def large() -> tuple[Solid, ...]:
        return (random_solid(rng, "plain", low=0.09, high=0.15),)

    things: list[Thing] = []
    for _ in range(rng.integers(1, 4)):
        make = large if rng.random() < 0.3 else lambda: joined(rng, "plain")
        add(things, rng, steps, pick(rng, (slide, push, spin, lift)), make)
    return things


def flat(rng: np.random.Generator, steps: int) -> list[Thing]:
    """Cards and sheets, hardly higher than what they lie on; sometimes a strip that bends."""

    def sheet() -> tuple[Solid, ...]:
        return (Solid("box", (*rng.uniform(0.025, 0.11, 2), rng.uniform(0.0005, 0.002)), look=random_look(rng)),)

    things: list[Thing] = []
    for _ in range(rng.integers(1, 5)):
        add(things, rng, steps, pick(rng, (slide, push, spin, lift, leave)), sheet)
    for _ in range(rng.integers(0, 3)):
        add(things, rng, steps, rest, sheet)
    return things + bending(rng, steps, things) if rng.random() < 0.5 else things


def rolling(rng: np.random.Generator, steps: int) -> list[Thing]:
    """Balls and cylinders that roll, or turn where they stand."""

    def ball() -> tuple[Solid, ...]:
        return (Solid("sphere", (rng.uniform(0.02, 0.06),) * 3, look=random_look(rng)),)

    def lying() -> tuple[Solid, ...]:
        radius, half, on_its_side = rng.uniform(0.015, 0.045), rng.uniform(0.03, 0.09), (np.pi / 2, 0, 0)
        return (Solid("cylinder", (radius, radius, half), place(0, 0, 0, angles=on_its_side), random_look(rng)),)

    def standing() -> tuple[Solid, ...]:
        radius = rng.uniform(0.025, 0.06)
        return (Solid("cylinder", (radius, radius, rng.uniform(0.02, 0.09)), look=random_look(rng)),)

    things: list[Thing] = []
    for _ in range(rng.integers(1, 5)):
        make, motion = (((ball, roll), (lying, roll), (standing, spin), (standing, push)))[int(rng.integers(4))]
        add(things, rng, steps, motion, make)
    for _ in range(rng.integers(0, 3)):
        add(things, rng, steps, rest, lambda: joined(rng, random_look(rng)))
    return things


def swarm(rng: np.random.Generator, steps: int) -> list[Thing]:
    """Many small things, most of which move, each for itself."""

    def small() -> tuple[Solid, ...]:
        return (random_solid(rng, random_look(rng), low=0.012, high=0.03),)

    things: list[Thing] = []
    for _ in range(rng.integers(6, 13)):
        add(things, rng, steps, pick(rng, (slide, push, spin, lift, leave, rest)), small)
    return things


def large(rng: np.random.Generator, steps: int) -> list[Thing]:
    """One or two things that fill much of the picture, and small ones around them."""
    things: list[Thing] = []
    for _ in range(rng.integers(1, 3)):
        motion = pick(rng, (slide, push, spin, lift))
        add(things, rng, steps, motion, lambda: (random_solid(rng, random_look(rng), low=0.1, high=0.18),), 0.15)
    for _ in range(rng.integers(0, 4)):
        add(things, rng, steps, pick(rng, (slide, rest)), lambda: joined(rng, random_look(rng)), spread_m=0.4)
    return things
