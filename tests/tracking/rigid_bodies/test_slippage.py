"""What could turn or slide unseen states that it may have: surfaces of closed form, seen by an ideal camera."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from flowlab.geometry.camera import Camera
from flowlab.records import Clip
from flowlab.tracking.trackers.rigid_bodies.features import extract_features
from flowlab.tracking.trackers.rigid_bodies.fit import fit_bodies
from flowlab.tracking.trackers.rigid_bodies.slippage import slippage

WIDTH, HEIGHT, FOCAL, FRAMES = 160, 120, 160.0, 4
K = np.array([[FOCAL, 0, 79.5], [0, FOCAL, 59.5], [0, 0, 1]])
RADIUS, CENTER = 0.07, np.array([0.0, 0.0, 0.6])
RED, WALL = (200, 60, 60), 1.0
Depth = Callable[[np.ndarray], np.ndarray]


def sphere(ray: np.ndarray) -> np.ndarray:
    """Depth along rays (h, w, 3) of unit z; infinite where they miss."""
    return first_root((ray**2).sum(-1), ray @ CENTER, CENTER @ CENTER - RADIUS**2)


def upright_cylinder(ray: np.ndarray) -> np.ndarray:
    """Its axis is the picture's vertical; 14 cm high."""
    flat = ray[..., [0, 2]]
    z = first_root((flat**2).sum(-1), flat @ CENTER[[0, 2]], CENTER[[0, 2]] @ CENTER[[0, 2]] - RADIUS**2)
    return np.where(np.abs(ray[..., 1] * z) < RADIUS, z, np.inf)


def large_sphere(ray: np.ndarray) -> np.ndarray:
    """So large and near that the picture's border cuts it."""
    center, radius = np.array([-0.2, 0.1, 0.6]), 0.2
    return first_root((ray**2).sum(-1), ray @ center, center @ center - radius**2)


def on_a_table(depth: Depth) -> Depth:
    """What has nothing below it is a table that slopes toward the camera and reaches the picture's border."""

    def both(ray: np.ndarray) -> np.ndarray:
        table = (RADIUS + 0.35 * CENTER[2]) / np.maximum(ray[..., 1] + 0.35, 1e-9)
        return np.where(ray[..., 1] > -0.1, np.minimum(depth(ray), table), depth(ray))

    return both


def corner_of_a_box(ray: np.ndarray) -> np.ndarray:
    """Three faces, each as steep to the camera as the others: no motion takes all of them along themselves."""
    normals = np.array([[0.82, 0, -0.58], [-0.41, 0.71, -0.58], [-0.41, -0.71, -0.58]])
    z = np.max([(normal @ (CENTER - [0, 0, 0.06])) / np.minimum(ray @ normal, -1e-9) for normal in normals], 0)
    return np.where(z < CENTER[2] + 0.02, z, np.inf)


def first_root(a: np.ndarray, b: np.ndarray, c: float) -> np.ndarray:
    """The lesser solution of a z^2 - 2 b z + c = 0."""
    inside = b * b - a * c
    return np.where(inside > 0, (b - np.sqrt(np.maximum(inside, 0))) / a, np.inf)


def clip_of(depth: Depth, spotted: bool, noise_m: float = 0.0) -> Clip:
    """A thing before a wall, at rest in all frames as far as can be seen."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    ray = np.stack([(u - K[0, 2]) / FOCAL, (v - K[1, 2]) / FOCAL, np.ones(u.shape)], -1)
    z = depth(ray)
    thing = np.isfinite(z)
    rng = np.random.default_rng(0)
    rgb = np.where(
        thing[..., None], np.array(RED), rng.integers(60, 190, (HEIGHT // 6, WIDTH // 8, 3)).repeat(6, 0).repeat(8, 1)
    )
    if spotted:
        dots = rng.integers(0, 256, (HEIGHT // 6, WIDTH // 5, 3)).repeat(6, 0).repeat(5, 1)
        rgb = np.where(thing[..., None], dots, rgb)
    film = np.tile(np.where(thing, z, WALL), (FRAMES, 1, 1)) + noise_m * rng.standard_normal((FRAMES, HEIGHT, WIDTH))
    return Clip(
        np.tile(rgb.astype(np.uint8), (FRAMES, 1, 1, 1)), film.astype(np.float32), Camera(WIDTH, HEIGHT, K, np.eye(4))
    )


def slippage_at(clip: Clip, *pixels: tuple[int, int]) -> np.ndarray:
    pictures = extract_features(clip, 4.0)
    uv = np.array(pixels)
    z = clip.depth[0, uv[:, 1], uv[:, 0]].astype(float)
    return slippage(fit_bodies(pictures, 0), pictures.unproject(uv.astype(float), z))


ON_THING, ON_WALL = ((76, 58), (84, 64), (79, 52)), ((20, 20), (130, 100))


@pytest.mark.parametrize("noise_m", [0.0, 0.002])
@pytest.mark.parametrize("depth", [sphere, upright_cylinder])
def test_a_plain_thing_that_could_turn_unseen_may_have(depth: Depth, noise_m: float) -> None:
    far = slippage_at(clip_of(depth, spotted=False, noise_m=noise_m), *ON_THING, *ON_WALL)
    assert far[: len(ON_THING)].min() > 0.015
    assert far[len(ON_THING) :].max() < 0.005, "a wall of many colors that fills the picture rests"


@pytest.mark.parametrize("depth", [sphere, upright_cylinder])
def test_spots_would_tell(depth: Depth) -> None:
    assert slippage_at(clip_of(depth, spotted=True), *ON_THING).max() < 0.01


@pytest.mark.parametrize("noise_m", [0.0, 0.002])
def test_faces_that_meet_would_tell(noise_m: float) -> None:
    assert slippage_at(clip_of(corner_of_a_box, spotted=False, noise_m=noise_m), *ON_THING).max() < 0.01


def test_a_large_thing_that_the_border_cuts_may_have_turned_too() -> None:
    far = slippage_at(clip_of(large_sphere, spotted=False), (30, 90), (20, 75), *ON_WALL[1:])
    assert far[:2].min() > 0.02, "it is large, but nothing stands on a sphere"
    assert far[2] < 0.005


def test_a_table_rests_and_what_stands_on_it_in_the_same_color_may_turn() -> None:
    far = slippage_at(clip_of(on_a_table(upright_cylinder), spotted=False), *ON_THING, (20, 100), (140, 110))
    assert far[: len(ON_THING)].min() > 0.015
    assert far[len(ON_THING) :].max() < 0.005


def test_a_table_rests_too_where_depth_ends_before_the_picture_does_and_noise_turns_its_normals() -> None:
    clip = clip_of(on_a_table(upright_cylinder), spotted=False, noise_m=0.004)
    clip.depth[:, :, :8] = clip.depth[:, :, -8:] = clip.depth[:, :8] = clip.depth[:, -8:] = 0
    assert slippage_at(clip, (20, 100), (140, 105), (60, 95)).max() < 0.005


@pytest.mark.parametrize(("at_m", "radius_m", "behind_m"), [(0.6, 0.1, 0.0), (0.6, 0.1, 6.0), (1.8, 0.25, 1.83)])
def test_a_plate_alone_or_near_a_wall_of_other_colors_is_no_wall(at_m: float, radius_m: float, behind_m: float) -> None:
    plate = lambda ray: np.where(np.hypot(ray[..., 0], ray[..., 1]) * at_m < radius_m, at_m, np.inf)  # noqa: E731
    clip = clip_of(plate, spotted=False)
    clip.depth[clip.depth == WALL] = behind_m
    assert slippage_at(clip, *ON_THING).min() > 0.02, "it looks the same when it is turned"


def test_at_the_border_of_a_thing_a_point_may_be_of_it() -> None:
    clip = clip_of(upright_cylinder, spotted=False)
    left = int(np.flatnonzero(clip.depth[0, 58] < 0.9)[0])
    rgb = clip.rgb.copy()
    rgb[:, 40:80, left - 1 : left + 2] = (120, 120, 90)  # as pixels mix what meets in them
    far = slippage_at(replace(clip, rgb=rgb), (left, 58), (left + 1, 60))
    assert far.min() > 0.015


@pytest.mark.parametrize(("planes", "told"), [(2, False), (3, True)])
def test_before_a_camera_that_nobody_followed_a_room_may_have_slid_along_itself(planes: int, told: bool) -> None:
    """Two walls that meet look alike wherever along their edge the camera is; a floor would tell."""
    normals = np.array([[0.6, 0, -0.8], [-0.6, 0, -0.8], [0, -0.9, -0.436]])[:planes]
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    ray = np.stack([(u - K[0, 2]) / FOCAL, (v - K[1, 2]) / FOCAL, np.ones(u.shape)], -1)
    depth = []
    for nearer in np.linspace(0, 0.3, 12):
        away = np.array([-1.0, -1.0, -0.75])[:planes] - normals[:, 2] * -nearer
        z = np.stack([d / np.minimum(ray @ n, -1e-9) for n, d in zip(normals, -np.abs(away), strict=True)])
        depth.append(z.min(0))
    film = np.array(depth, np.float32)
    colors = np.full((*film.shape, 3), 128, np.uint8)
    clip = Clip(colors, film, Camera(WIDTH, HEIGHT, K, np.eye(4)))
    far = slippage_at(clip, (40, 40), (120, 40))
    assert (far.max() < 0.01) if told else (far.min() > 0.02)
