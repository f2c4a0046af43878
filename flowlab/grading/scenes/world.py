"""A procedural scene as MuJoCo has it: its things as bodies, their textures, a table, walls, lamps and a camera."""

from collections.abc import Sequence
from io import StringIO

import cv2
import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from flowlab.geometry.camera import GL_TO_CV
from flowlab.grading.scenes.textures import Look, make_texture
from flowlab.grading.scenes.things import Solid, Thing
from flowlab.sim.scene import Poses

CAMERA = "film"
_FLAT_PX = 1024
_HEAD = """<mujoco>
<compiler angle="radian"/>
<statistic extent="1" center="0 0 0.2"/>
<visual>
<map znear="0.02" zfar="20"/>
<quality shadowsize="1024"/>
<headlight ambient=".35 .35 .35" diffuse=".3 .3 .3" specular="0 0 0"/>
</visual>
"""


def body_name(k: int, thing: Thing) -> str:
    """What the body of the k-th thing is called in the model."""
    return f"{thing.name} {k}"


def build_world(
    things: Sequence[Thing], looks: Sequence[Look], fovy_deg: float, rng: np.random.Generator
) -> mujoco.MjModel:
    """The model of a scene.

    Args:
        things: What is in it besides table and walls.
        looks: What table and walls may look like.
        fovy_deg: The camera's vertical field of view [degrees].
        rng: What textures and light are drawn from.

    Returns:
        A model in which every thing is free to be put anywhere; see :func:`poses_of`.
    """
    pictures: dict[str, bytes] = {}
    assets, bodies = StringIO(), StringIO()

    def material(look: Look, *, flat: bool = False) -> str:
        name = f"t{len(pictures)}"
        if flat:
            faces = [make_texture(look, rng, _FLAT_PX)]
        else:
            faces = [make_texture(look, rng) for _ in range(1 if look == "plain" else 6)]
        pictures[f"{name}.png"] = cv2.imencode(".png", np.concatenate(faces)[..., ::-1])[1].tobytes()
        kind = "2d" if flat else "cube"
        layout = ' gridsize="6 1" gridlayout="RLUDFB"' if len(faces) == 6 else ""
        assets.write(f'<texture name="{name}" type="{kind}" file="{name}.png"{layout}/>')
        assets.write(f'<material name="{name}" texture="{name}" specular="0" shininess="0"/>')
        return name

    for name, size, at in _room(rng):
        look = looks[int(rng.integers(len(looks)))]
        bodies.write(_geom(name, "box", size, at, material(look, flat=True)))
    for k, thing in enumerate(things):
        name = body_name(k, thing)
        bodies.write(f'<body name="{name}"><freejoint/>')
        looks_of = {look: material(look) for look in dict.fromkeys(s.look for s in thing.solids)}
        for n, solid in enumerate(thing.solids):
            bodies.write(_geom(f"{name} {n}", solid.shape, _size(solid), solid.at, looks_of[solid.look]))
        bodies.write("</body>")
    x, y = rng.uniform(-1, 1, 2)
    light = f'<light pos="{x} {y - 1} 2.5" dir="{-x / 3} {(1 - y) / 3} -1" diffuse=".6 .6 .6" specular="0 0 0"/>'
    camera = f'<camera name="{CAMERA}" fovy="{fovy_deg}"/>'
    xml = f"{_HEAD}<asset>{assets.getvalue()}</asset><worldbody>{light}{camera}{bodies.getvalue()}</worldbody></mujoco>"
    return mujoco.MjModel.from_xml_string(xml, pictures)


def poses_of(model: mujoco.MjModel, things: Sequence[Thing], T_world_cam: Float[np.ndarray, "T 4 4"]) -> Poses:
    """Where everything is in every frame: computed from the things' paths, no physics.

    Args:
        model: Of :func:`build_world`.
        things: Those it was built with.
        T_world_cam: The pose of the camera in every frame.

    Returns:
        The poses of all frames.
    """
    data, found = mujoco.MjData(model), []
    xyz = np.stack([t.path[:, :3, 3] for t in things], 1)
    xyzw = np.stack([Rotation.from_matrix(t.path[:, :3, :3]).as_quat() for t in things], 1)
    for t, T in enumerate(T_world_cam):
        data.qpos[:] = np.concatenate([xyz[t], xyzw[t][:, [3, 0, 1, 2]]], -1).ravel()
        mujoco.mj_kinematics(model, data)
        data.cam_xpos[0], data.cam_xmat[0] = T[:3, 3], (T[:3, :3] @ GL_TO_CV).ravel()
        found.append(Poses.of(data))
    return Poses.stack(found)


def _room(rng: np.random.Generator) -> list[tuple[str, tuple[float, float, float], np.ndarray]]:
    """A table whose top is at z = 0, a floor, and a wall or two some way behind."""
    upright, sideways = Rotation.from_euler("x", np.pi / 2).as_matrix(), Rotation.from_euler("y", np.pi / 2).as_matrix()
    back, aside = rng.uniform(0.5, 1.5), rng.choice([-1, 1]) * rng.uniform(0.8, 1.6)

    def at(R: np.ndarray, *xyz: float) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, xyz
        return T

    parts = [
        ("table", (rng.uniform(0.5, 0.9), rng.uniform(0.4, 0.45), 0.02), at(np.eye(3), 0, 0, -0.02)),
        ("floor", (3.0, 3.0, 0.02), at(np.eye(3), 0, 0, -0.8)),
        ("wall", (3.0, 2.0, 0.02), at(upright, 0, back, 1.2)),
    ]
    if rng.random() < 0.5:
        parts.append(("side wall", (2.0, 3.0, 0.02), at(sideways, aside, 0, 1.2)))
    return parts


def _size(solid: Solid) -> tuple[float, float, float]:
    """Sizes as MuJoCo wants them: radius and half the length of the axis."""
    a, _, c = solid.size
    return {"cylinder": (a, c, 0.0), "capsule": (a, max(c - a, 1e-3), 0.0), "sphere": (a, 0.0, 0.0)}.get(
        solid.shape, solid.size
    )


def _geom(name: str, shape: str, size: Sequence[float], at: Float[np.ndarray, "4 4"], material: str) -> str:
    x, y, z, w = Rotation.from_matrix(at[:3, :3]).as_quat()
    pos, sizes = " ".join(f"{v:.9g}" for v in at[:3, 3]), " ".join(f"{v:.9g}" for v in size)
    quat = f"{w:.9g} {x:.9g} {y:.9g} {z:.9g}"
    return f'<geom name="{name}" type="{shape}" size="{sizes}" pos="{pos}" quat="{quat}" material="{material}"/>'
