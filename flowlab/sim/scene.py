"""What a MuJoCo model shows: which geoms and sites are drawn, whose they are, and where they are."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from flowlab.records import Entity, Role

_BACKGROUND_BODIES = {"world", "tablelink", "RetainingWall"}
"""Bodies of floor, table and wall, in all 50 tasks (the slabs of pick-out-of-hole belong to the world)."""
ROBOT_ROOTS = frozenset({"base", "mocap"})
"""Bodies that a robot hangs from, in all 50 tasks."""
_VISIBLE_GROUPS = 3
"""MuJoCo draws groups 0-2 by default; collision shapes are in group 4."""


@dataclass(frozen=True, slots=True)
class Poses:
    """World poses of everything in a model: at one instant, or at T of them along the first axis."""

    geom_pos: Float[np.ndarray, "*T G 3"]
    geom_mat: Float[np.ndarray, "*T G 9"]
    site_pos: Float[np.ndarray, "*T S 3"]
    site_mat: Float[np.ndarray, "*T S 9"]
    body_pos: Float[np.ndarray, "*T B 3"]
    body_mat: Float[np.ndarray, "*T B 9"]
    cam_pos: Float[np.ndarray, "*T C 3"]
    cam_mat: Float[np.ndarray, "*T C 9"]

    @classmethod
    def of(cls, data: mujoco.MjData) -> "Poses":
        """A copy of the poses MuJoCo holds now; positions [m], rotation matrices row by row."""
        return cls(
            data.geom_xpos.copy(),
            data.geom_xmat.copy(),
            data.site_xpos.copy(),
            data.site_xmat.copy(),
            data.xpos.copy(),
            data.xmat.copy(),
            data.cam_xpos.copy(),
            data.cam_xmat.copy(),
        )

    @classmethod
    def stack(cls, instants: list["Poses"]) -> "Poses":
        """The poses of T instants along a new first axis."""
        return cls(*(np.stack([getattr(p, name) for p in instants]) for name in cls.__slots__))

    def at(self, t: int) -> "Poses":
        """The poses of one instant."""
        return Poses(*(getattr(self, name)[t] for name in self.__slots__))


class Scene:
    """The drawn things of a model, under one numbering: geoms first, then sites.

    The number of a thing is its index in :attr:`entities`, and what a frame stores as a pixel's owner.
    Geoms of ``hidden_bodies`` are moved to a group of the model that no renderer draws.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        markers: bool = True,
        hidden_bodies: frozenset[str] = frozenset(),
        robot_roots: frozenset[str] = ROBOT_ROOTS,
    ) -> None:
        self.model = model
        self.markers = markers
        bodies = [_root_chain(model, b) for b in range(model.nbody)]
        robot = {b for b, chain in enumerate(bodies) if model.body(chain[-1]).name in robot_roots}
        self.movable = {int(b) for b in np.flatnonzero(model.body_weldid) if b not in robot}
        """Bodies that can move and are not the robot."""
        hidden = [b for b in range(model.nbody) if model.body(b).name in hidden_bodies]
        model.geom_group[np.isin(model.geom_bodyid, hidden)] = _VISIBLE_GROUPS
        self.geoms = tuple(g for g in range(model.ngeom) if self._draws_geom(g))
        self.sites = tuple(s for s in range(model.nsite) if self._draws_site(s))
        self.entities = tuple(self._entity(bodies, robot, i) for i in range(model.ngeom + model.nsite))
        self.body_of = np.concatenate([model.geom_bodyid, model.site_bodyid]).astype(np.int64)
        """Body index of every entity."""

    def is_static(self, entity: int) -> bool:
        """Whether the thing is welded to the world, so that it stays put during an episode."""
        return bool(self.model.body_weldid[self.body_of[entity]] == 0)

    def _draws_geom(self, g: int) -> bool:
        m = self.model
        alpha = m.mat_rgba[m.geom_matid[g], 3] if m.geom_matid[g] >= 0 else m.geom_rgba[g, 3]
        return bool(m.geom_group[g] < _VISIBLE_GROUPS and alpha > 0)

    def _draws_site(self, s: int) -> bool:
        m = self.model
        alpha = m.mat_rgba[m.site_matid[s], 3] if m.site_matid[s] >= 0 else m.site_rgba[s, 3]
        return bool(self.markers and m.site_group[s] < _VISIBLE_GROUPS and alpha > 0)

    def _entity(self, bodies: list[list[int]], robot: set[int], i: int) -> Entity:
        m = self.model
        is_geom = i < m.ngeom
        thing = m.geom(i) if is_geom else m.site(i - m.ngeom)
        body = int((m.geom_bodyid if is_geom else m.site_bodyid)[i if is_geom else i - m.ngeom])
        if body in robot:
            role = Role.ROBOT
        elif body in self.movable:
            role = Role.OBJECT
        elif not is_geom:
            role = Role.MARKER
        elif m.body(body).name in _BACKGROUND_BODIES:
            role = Role.BACKGROUND
        else:
            role = Role.PROP
        # Many MetaWorld bodies are nameless; the nearest named ancestor tells a reader most.
        named = next((m.body(b).name for b in bodies[body] if m.body(b).name), str(body))
        return Entity(thing.name or f"{'geom' if is_geom else 'site'} {thing.id}", named, role)


def _root_chain(model: mujoco.MjModel, body: int) -> list[int]:
    """The body and its ancestors up to, and without, the world (unless it is the world)."""
    chain = [body]
    while model.body_parentid[chain[-1]] != 0:
        chain.append(int(model.body_parentid[chain[-1]]))
    return chain
