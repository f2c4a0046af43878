"""What procedural scenes are made of: solids with textures, joined into rigid things that move."""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from flowlab.geometry.transforms import rigid
from flowlab.grading.scenes.motions import Path
from flowlab.grading.scenes.textures import Look
from flowlab.records import Role

Shape = Literal["box", "sphere", "ellipsoid", "cylinder", "capsule"]


@dataclass(frozen=True, slots=True)
class Solid:
    """A simple shape, fixed to a thing."""

    shape: Shape
    size: tuple[float, float, float]
    """Half its extent along its own axes [m]; a cylinder's and a capsule's axis is z."""
    at: Float[np.ndarray, "4 4"] = field(default_factory=lambda: np.eye(4))
    """Its pose in the thing."""
    look: Look = "textured"

    @property
    def reach(self) -> float:
        """How far it extends from the thing's own center [m]."""
        return float(np.linalg.norm(self.at[:3, 3]) + np.linalg.norm(self.size))


@dataclass(frozen=True, slots=True)
class Thing:
    """Solids that move as one."""

    name: str
    solids: tuple[Solid, ...]
    path: Path
    """Its pose in every frame: maps its coordinates to the world's [m]."""
    role: Role = Role.OBJECT

    @property
    def reach(self) -> float:
        """Radius of a sphere about its center that holds it [m]."""
        return max(s.reach for s in self.solids)

    def along(self, path: Path) -> "Thing":
        """The same thing on another path."""
        return replace(self, path=path)


def place(x: float, y: float, z: float, *, angles: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """A pose from a place [m] and angles about x, y and z, in this order [rad]."""
    return rigid(Rotation.from_euler("xyz", angles).as_matrix(), np.array([x, y, z], float))


def random_solid(rng: np.random.Generator, look: Look, *, low: float = 0.02, high: float = 0.07) -> Solid:
    """A shape of random kind and size."""
    a, b, c = rng.uniform(low, high, 3)
    shapes: tuple[Shape, ...] = ("box", "box", "sphere", "ellipsoid", "cylinder", "capsule")
    shape = shapes[rng.integers(len(shapes))]
    size = {"sphere": (a, a, a), "cylinder": (a, a, c), "capsule": (a / 2, a / 2, c + a / 2)}.get(shape, (a, b, c))
    return Solid(shape, size, look=look)


def joined(rng: np.random.Generator, look: Look) -> tuple[Solid, ...]:
    """Two or three shapes grown into one another, as most real things are."""
    first = random_solid(rng, look)
    others = [random_solid(rng, look, low=0.015, high=0.04) for _ in range(rng.integers(0, 3))]
    places = [first.size * rng.uniform(-0.9, 0.9, 3) for _ in others]
    moved = [replace(s, at=place(*p, angles=tuple(rng.uniform(-1, 1, 3)))) for s, p in zip(others, places, strict=True)]
    return (first, *moved)


def cup(rng: np.random.Generator, look: Look) -> tuple[Solid, ...]:
    """A cylinder with a handle of three boxes."""
    r, h = rng.uniform(0.03, 0.045), rng.uniform(0.035, 0.06)
    bar = 0.006
    upper, lower = place(r + 0.012, 0, h / 2), place(r + 0.012, 0, -h / 2)
    return (
        Solid("cylinder", (r, r, h), look=look),
        Solid("box", (0.016, bar, bar), upper, look),
        Solid("box", (0.016, bar, bar), lower, look),
        Solid("box", (bar, bar, h / 2), place(r + 0.026, 0, 0), look),
    )


def hand(rng: np.random.Generator) -> tuple[Solid, ...]:
    """A palm with a forearm that reaches back along -y; fingers are things of their own."""
    width = rng.uniform(0.035, 0.045)
    arm = place(0, -0.30, 0.0, angles=(np.pi / 2, 0, 0))
    return (
        Solid("ellipsoid", (width, 0.05, 0.018), look="plain"),
        Solid("capsule", (0.03, 0.03, 0.27), arm, look="plain"),
    )


def finger(length: float) -> tuple[Solid, ...]:
    """A capsule along y that begins at its own origin."""
    return (Solid("capsule", (0.009, 0.009, length / 2), place(0, length / 2, 0, angles=(np.pi / 2, 0, 0)), "plain"),)


def strip(links: int, width: float, look: Look, path: Path, curl: Float[np.ndarray, "T"]) -> list[Thing]:
    """A strip that bends: short boards one after the other, each turned a little against the one before.

    Args:
        links: How many boards.
        width: Half its width [m].
        look: Of its surface.
        path: Pose of its first board, whose x is along the strip.
        curl: Angle from each board to the next [rad], in every frame.

    Returns:
        The boards; each moves rigidly, so that tracks of its points are exact.
    """
    length, things = 0.024, []
    end = path
    for k in range(links):
        middle = end @ place(length / 2, 0, 0)
        things.append(Thing(f"strip {k}", (Solid("box", (length / 2, width, 0.002), look=look),), middle))
        bend = np.stack([place(length, 0, 0, angles=(0, -float(a), 0)) for a in curl])
        end = end @ bend
    return things
