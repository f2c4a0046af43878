"""Depth pictures without OpenGL: a z-buffer over the meshes, and ray tests for the primitives."""

from dataclasses import dataclass

import mujoco
import numpy as np

from flowlab.errors import FlowlabError
from flowlab.geometry.camera import Camera
from flowlab.geometry.transforms import inverse
from flowlab.records import Frame
from flowlab.sim.render._primitives import draw_primitives
from flowlab.sim.render._raster import draw_meshes, to_depth
from flowlab.sim.scene import Poses, Scene

_DRAWN_TYPES = {
    mujoco.mjtGeom.mjGEOM_PLANE,
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_MESH,
}


@dataclass(frozen=True, slots=True)
class _Meshes:
    """Triangles of some mesh geoms, packed one mesh after another."""

    vertices: np.ndarray  # (V, 3) in each geom's own frame [m]
    faces: np.ndarray  # (F, 3) into the vertices of the same mesh
    planes: np.ndarray  # (4, F): outward normal n and offset n.v of every face
    span: np.ndarray  # (G, 4) first vertex, number of vertices, first face, number of faces
    boxes: np.ndarray  # (G, 6) center and half size of the bounding box in the geom's own frame [m]
    entity: np.ndarray  # (G,)


@dataclass(frozen=True, slots=True)
class _Primitives:
    entity: np.ndarray  # (P,)
    kind: np.ndarray  # (P,) MuJoCo's geom type
    size: np.ndarray  # (P, 3) MuJoCo's geom size [m]


class ZBuffer:
    """Renders one episode of a scene for one camera; static geometry is drawn once.

    Back faces are culled, as OpenGL does, so that open meshes look alike in both. Fragments nearer than
    the model's near plane are dropped, as OpenGL does.
    """

    def __init__(self, scene: Scene, camera: Camera, first: Poses, packed: "PackedScene | None" = None) -> None:
        self.scene, self.camera = scene, camera
        self._packed = packed or PackedScene(scene)
        self._T_cam_world = inverse(camera.T_world_cam)
        self._nearest = 1.0 / (scene.model.vis.map.znear * scene.model.stat.extent)
        shape = (camera.height, camera.width)
        self._static = np.zeros(shape), np.full(shape, -1, np.int16)
        self._draw(first, self._packed.static_meshes, self._packed.static_primitives, *self._static)

    def frame(self, poses: Poses) -> Frame:
        """Depth and owners with the moving things at the given poses."""
        inverse_depth, owner = self._static[0].copy(), self._static[1].copy()
        self._draw(poses, self._packed.moving_meshes, self._packed.moving_primitives, inverse_depth, owner)
        return Frame(to_depth(inverse_depth), self.camera, owner, self.scene.entities)

    def _draw(
        self, poses: Poses, meshes: _Meshes, primitives: _Primitives, inverse_depth: np.ndarray, owner: np.ndarray
    ) -> None:
        pos = np.concatenate([poses.geom_pos, poses.site_pos])
        mat = np.concatenate([poses.geom_mat, poses.site_mat])
        view = self.camera.K, self._T_cam_world, self._nearest, inverse_depth, owner
        draw_primitives(primitives.entity, primitives.kind, primitives.size, pos, mat, *view)
        draw_meshes(
            meshes.vertices,
            meshes.faces,
            meshes.planes,
            meshes.span,
            meshes.boxes,
            meshes.entity,
            pos,
            mat,
            *view,
        )


class PackedScene:
    """The drawn geometry of a model in flat arrays; it does not depend on poses and serves every episode."""

    def __init__(self, scene: Scene) -> None:
        m = scene.model
        for g in scene.geoms:
            if m.geom_type[g] not in _DRAWN_TYPES:
                raise FlowlabError(
                    f"the z-buffer cannot draw geom '{scene.entities[g].geom}' of type "
                    f"{mujoco.mjtGeom(m.geom_type[g]).name}; use --renderer gl"
                )
        drawn = [*scene.geoms, *(m.ngeom + s for s in scene.sites)]
        is_mesh = {i for i in scene.geoms if m.geom_type[i] == mujoco.mjtGeom.mjGEOM_MESH}
        static = {i for i in drawn if scene.is_static(i)}
        self.static_meshes = _pack_meshes(m, [i for i in drawn if i in is_mesh and i in static])
        self.moving_meshes = _pack_meshes(m, [i for i in drawn if i in is_mesh and i not in static])
        self.static_primitives = _pack_primitives(m, [i for i in drawn if i not in is_mesh and i in static])
        self.moving_primitives = _pack_primitives(m, [i for i in drawn if i not in is_mesh and i not in static])


def _pack_meshes(m: mujoco.MjModel, geoms: list[int]) -> _Meshes:
    vertices, faces, planes, span = [np.empty((0, 3))], [np.empty((0, 3), np.int32)], [np.empty((0, 4))], []
    first_vertex = first_face = 0
    for g in geoms:
        mesh = m.mesh(m.geom_dataid[g])
        v = m.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]].astype(float)
        f = m.mesh_face[mesh.faceadr[0] : mesh.faceadr[0] + mesh.facenum[0]]
        normal = np.cross(v[f[:, 1]] - v[f[:, 0]], v[f[:, 2]] - v[f[:, 0]])
        vertices.append(v)
        faces.append(f)
        planes.append(np.concatenate([normal, (normal * v[f[:, 0]]).sum(1, keepdims=True)], 1))
        span.append((first_vertex, len(v), first_face, len(f)))
        first_vertex, first_face = first_vertex + len(v), first_face + len(f)
    return _Meshes(
        np.concatenate(vertices),
        np.concatenate(faces),
        np.ascontiguousarray(np.concatenate(planes).T),
        np.array(span, np.int64).reshape(-1, 4),
        m.geom_aabb[geoms].reshape(-1, 6),
        np.array(geoms, np.int64),
    )


def _pack_primitives(m: mujoco.MjModel, entities: list[int]) -> _Primitives:
    kind = [m.geom_type[i] if i < m.ngeom else m.site_type[i - m.ngeom] for i in entities]
    size = [m.geom_size[i] if i < m.ngeom else m.site_size[i - m.ngeom] for i in entities]
    return _Primitives(
        np.array(entities, np.int64), np.array(kind, np.int64), np.array(size, np.float64).reshape(-1, 3)
    )
