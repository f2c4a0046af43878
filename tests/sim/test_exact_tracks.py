"""Exact tracks against MetaWorld replayed on its own, against later depth pictures, and against rays."""

import copy
import functools
from dataclasses import dataclass
from typing import Any, cast

import metaworld
import mujoco
import numpy as np
import pytest

from flowlab.demonstrations import ObservedDemo, QueriedDemo
from flowlab.geometry.camera import Camera
from flowlab.pipeline.recipe import load_recipe
from flowlab.pipeline.stage import EpisodeRequest
from flowlab.records import Episode, Role
from flowlab.sim.exact_tracks import RigidFlowSettings, rigid_tracks, visibility
from flowlab.sim.recorder import Rollout

DRAWN_GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)


@dataclass(frozen=True)
class Labeled:
    """An episode, and what it was made from."""

    rollout: Rollout
    seen: ObservedDemo
    episode: Episode

    @property
    def owner_body(self) -> np.ndarray:
        """MuJoCo's body of every query: owners number geoms first, then sites."""
        m = self.rollout.scene.model
        return np.concatenate([m.geom_bodyid, m.site_bodyid])[self.episode.queries.owner]


@functools.cache
def labeled(task: str) -> Labeled:
    record: Any = EpisodeRequest(task=task, seed=0)
    made: list[Any] = []
    for stage in load_recipe("metaworld").pipeline().stages[:4]:
        record = stage.process(record)
        made.append(record)
    rollout, seen, queried, episode = made
    assert isinstance(queried, QueriedDemo)
    return Labeled(cast(Rollout, rollout), seen, episode)


@dataclass(frozen=True)
class Replay:
    """What MetaWorld says when the actions are executed again; nothing of flowlab is in it."""

    model: mujoco.MjModel
    first: mujoco.MjData
    body_pos: np.ndarray
    body_mat: np.ndarray


@functools.cache
def replay(task: str) -> Replay:
    episode = labeled(task).episode
    env = metaworld.ALL_V3_ENVIRONMENTS[f"{task}-v3"]()
    env._partially_observable, env._set_task_called = False, True
    del env.sawyer_observation_space
    env._last_rand_vec, env._freeze_rand_vec = np.array(episode.extras["rand_vec"]), True
    env.reset()
    first = copy.copy(env.data)
    mujoco.mj_forward(env.model, first)
    pos, mat = [first.xpos.copy()], [first.xmat.copy()]
    for action in episode.action[:-1]:
        env.step(action)
        pos.append(env.data.xpos.copy())
        mat.append(env.data.xmat.copy())
    return Replay(env.model, first, np.array(pos), np.array(mat).reshape(len(pos), -1, 3, 3))


def in_body_frame(task: str, xyz: np.ndarray) -> np.ndarray:
    """Points (T, M, 3) as seen from their own bodies in the replay."""
    again, body = replay(task), labeled(task).owner_body
    offset = xyz.astype(float) - again.body_pos[:, body]
    return np.einsum("tmji,tmj->tmi", again.body_mat[:, body], offset)


def lagged(xyz: np.ndarray, steps: int) -> np.ndarray:
    return np.concatenate([np.repeat(xyz[:1], steps, 0), xyz[:-steps]])


def frozen(xyz: np.ndarray) -> np.ndarray:
    return np.repeat(xyz[:1], len(xyz), 0)


@pytest.mark.parametrize("task", ["hammer", "door-open"])
def test_points_are_fixed_to_their_bodies_in_a_replay_without_flowlab(task: str) -> None:
    xyz = labeled(task).episode.tracks.xyz_world
    local = in_body_frame(task, xyz)
    assert np.abs(local - local[0]).max() < 1e-5
    off_by_one_step = in_body_frame(task, lagged(xyz, 1))
    assert np.abs(off_by_one_step - off_by_one_step[0]).max() > 1e-3, "the comparison has no power"


@pytest.mark.parametrize("task", ["hammer", "door-open", "push"])
def test_tracks_begin_at_the_queries(task: str) -> None:
    episode = labeled(task).episode
    np.testing.assert_allclose(episode.tracks.xyz_world[0], episode.queries.xyz_world, atol=3e-7)
    assert (episode.tracks.association_distance == 0).all()
    assert episode.tracks.visible[0].mean() > 0.95, "what was chosen in the picture is seen in it"


def test_the_tracks_of_a_solved_task_move_with_the_object() -> None:
    episode = labeled("hammer").episode
    moved = np.linalg.norm(episode.tracks.xyz_world[-1] - episode.tracks.xyz_world[0], axis=1)
    assert moved[episode.query_role == Role.OBJECT].max() > 0.1
    assert moved[episode.query_role == Role.ROBOT].max() > 0.1


def in_front_of_depth(labels: Labeled, xyz: np.ndarray) -> np.ndarray:
    """Whether each point (T, M) floats more than 3 mm in front of all nine pixels around it."""
    uv, z = labels.episode.camera.project(xyz.astype(float))
    height, width = labels.seen.depth.shape[1:]
    u, v = np.moveaxis(np.rint(uv).astype(int), -1, 0)
    inside = (u > 0) & (u < width - 1) & (v > 0) & (v < height - 1)
    u, v, t = u.clip(1, width - 2), v.clip(1, height - 2), np.arange(len(z))[:, None]
    around = [labels.seen.depth[t, v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)]
    return inside & (z < np.min(around, axis=0) - 0.003)


@pytest.mark.parametrize(("task", "limit"), [("hammer", 0.0), ("push", 0.0), ("door-open", 5e-4)])
def test_no_point_ever_stands_in_front_of_a_later_depth_picture(task: str, limit: float) -> None:
    """A rigid surface may be hidden, but never hang in the air before what the camera sees.

    The door's two exceptions (of 8500) are on a finger pad seen edge-on, whose depth varies by more than
    3 mm within a pixel.
    """
    labels = labeled(task)
    xyz = labels.episode.tracks.xyz_world
    assert in_front_of_depth(labels, xyz).mean() <= limit
    moving = np.ptp(xyz, axis=0).max(-1) > 0.01
    assert in_front_of_depth(labels, frozen(xyz))[:, moving].mean() > 0.3
    assert in_front_of_depth(labels, lagged(xyz, 3))[:, moving].mean() > 0.1


def rays_reach(labels: Labeled, steps: range) -> np.ndarray:
    """Whether a ray from the camera gets to each point (steps, M) without meeting anything 2 mm before it."""
    m, eye = labels.rollout.scene.model, labels.episode.camera.T_world_cam[:3, 3].copy()
    data, geom = mujoco.MjData(m), np.zeros(1, np.int32)
    reached = []
    for t in steps:
        poses = labels.rollout.poses.at(t)
        data.geom_xpos[:], data.geom_xmat[:] = poses.geom_pos, poses.geom_mat
        for point in labels.episode.tracks.xyz_world[t].astype(float):
            distance = float(np.linalg.norm(point - eye))
            hit = mujoco.mj_ray(m, data, eye, (point - eye) / distance, DRAWN_GROUPS, 1, -1, geom)
            reached.append(hit < 0 or hit > distance - 0.002)
    return np.array(reached).reshape(len(steps), -1)


@pytest.mark.parametrize("task", ["hammer", "push", "door-open"])
def test_visibility_agrees_with_rays_from_the_camera(task: str) -> None:
    labels = labeled(task)
    steps = range(0, len(labels.episode), 4)
    truth, ours = rays_reach(labels, steps), labels.episode.tracks.visible[:: steps.step]
    agreement = (ours == truth).mean()
    assert agreement >= 0.9
    assert agreement > max(truth.mean(), 1 - truth.mean()) + 0.03, "no better than always saying the same"
    assert ours[truth].mean() > 0.9
    assert ours[~truth].mean() < 0.3


def test_visibility_by_hand() -> None:
    """A wall 2 m away, half of it covered by a post of another thing 1 m away."""
    cam = Camera.from_fovy(40, 30, 60.0, np.eye(4))
    depth, owner = np.full((1, 30, 40), 2, np.float32), np.zeros((1, 30, 40), np.int16)
    depth[:, :, 20:], owner[:, :, 20:] = 1, 1
    points = {
        "on the wall": ((5, 5), 2.0, 0, True),
        "on the post": ((30, 5), 1.0, 1, True),
        "behind the post": ((30, 5), 2.0, 0, False),
        "of another thing": ((5, 5), 2.0, 1, False),
        "deep inside the wall": ((5, 5), 2.4, 0, False),
        "a little behind the wall, as its slope within a pixel may be": ((5, 5), 2.02, 0, True),
        "half a pixel past the wall's edge": ((19.5, 5), 2.0, 0, True),
        "outside of the picture": ((-3, 5), 2.0, 0, False),
        "behind the camera": ((5, 5), -2.0, 0, False),
    }
    uv, z, thing, expected = (np.array(column) for column in zip(*points.values(), strict=True))
    xyz = cam.unproject(uv.astype(float), z)[None]
    found = visibility(xyz, thing, np.array([0, 1]), cam, depth, owner)[0]
    assert dict(zip(points, found.tolist(), strict=True)) == dict(zip(points, expected.tolist(), strict=True))


def test_labels_take_what_is_welded_together_for_one_thing() -> None:
    labels = labeled("hammer")
    m, episode = labels.rollout.scene.model, labels.episode
    owner = labels.seen.owner
    assert owner is not None
    welded = m.body_weldid[np.concatenate([m.geom_bodyid, m.site_bodyid])]

    def visible(thing_of: np.ndarray) -> np.ndarray:
        thing, xyz = thing_of[episode.queries.owner], episode.tracks.xyz_world
        return visibility(xyz, thing, thing_of, episode.camera, labels.seen.depth, owner)

    np.testing.assert_array_equal(episode.tracks.visible, visible(welded))
    assert (episode.tracks.visible & ~visible(np.arange(len(welded)))).any(), "it makes no difference here"


def test_parts_that_move_as_one_stand_for_each_other() -> None:
    cam = Camera.from_fovy(4, 4, 60.0, np.eye(4))
    depth, owner = np.ones((1, 4, 4), np.float32), np.ones((1, 4, 4), np.int16)
    point = cam.unproject(np.array([[1.0, 1.0]]), np.array([1.0]))[None]
    for thing_of, seen in (([7, 7], True), ([7, 8], False)):
        thing = np.array([thing_of[0]])
        assert visibility(point, thing, np.array(thing_of), cam, depth, owner)[0, 0] == seen


def drawn_vertices(task: str, geom: int) -> np.ndarray | None:
    """World vertices of a mesh or a box at the first frame, from the replay; None for other shapes."""
    m, d = replay(task).model, replay(task).first
    if m.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = m.geom_dataid[geom]
        local = m.mesh_vert[m.mesh_vertadr[mesh] :][: m.mesh_vertnum[mesh]].astype(float)
    elif m.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        local = (np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3)) * m.geom_size[geom]
    else:
        return None
    return np.asarray(d.geom_xpos[geom] + local @ d.geom_xmat[geom].reshape(3, 3).T)


def followed(task: str, association: Any) -> tuple[np.ndarray, np.ndarray]:
    labels = labeled(task)
    settings = RigidFlowSettings(association=association)
    return rigid_tracks(labels.rollout, labels.episode.queries, settings)


@pytest.mark.parametrize("task", ["hammer", "door-open"])
def test_nearest_vertex_follows_the_nearest_vertex_of_the_owners_mesh(task: str) -> None:
    queries = labeled(task).episode.queries
    xyz, distance = followed(task, "nearest-vertex")
    checked = 0
    for i, (query, owner) in enumerate(zip(queries.xyz_world, queries.owner, strict=True)):
        vertices = drawn_vertices(task, int(owner)) if owner < replay(task).model.ngeom else None
        if vertices is None:
            continue
        away = np.linalg.norm(vertices - query, axis=1)
        assert np.linalg.norm(vertices - xyz[0, i], axis=1).min() < 1e-6
        assert np.linalg.norm(xyz[0, i] - query) == pytest.approx(away.min(), abs=1e-6)
        assert distance[i] == pytest.approx(away.min(), abs=1e-6)
        checked += 1
    assert checked > 60
    local = in_body_frame(task, xyz)
    assert np.abs(local - local[0]).max() < 1e-5, "the vertex moves with the owner's body"


def test_the_vertices_of_round_shapes_lie_on_them() -> None:
    queries = labeled("hammer").episode.queries
    m, d = replay("hammer").model, replay("hammer").first
    xyz, _ = followed("hammer", "nearest-vertex")
    cylinders = [
        i for i, g in enumerate(queries.owner) if g < m.ngeom and m.geom_type[g] == mujoco.mjtGeom.mjGEOM_CYLINDER
    ]
    assert cylinders
    for i in cylinders:
        g = queries.owner[i]
        local = (xyz[0, i] - d.geom_xpos[g]) @ d.geom_xmat[g].reshape(3, 3)
        radius, half = m.geom_size[g, :2]
        assert np.linalg.norm(local[:2]) in (pytest.approx(radius, abs=1e-6), pytest.approx(0, abs=1e-6))
        assert abs(local[2]) == pytest.approx(half, abs=1e-6)


def test_nearest_vertex_of_all_is_nearer_and_may_be_on_another_body() -> None:
    labels = labeled("drawer-open")
    own, own_distance = followed("drawer-open", "nearest-vertex")
    anyones, any_distance = followed("drawer-open", "nearest-vertex-any")
    meshed = own_distance > 0  # points of planes and the like have no vertex of their own
    assert (any_distance[meshed] <= own_distance[meshed] + 1e-7).all()
    np.testing.assert_allclose(
        any_distance, np.linalg.norm(anyones[0] - labels.episode.queries.xyz_world, axis=1), atol=1e-6
    )
    local = in_body_frame("drawer-open", anyones)
    crossed = np.abs(local - local[0]).max((0, 2)) > 1e-3
    assert crossed.sum() > 5, "without owners, many points of the drawer's case follow the drawer"
    assert (any_distance[crossed & meshed] < own_distance[crossed & meshed]).all()
    still = labels.episode.query_role == Role.PROP
    assert np.ptp(anyones[:, still], axis=0).max() > 0.05
    assert np.ptp(own[:, still], axis=0).max() == 0


@pytest.mark.parametrize("task", ["hammer", "push", "drawer-open"])
def test_what_cannot_move_has_no_flow_at_all(task: str) -> None:
    episode = labeled(task).episode
    static = np.isin(episode.query_role, [Role.PROP, Role.MARKER, Role.BACKGROUND])
    assert static.any()
    assert (episode.flow[:, static] == 0).all()
    assert (np.abs(episode.flow[:, ~static]).max((0, 2)) > 0).mean() > 0.5


def test_the_goal_marker_of_push_is_followed_and_stays() -> None:
    episode = labeled("push").episode
    marker = episode.query_role == Role.MARKER
    assert marker.any()
    goal = replay("push").first.site("goal").xpos
    assert (np.linalg.norm(episode.tracks.xyz_world[:, marker] - goal, axis=-1) < 0.03).all()


def test_flow_adds_up_to_the_tracks() -> None:
    episode = labeled("hammer").episode
    xyz = episode.tracks.xyz_world
    np.testing.assert_allclose(xyz[0] + np.cumsum(episode.flow, 0)[:-1], xyz[1:], atol=1e-5)
    assert (episode.flow[-1] == 0).all()
