"""The z-buffer against closed-form depth, MuJoCo's own rays, and OpenGL.

Rays are single `mj_ray` calls: `mj_multiRay` misses thin things in MuJoCo 3.3.0.
"""

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowlab.errors import FlowlabError, MissingLibraryError
from flowlab.geometry.camera import Camera
from flowlab.records import Frame, Role
from flowlab.sim.expert import Expert
from flowlab.sim.render.gl import GLRenderer
from flowlab.sim.render.zbuffer import PackedScene, ZBuffer
from flowlab.sim.scene import Poses, Scene
from flowlab.sim.scene_settings import SceneSettings
from flowlab.sim.simulation import Simulation

WIDTH, HEIGHT = 48, 36
DRAWN_GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)
ASSETS = """
  <mesh name="rock" vertex="0 0 0  .3 0 0  0 .25 0  0 0 .2  .2 .2 .1  -.1 .1 .15"/>
  <mesh name="step" vertex="0 0 0  .4 0 0  .4 .2 0  .2 .2 0  .2 .4 0  0 .4 0
                            0 0 .1  .4 0 .1  .4 .2 .1  .2 .2 .1  .2 .4 .1  0 .4 .1"
        face="0 2 1  0 3 2  0 4 3  0 5 4  6 7 8  6 8 9  6 9 10  6 10 11
              0 1 7  0 7 6  1 2 8  1 8 7  2 3 9  2 9 8  3 4 10  3 10 9  4 5 11  4 11 10  5 0 6  5 6 11"/>
  <material name="glass" rgba="1 1 1 0"/>"""
"""A convex mesh, and a concave one with a corner cut out."""


def look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Pose of a camera in OpenCV's convention: x right, y down, z towards the target."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(z, [0.02, 0.03, 1.0])
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3] = np.stack([x, np.cross(z, x), z, eye], 1)
    return T


def camera(
    eye: tuple[float, float, float] = (1.7, -0.6, 0.9), target: tuple[float, float, float] = (0, 0, 0)
) -> Camera:
    """Off-center, not square, with pixels that are not square."""
    K = np.array([[41.0, 0, 22.3], [0, 45.0, 18.1], [0, 0, 1]])
    return Camera(WIDTH, HEIGHT, K, look_at(np.array(eye), np.array(target)))


def world(bodies: str, assets: str = ASSETS) -> tuple[mujoco.MjModel, mujoco.MjData]:
    xml = f"<mujoco><asset>{assets}</asset><worldbody>{bodies}</worldbody></mujoco>"
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def draw(model: mujoco.MjModel, data: mujoco.MjData, cam: Camera, markers: bool = True) -> Frame:
    scene = Scene(model, markers=markers)
    return ZBuffer(scene, cam, Poses.of(data)).frame(Poses.of(data))


def owners(frame: Frame) -> np.ndarray:
    assert frame.owner is not None
    return frame.owner


def ray_directions(cam: Camera) -> np.ndarray:
    """World direction (H, W, 3) of every pixel's ray; one unit of it is one meter of z-depth."""
    v, u = np.mgrid[: cam.height, : cam.width]
    d = np.stack([(u - cam.K[0, 2]) / cam.K[0, 0], (v - cam.K[1, 2]) / cam.K[1, 1], np.ones(u.shape)], -1)
    return d @ cam.T_world_cam[:3, :3].T


def cast(model: mujoco.MjModel, data: mujoco.MjData, start: np.ndarray, along: np.ndarray) -> tuple[float, int]:
    """Distance in units of ``along`` to the first drawn geom (0 for none), and the geom (-1)."""
    geom = np.full(1, -1, np.int32)
    distance = mujoco.mj_ray(model, data, start, along, DRAWN_GROUPS, 1, -1, geom)
    return (distance, int(geom[0])) if distance >= 0 else (0.0, -1)


def rays(model: mujoco.MjModel, data: mujoco.MjData, cam: Camera) -> tuple[np.ndarray, np.ndarray]:
    """z-depth and geom of every pixel, by one ray each."""
    eye = cam.T_world_cam[:3, 3].copy()
    hits = [cast(model, data, eye, d) for d in ray_directions(cam).reshape(-1, 3)]
    depth, geom = (np.array(column).reshape(cam.height, cam.width) for column in zip(*hits, strict=True))
    return depth, geom


def assert_same_as_rays(model: mujoco.MjModel, data: mujoco.MjData, frame: Frame, ties: int = 0) -> None:
    """At most ``ties`` pixels may differ: rays that meet an edge to within rounding."""
    depth, geom = rays(model, data, frame.camera)
    tolerance = 1e-5 * np.maximum(depth, 1)  # float32 has no more digits where a plane meets the horizon
    differ = (np.abs(frame.depth - depth) > tolerance) | (owners(frame) != geom)
    assert differ.sum() <= ties, f"{differ.sum()} pixels differ: {np.argwhere(differ)[:5].tolist()}"
    assert (depth > 0).sum() > 50, "the scene shows next to nothing"


def numbers(values: np.ndarray) -> str:
    return " ".join(f"{v:.6f}" for v in values)


def random_things(seed: int) -> str:
    """One of every shape, and a tilted or endless plane, in random sizes and poses near the origin."""
    rng = np.random.default_rng(seed)
    things = ["<geom type='plane' size='0 0 1' pos='0 0 -.6'/>"]
    if seed % 2:
        things = [f"<geom type='plane' size='.9 .5 1' pos='0 0 -.5' euler='{numbers(rng.uniform(-20, 20, 3))}'/>"]
    for kind in ("sphere", "box", "cylinder", "capsule", "rock", "step"):
        shape = f"type='{kind}' size='{numbers(rng.uniform(0.05, 0.25, 3))}'"
        shape = f"type='mesh' mesh='{kind}'" if kind in ("rock", "step") else shape
        pose = f"pos='{numbers(rng.uniform(-0.5, 0.5, 3))}' quat='{numbers(rng.normal(size=4))}'"
        joint = "<freejoint/>" if rng.random() < 0.5 else ""
        things.append(f"<body {pose}>{joint}<geom {shape}/></body>")
    return "".join(things)


@pytest.mark.parametrize("seed", range(30))
def test_every_pixel_of_random_shapes_is_what_a_ray_hits(seed: int) -> None:
    model, data = world(random_things(seed))
    rng = np.random.default_rng(seed)
    towards = rng.normal(size=3)
    towards[2] = abs(towards[2])
    eye = towards / np.linalg.norm(towards) * rng.uniform(1.0, 2.5)
    frame = draw(model, data, camera(tuple(eye), tuple(rng.uniform(-0.2, 0.2, 3))))
    assert_same_as_rays(model, data, frame)


@pytest.mark.parametrize("kind", ["sphere", "box", "cylinder", "capsule", "rock", "step"])
def test_every_shape_on_its_own_close_up_is_what_a_ray_hits(kind: str) -> None:
    shape = f"type='mesh' mesh='{kind}'" if kind in ("rock", "step") else f"type='{kind}' size='.2 .15 .1'"
    for seed in range(4):
        quat = numbers(Rotation.random(random_state=seed).as_quat())
        model, data = world(f"<body quat='{quat}'><geom {shape}/></body>")
        assert_same_as_rays(model, data, draw(model, data, camera((0.55, -0.2, 0.3))))


def test_depth_of_a_sphere_is_the_quadratic_formula() -> None:
    center, radius, cam = np.array([0.1, 0.05, -0.1]), 0.4, camera()
    model, data = world(f"<geom type='sphere' size='{radius}' pos='{numbers(center)}'/>")
    frame = draw(model, data, cam)
    d, o = ray_directions(cam), cam.T_world_cam[:3, 3] - center
    a, b, c = (d * d).sum(-1), d @ o, o @ o - radius**2
    hit = b * b > a * c
    expected = np.where(hit, (-b - np.sqrt(np.where(hit, b * b - a * c, 0))) / a, 0)
    np.testing.assert_allclose(frame.depth, expected, atol=1e-6)
    np.testing.assert_array_equal(frame.owner, np.where(hit, 0, -1))
    assert 100 < hit.sum() < WIDTH * HEIGHT - 100


def test_a_wall_straight_ahead_has_the_same_depth_everywhere() -> None:
    model, data = world("<geom type='box' size='9 .5 9' pos='0 2.5 0'/>")
    cam = camera()
    head_on = replace(cam, T_world_cam=np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]]))
    np.testing.assert_array_equal(draw(model, data, head_on).depth, np.float32(2))


@pytest.mark.parametrize("unseen", ["rgba='1 0 0 0'", "material='glass'", "group='3'", "group='4'"])
@pytest.mark.parametrize("shape", ["type='sphere' size='.3'", "type='mesh' mesh='rock'"])
def test_see_through_and_collision_geoms_are_not_drawn(unseen: str, shape: str) -> None:
    behind = "<geom type='plane' size='0 0 1' pos='0 0 -.5'/>"
    model, data = world(f"{behind}<geom {shape} {unseen}/>")
    frame = draw(model, data, camera())
    assert_same_as_rays(model, data, frame)
    assert set(np.unique(owners(frame))) <= {-1, 0}
    assert 1 in owners(draw(*world(f"{behind}<geom {shape}/>"), camera()))


def test_hidden_bodies_are_not_drawn_and_uncover_what_is_behind() -> None:
    model, data = world(
        "<body name='a'><geom size='.3'/></body><body name='b' pos='-.9 .4 -.4'><geom size='.4'/></body>"
    )
    scene = Scene(model, hidden_bodies=frozenset({"a"}))
    frame = ZBuffer(scene, camera(), Poses.of(data)).frame(Poses.of(data))
    model.geom_rgba[0, 3] = 0  # what rays see through
    assert_same_as_rays(model, data, frame)


def test_a_marker_is_drawn_like_a_geom_and_only_if_asked_for() -> None:
    marker = "<site name='goal' type='sphere' size='.2' pos='.2 0 .1'/>"
    box = "<geom type='box' size='.2 .2 .2'/>"
    model, data = world(box + marker)
    cam = camera()
    shown, hidden = draw(model, data, cam), draw(model, data, cam, markers=False)
    assert shown.entities[1].geom == "goal"
    assert shown.entities[1].role is Role.MARKER
    twin = draw(*world(box + marker.replace("site", "geom")), cam)
    np.testing.assert_array_equal(shown.depth, twin.depth)
    np.testing.assert_array_equal(shown.owner, twin.owner)
    assert (owners(shown) == 1).sum() > 20
    assert_same_as_rays(model, data, hidden)


def test_moving_bodies_are_drawn_where_they_are_now_and_the_rest_stays() -> None:
    model, data = world(
        "<geom type='plane' size='0 0 1' pos='0 0 -.4'/><body pos='-.3 .3 0'><geom type='mesh' mesh='step'/></body>"
        "<body name='ball' pos='0 0 .1'><freejoint/><geom size='.2'/></body>"
        "<body name='stone' pos='.2 -.4 0'><freejoint/><geom type='mesh' mesh='rock'/></body>"
    )
    renderer = ZBuffer(Scene(model), camera(), Poses.of(data))
    rng = np.random.default_rng(0)
    frames = []
    for _ in range(4):
        frames.append(renderer.frame(Poses.of(data)))
        assert_same_as_rays(model, data, frames[-1])
        data.qpos[:] = np.concatenate([np.r_[rng.uniform(-0.5, 0.5, 3), rng.normal(size=4)] for _ in range(2)])
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_forward(model, data)
    assert (owners(frames[0]) != owners(frames[1])).sum() > 50


def test_a_packed_scene_serves_another_layout_of_its_static_things() -> None:
    """MetaWorld moves static bodies at every reset."""
    model, data = world("<geom type='plane' size='0 0 1' pos='0 0 -.4'/><body><geom type='mesh' mesh='step'/></body>")
    scene = Scene(model)
    packed = PackedScene(scene)
    for y in (0.0, 0.5):
        model.body_pos[1, 1] = y
        mujoco.mj_forward(model, data)
        frame = ZBuffer(scene, camera(), Poses.of(data), packed).frame(Poses.of(data))
        assert_same_as_rays(model, data, frame)


def test_nothing_nearer_than_the_near_plane_is_drawn() -> None:
    model, data = world("<body pos='1.6 -.56 .85'><geom size='.05'/></body><geom type='plane' size='0 0 1'/>")
    # The ball starts 0.07 m in front of the camera; move the near plane to either side of that.
    near = [draw_with_near_plane(model, data, z) for z in (0.03, 0.2)]
    assert (owners(near[0]) == 1).sum() > 100
    assert (owners(near[1]) != 1).all()
    assert near[1].depth[owners(near[0]) == 1].max() > 0.3, "what is behind shows instead"


def draw_with_near_plane(model: mujoco.MjModel, data: mujoco.MjData, z: float) -> Frame:
    model.vis.map.znear = z / model.stat.extent
    return draw(model, data, camera())


def test_a_mesh_that_reaches_behind_the_camera_is_drawn_where_it_is_in_view() -> None:
    corners = "-3 -3 0  3 -3 0  3 3 0  -3 3 0  -3 -3 -.1  3 -3 -.1  3 3 -.1  -3 3 -.1"
    model, data = world("<geom type='mesh' mesh='slab'/>", f"<mesh name='slab' vertex='{corners}'/>")
    assert_same_as_rays(model, data, draw(model, data, camera()))


def test_a_shape_it_cannot_draw_is_named() -> None:
    model, data = world("<geom name='egg' type='ellipsoid' size='.1 .2 .3'/>")
    with pytest.raises(FlowlabError, match=r"'egg'.*ELLIPSOID.*--renderer gl"):
        draw(model, data, camera())


def facing(model: mujoco.MjModel, data: mujoco.MjData, geom: int, point: np.ndarray, along: np.ndarray) -> bool:
    """Whether the triangle of a mesh on which a point lies faces the ray; true for anything but a mesh."""
    if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_MESH:
        return True
    R = data.geom_xmat[geom].reshape(3, 3)
    p, d = (point - data.geom_xpos[geom]) @ R, along @ R
    mesh = model.mesh(model.geom_dataid[geom])
    vertices = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]].astype(float)
    a, b, c = vertices[model.mesh_face[mesh.faceadr[0] :][: mesh.facenum[0]]].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    size = np.maximum(np.linalg.norm(normal, axis=1), 1e-15)
    near_plane = np.abs(((p - a) * normal).sum(1)) / size < 1e-6
    inside = np.ones(len(a), bool)
    for start, end in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(end - start, p - start) * normal).sum(1) > -1e-9 * size
    mine = np.flatnonzero(near_plane & inside)
    return bool((normal[mine] @ d < 0).any())


def first_front_face(
    model: mujoco.MjModel, data: mujoco.MjData, eye: np.ndarray, along: np.ndarray
) -> tuple[float, int, int]:
    """Like :func:`cast`, but passing through faces that look away; also how many of those there were."""
    depth, passed = 0.0, 0
    while True:
        step, geom = cast(model, data, eye + depth * along, along)
        if geom < 0:
            return 0.0, -1, passed
        depth += step
        if facing(model, data, geom, eye + depth * along, along):
            return depth, geom, passed
        depth, passed = depth + 1e-6, passed + 1


@pytest.fixture(scope="module", params=["hammer", "push", "window-open"])
def midway(request: pytest.FixtureRequest) -> Simulation:
    """A real task in the middle of being solved."""
    return played(request.param, 35)


def played(task: str, steps: int, **settings: Any) -> Simulation:
    simulation = Simulation(task, SceneSettings(**settings))
    simulation.reset(1)
    expert = Expert(simulation)
    for _ in range(steps):
        simulation.step(expert.act())
    return simulation


def zbuffer(simulation: Simulation) -> Frame:
    poses = simulation.poses()
    return ZBuffer(simulation.scene, simulation.camera(), poses).frame(poses)


def test_real_scenes_show_the_first_front_face_of_every_ray(midway: Simulation) -> None:
    frame = zbuffer(midway)
    cam, model = frame.camera, midway.model
    eye, directions = cam.T_world_cam[:3, 3].copy(), ray_directions(cam)
    compared, passed, wrong = 0, 0, []
    for v, u in np.ndindex(cam.height, cam.width):
        owner = int(owners(frame)[v, u])
        if (v * cam.width + u + v) % 4 or owner >= model.ngeom:  # rays never hit sites
            continue
        depth, geom, through = first_front_face(model, midway.data, eye, directions[v, u])
        compared, passed = compared + 1, passed + through
        if geom != owner or abs(depth - frame.depth[v, u]) > 1e-5:
            wrong.append((v, u, owner, geom, float(frame.depth[v, u]), depth))
    assert len(wrong) <= 1, f"{midway.task.name}: {wrong}"
    assert compared > 4000
    assert passed > 0, "no ray met a back face, so culling was not tested"


needs_gl = "OpenGL is not installed here ({}); the z-buffer cannot be compared with it"


def gl_renderer(simulation: Simulation) -> GLRenderer:
    try:
        return GLRenderer(simulation.scene, simulation.camera(), simulation.settings)
    except MissingLibraryError as error:
        pytest.skip(needs_gl.format(error))


def gl_frames(simulation: Simulation, steps: int = 40) -> Iterator[tuple[Frame, Frame]]:
    """The z-buffer's picture and OpenGL's, at the first step and at a later one."""
    gl, simulation_expert = gl_renderer(simulation), Expert(simulation)
    try:
        yield zbuffer(simulation), gl.frame(simulation.poses())
        for _ in range(steps):
            simulation.step(simulation_expert.act())
        yield zbuffer(simulation), gl.frame(simulation.poses())
    finally:
        gl.close()


def round_things(model: mujoco.MjModel) -> np.ndarray:
    """Indices of the spheres, capsules and cylinders among geoms and sites."""
    kinds = np.concatenate([model.geom_type, model.site_type])
    round_kinds = [mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER]
    return np.flatnonzero(np.isin(kinds, [int(k) for k in round_kinds]))


@pytest.mark.parametrize("task", ["hammer", "door-open", "pick-place"])
def test_zbuffer_and_opengl_make_the_same_picture(task: str) -> None:
    simulation = played(task, 0)
    for ours, theirs in gl_frames(simulation):
        off = np.abs(ours.depth - theirs.depth)
        assert (off > 1e-3).sum() <= 10, "of 16384 pixels"
        assert (owners(ours) != owners(theirs)).sum() <= 10
        # OpenGL draws round shapes as polygons, up to half a millimeter inside of the true ones.
        flat = ~np.isin(owners(ours), round_things(simulation.model))
        assert np.percentile(off[flat], 99) < 1e-5
        assert np.percentile(off, 99) < 2e-4
        assert ours.entities == theirs.entities


def test_hidden_bodies_and_markers_disappear_from_both_renderers() -> None:
    hidden = played("reach", 0, hidden_bodies=frozenset({"RetainingWall", "hand"}), markers=False)
    plain = played("reach", 0)
    gone = {i for i, e in enumerate(plain.scene.entities) if e.role is Role.MARKER}
    gone |= {g for g in range(plain.model.ngeom) if plain.model.body(plain.model.geom_bodyid[g]).name in HIDDEN}
    before, after = next(gl_frames(plain)), next(gl_frames(hidden))
    for shown, less in zip(before, after, strict=True):
        assert np.isin(owners(shown), list(gone)).sum() > 100
        assert not np.isin(owners(less), list(gone)).any()
    assert (np.abs(after[0].depth - after[1].depth) > 1e-3).sum() <= 10


HIDDEN = {"RetainingWall", "hand"}
SCRIPT = """
import sys
from flowlab.errors import MissingLibraryError
from flowlab.sim.scene_settings import SceneSettings
from flowlab.sim.recorder import ExpertSettings, TaskSimulator
studio = TaskSimulator("reach", SceneSettings(renderer="gl"))
try:
    frame = studio.record_expert(0, ExpertSettings(max_steps=1)).frame(0)
except MissingLibraryError as error:
    sys.exit(f"missing: {error}")
print(frame.depth.mean())
"""


def run_with(environment: dict[str, str], *command: str) -> subprocess.CompletedProcess[str]:
    """A process in which none of this one's OpenGL settings hold."""
    inherited = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY")}
    return subprocess.run(
        command or (sys.executable, "-c", SCRIPT), capture_output=True, text=True, env=inherited | environment
    )


@pytest.fixture
def broken_libraries(tmp_path: Path) -> dict[str, str]:
    """Empty files in the place of EGL's library, so that it cannot be loaded."""
    for name in ("libEGL.so", "libEGL.so.0", "libEGL.so.1"):
        (tmp_path / name).touch()
    return {"LD_LIBRARY_PATH": str(tmp_path)}


def test_opengl_needs_no_setting_and_leaves_quietly() -> None:
    gl_renderer(played("reach", 0)).close()
    result = run_with({})
    assert result.returncode == 0, result.stderr
    assert float(result.stdout) > 0.3
    assert "Traceback" not in result.stderr


def assert_says_what_to_install(result: subprocess.CompletedProcess[str]) -> None:
    assert result.returncode == 1
    said = next(line for line in result.stderr.splitlines() if line.startswith("missing: "))
    assert "apt-get install libegl1" in said
    assert "--renderer zbuffer" in said


@pytest.mark.parametrize(
    "settings",
    [
        {"MUJOCO_GL": "egl", "__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent"},
        {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent"},
        {"MUJOCO_GL": "glfw"},
    ],
    ids=["egl without a driver", "default without a driver", "window without a screen"],
)
def test_without_a_driver_it_says_what_to_install(settings: dict[str, str]) -> None:
    assert_says_what_to_install(run_with(settings))


def test_without_the_library_it_says_what_to_install(broken_libraries: dict[str, str]) -> None:
    assert_says_what_to_install(run_with(broken_libraries))


def test_without_the_library_mujoco_itself_needs_the_command_says_so(
    broken_libraries: dict[str, str], tmp_path: Path
) -> None:
    """With MUJOCO_GL=egl set, MuJoCo cannot even be imported."""
    command = f"{sys.executable} -m flowlab extract-sim reach --renderer gl --out {tmp_path / 'out'}"
    result = run_with({"MUJOCO_GL": "egl", **broken_libraries}, *command.split())
    assert result.returncode == 1
    assert "apt-get install libegl1" in result.stderr
    assert "Traceback" not in result.stderr


def test_the_zbuffer_needs_no_opengl(broken_libraries: dict[str, str]) -> None:
    result = run_with(broken_libraries, sys.executable, "-c", SCRIPT.replace('"gl"', '"zbuffer"'))
    assert result.returncode == 0, result.stderr
    assert float(result.stdout) > 0.3
