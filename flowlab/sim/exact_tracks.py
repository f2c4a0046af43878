"""Where query points go: the rigid motion of whatever owns them, and whether the camera still sees them."""

from typing import Literal

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.spatial import cKDTree

from flowlab.config import Settings
from flowlab.geometry.camera import Camera
from flowlab.geometry.transforms import apply, inverse
from flowlab.records import Queries, Tracks3D
from flowlab.sim.recorder import Rollout
from flowlab.sim.scene import Poses, Scene

DEPTH_TOLERANCE_PX = 2.0
"""How far behind the depth picture a point may lie and still be the surface it shows, in pixel widths at
its distance (z / f): a pixel's depth is that of its center, and a slanted surface recedes within it. Of
the tolerances tried against ``mj_ray``, 2 agrees best (94 % of points and frames, 128x128, 8 tasks)."""


class RigidFlowSettings(Settings):
    """Which surface point stands for a query."""

    association: Literal["exact", "nearest-vertex", "nearest-vertex-any"] = "exact"
    """``exact``: the point itself, fixed to the body it lies on. ``nearest-vertex``: the nearest vertex of
    that thing's mesh (the paper's words). ``nearest-vertex-any``: the nearest over all drawn meshes, what
    one gets without knowing the owner; it picks the wrong body for about 5 points in 100."""


def rigid_tracks(
    rollout: Rollout, queries: Queries, settings: RigidFlowSettings
) -> tuple[Float32[np.ndarray, "T M 3"], Float32[np.ndarray, "M"]]:
    """Positions of the followed points in the dataset's world, and their distance from the queries [m].

    Source of ``exact``: a rigid body carries its surface points along, ``p(t) = T_body(t) T_body(0)^-1 p``;
    its only error is the float32 of storage.
    """
    T_sim_world = inverse(rollout.T_world_sim)
    anchor = query = apply(T_sim_world, queries.xyz_world.astype(np.float64))
    entity = queries.owner.astype(np.int64)
    if settings.association != "exact":
        any_owner = settings.association == "nearest-vertex-any"
        anchor, entity = _nearest_vertices(rollout.scene, rollout.poses.at(0), query, entity, any_owner)
    body = rollout.scene.body_of[entity]
    R = rollout.poses.body_mat[:, body].reshape(len(rollout.action), -1, 3, 3)
    position = rollout.poses.body_pos[:, body]
    local = np.einsum("mji,mj->mi", R[0], anchor - position[0])
    xyz_sim = np.einsum("tmij,mj->tmi", R, local) + position
    distance = np.linalg.norm(anchor - query, axis=1)
    return apply(rollout.T_world_sim, xyz_sim).astype(np.float32), distance.astype(np.float32)


def visibility(
    xyz_world: Float[np.ndarray, "T M 3"],
    thing: Int[np.ndarray, "M"],
    thing_of: Int[np.ndarray, "E"],
    camera: Camera,
    depth: Float32[np.ndarray, "T H W"],
    owner: Int[np.ndarray, "T H W"],
) -> Bool[np.ndarray, "T M"]:
    """Whether the depth picture shows the points.

    A point is visible where one of the four pixels around it shows the same thing, and the point is not
    farther behind than ``DEPTH_TOLERANCE_PX``. ``thing_of`` maps owners to things that move as one.
    """
    uv, z = camera.project(xyz_world)
    tolerance = DEPTH_TOLERANCE_PX * z / camera.K[0, 0]
    visible = np.zeros(z.shape, bool)
    with np.errstate(invalid="ignore"):
        corner = np.floor(np.where(np.isfinite(uv), uv, -2.0)).clip(-2, max(camera.width, camera.height)).astype(int)
    t = np.arange(len(z))[:, None]
    for du, dv in np.ndindex(2, 2):
        u, v = corner[..., 0] + du, corner[..., 1] + dv
        inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height) & (z > 0)
        u, v = u.clip(0, camera.width - 1), v.clip(0, camera.height - 1)
        shown = owner[t, v, u]
        same = (shown >= 0) & (thing_of[shown] == thing)
        visible |= inside & same & (z <= depth[t, v, u] + tolerance)
    return visible


def label(
    rollout: Rollout,
    queries: Queries,
    depth: Float32[np.ndarray, "T H W"],
    owner: Int[np.ndarray, "T H W"],
    settings: RigidFlowSettings,
) -> Tracks3D:
    """Tracks of the queries through the rollout, with visibility."""
    xyz_world, distance = rigid_tracks(rollout, queries, settings)
    thing_of = rollout.scene.model.body_weldid[rollout.scene.body_of]
    visible = visibility(xyz_world, thing_of[queries.owner], thing_of, rollout.camera, depth, owner)
    return Tracks3D(xyz_world, visible, distance)


def _nearest_vertices(
    scene: Scene, first: Poses, query: np.ndarray, entity: np.ndarray, any_owner: bool
) -> tuple[np.ndarray, np.ndarray]:
    """The nearest mesh vertex of each query (M, 3) in MuJoCo's world, and the entity it belongs to (M,)."""
    drawn = [*scene.geoms, *(scene.model.ngeom + s for s in scene.sites)]
    meshes = {e: v for e in drawn if len(v := _vertices(scene, first, e))}
    anchor, owner = query.copy(), entity.copy()
    if any_owner:
        owners = np.concatenate([np.full(len(v), e) for e, v in meshes.items()])
        vertices = np.concatenate(list(meshes.values()))
        _, nearest = cKDTree(vertices).query(query)
        return vertices[nearest], owners[nearest]
    for e in np.unique(entity):
        if e in meshes:  # planes have no vertices: their points stay where they are
            mine = entity == e
            _, nearest = cKDTree(meshes[e]).query(query[mine])
            anchor[mine] = meshes[e][nearest]
    return anchor, owner


def _vertices(scene: Scene, poses: Poses, entity: int) -> np.ndarray:
    """Mesh vertices (V, 3) of a geom or site in MuJoCo's world; primitives as trimesh makes them."""
    import trimesh  # here, because only the nearest-vertex variants need its 23 MB

    m = scene.model
    if entity < m.ngeom:
        kind, size = m.geom_type[entity], m.geom_size[entity]
        pos, mat = poses.geom_pos[entity], poses.geom_mat[entity]
    else:
        s = entity - m.ngeom
        kind, size, pos, mat = m.site_type[s], m.site_size[s], poses.site_pos[s], poses.site_mat[s]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = m.mesh(m.geom_dataid[entity])
        local = m.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        local = trimesh.creation.box(extents=2 * size).vertices
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        local = trimesh.creation.cylinder(radius=size[0], height=2 * size[1]).vertices
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        local = trimesh.creation.capsule(radius=size[0], height=2 * size[1]).vertices
    elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        local = trimesh.creation.icosphere(radius=size[0]).vertices
    else:
        return np.empty((0, 3))
    return np.asarray(local, np.float64) @ mat.reshape(3, 3).T + pos
