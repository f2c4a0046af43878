"""Films of procedural scenes: their truth is what their pictures show, and what they promise of each family holds."""

from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest
from synthetic import files_below

import flowlab
from flowlab.cli.grade import _CAMERAS, _FAMILIES
from flowlab.errors import DataError, MissingLibraryError, UsageError
from flowlab.grading import ground_truth
from flowlab.grading.grade import read_clip
from flowlab.grading.ground_truth import GroundTruth, scene_of
from flowlab.grading.scenes.camera_paths import look_at
from flowlab.grading.scenes.families import FAMILIES, making_films
from flowlab.grading.scenes.film import CameraMotion, FilmSettings, make_film
from flowlab.grading.scenes.motions import carried, progress, shifted, still, turned
from flowlab.grading.scenes.textures import make_texture
from flowlab.grading.scenes.things import place, strip
from flowlab.records import Clip, Role

FRAMES = 20
SMALL = FilmSettings(size=(160, 120), frames=FRAMES, sensor="clean")


def film(folder: Path, family: str, seed: int = 3, settings: FilmSettings = SMALL) -> tuple[Clip, GroundTruth]:
    try:
        make_film(folder / family, family, seed, settings)
    except MissingLibraryError as error:
        pytest.skip(str(error))
    return read_clip(folder / family), ground_truth.read(folder / family)


def shown(clip: Clip, truth: GroundTruth) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far behind the nearest and the farthest surface shown around its pixel a point is [m], and if it is in view.

    Around, because a pixel's depth is that of its center, and a slanted surface recedes by a centimeter to the next.
    """
    K, xyz = clip.camera.K, truth.tracks_cam.astype(float)
    u, v = (np.rint(xyz[..., k] / xyz[..., 2] * K[k, k] + K[k, 2]).astype(int) for k in (0, 1))
    inside = (u >= 0) & (u < clip.camera.width) & (v >= 0) & (v < clip.camera.height)
    around, t = np.ones((3, 3), np.uint8), np.arange(len(xyz))[:, None]
    shown = [np.stack([f(d, around) for d in clip.depth]) for f in (cv2.erode, cv2.dilate)]
    near, far = (d[t, np.where(inside, v, 0), np.where(inside, u, 0)] for d in shown)
    return xyz[..., 2] - near, xyz[..., 2] - far, inside


@pytest.mark.parametrize(
    "family",
    [
        pytest.param(f, marks=pytest.mark.slow) if f in ("tabletop", "clutter", "swarm", "large") else f
        for f in FAMILIES
    ],
)
def test_the_truth_is_what_the_pictures_show(family: str, tmp_path: Path) -> None:
    """OpenGL's depth against the paths that the things were given: two ways that share no code."""
    clip, truth = film(tmp_path, family, settings=SMALL.model_copy(update={"camera": "hand-held, poses known"}))
    behind_near, behind_far, inside = shown(clip, truth)
    on_surface = (behind_near > -0.002) & (behind_far < 0.002)
    assert on_surface[truth.visible].mean() > 0.97, "a point in sight lies on the surface that is shown"
    hidden = inside & ~truth.visible
    assert hidden.sum() < 30 or (behind_near[hidden] > 0.003).mean() > 0.95, "what hides a point is shown before it"
    assert not truth.visible[~inside].any()
    assert scene_of(tmp_path / family) == family
    assert truth.T_world_cam is not None
    assert truth.role is not None
    away = truth.displacement_m().max(0)
    assert (away[truth.role == Role.OBJECT] > 0.02).any(), "something moves in the world"
    assert away[truth.role == Role.BACKGROUND].max() < 1e-4, "a table stands still before a camera that moves"


def test_a_camera_that_is_carried_leaves_much_of_what_it_saw(tmp_path: Path) -> None:
    clip, truth = film(tmp_path, "tabletop", settings=SMALL.model_copy(update={"camera": "traveling, poses known"}))
    assert clip.T_world_cam is not None
    np.testing.assert_allclose(clip.T_world_cam, truth.T_world_cam, atol=1e-6)
    behind_near, behind_far, inside = shown(clip, truth)
    on_surface = (behind_near > -0.002) & (behind_far < 0.002)
    assert on_surface[truth.visible].mean() > 0.97
    assert np.linalg.norm(clip.T_world_cam[-1, :3, 3] - clip.T_world_cam[0, :3, 3]) > 0.1
    assert inside[0].all()
    assert 0.05 < 1 - inside[-1].mean() < 0.9


def test_poses_may_not_be_known(tmp_path: Path) -> None:
    settings = SMALL.model_copy(update={"camera": "hand-held", "frames": 3})
    clip, truth = film(tmp_path, "plain", settings=settings)
    assert clip.T_world_cam is None
    assert truth.T_world_cam is not None, "what moves is known all the same"


def test_the_seed_decides_everything(tmp_path: Path) -> None:
    for folder, seed in (("a", 5), ("b", 5), ("c", 6)):
        film(tmp_path / folder, "tabletop", seed, FilmSettings(frames=4, size=(80, 60)))
    a, b, c = (files_below(tmp_path / name / "tabletop") for name in "abc")
    assert {k: v[0] for k, v in a.items()} == {k: v[0] for k, v in b.items()}
    assert a["color/000000.png"][0] != c["color/000000.png"][0]


def test_what_is_left_open_is_drawn_anew_for_every_seed(tmp_path: Path) -> None:
    sizes = {film(tmp_path / str(k), "thin", k, FilmSettings(frames=2))[0].camera.width for k in (1, 5)}
    assert len(sizes) > 1


def test_a_film_is_made_once_and_leaves_alone_what_is_not_its_own(tmp_path: Path) -> None:
    film(tmp_path, "plain")
    assert not make_film(tmp_path / "plain", "plain", 3, SMALL)
    (tmp_path / "own").mkdir()
    with pytest.raises(DataError, match="is in the way"):
        make_film(tmp_path / "own", "plain", 3, SMALL)


def test_names_that_do_not_exist(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no family of scenes is called 'tabeltop'; did you mean tabletop"):
        make_film(tmp_path / "x", "tabeltop", 0)
    with pytest.raises(UsageError, match="no sensor is called 'kineckt'; did you mean kinect"):
        make_film(tmp_path / "x", "tabletop", 0, FilmSettings(sensor="kineckt"))
    with pytest.raises(UsageError, match="no camera is called 'travelling'; did you mean traveling"):
        flowlab.grade(scenes="tabletop", camera="travelling", out=tmp_path / "x")
    with pytest.raises(UsageError, match="--camera fixed is of films; give --scenes"):
        flowlab.grade(tasks="push", camera="fixed", out=tmp_path / "x")
    assert not (tmp_path / "x").exists()


def test_two_families_are_held_out_and_the_help_names_all() -> None:
    assert sum(f.held_out for f in FAMILIES.values()) == 2
    assert ", ".join(FAMILIES) == _FAMILIES
    assert list(get_args(CameraMotion)) == _CAMERAS


def test_trackers_are_made_with_seen_families_and_low_seeds_alone() -> None:
    assert {name for name, _ in making_films([0, 999])} == {f.name for f in FAMILIES.values() if not f.held_out}
    with pytest.raises(UsageError, match="seed 1000 is for reporting"):
        making_films([0, 1000])


class TestPaths:
    def test_progress_rests_at_both_ends(self) -> None:
        s = progress(101, 0.2, 0.7)
        assert (s[:21] == 0).all()
        assert np.allclose(s[70:], 1)
        assert s[45] == pytest.approx(0.5)
        assert (np.diff(s) >= 0).all()

    def test_turning_about_a_pivot_keeps_its_distance(self) -> None:
        path = turned(still(place(1, 0, 0), 3), np.array([0, 0, 2.0]), np.array([0, np.pi / 2, np.pi]), np.zeros(3))
        np.testing.assert_allclose(path[:, :3, 3], [[1, 0, 0], [0, 1, 0], [-1, 0, 0]], atol=1e-12)
        np.testing.assert_allclose(path[1, :3, 0], [0, 1, 0], atol=1e-12)

    def test_what_is_carried_keeps_its_place_in_the_hand_and_stays_where_it_is_put(self) -> None:
        hand = turned(
            shifted(still(np.eye(4), 10), np.arange(10)[:, None] * [0.1, 0, 0]), np.eye(3)[2], np.arange(10.0)
        )
        path = carried(still(place(0.5, 0.5, 0), 10), hand, 3, 7)
        held = np.linalg.inv(hand[3:8]) @ path[3:8]
        np.testing.assert_allclose(held, np.broadcast_to(held[0], held.shape), atol=1e-12)
        np.testing.assert_array_equal(path[:3, :3, 3], [[0.5, 0.5, 0]] * 3)
        np.testing.assert_array_equal(path[7:], path[7:8].repeat(3, 0))

    def test_boards_of_a_strip_stay_joined(self) -> None:
        boards = strip(5, 0.03, "plain", still(place(0, 0, 0), 4), np.array([0, 0.1, 0.2, 0.3]))
        ends = [b.path @ place(0.012, 0, 0) for b in boards]
        begins = [b.path @ place(-0.012, 0, 0) for b in boards]
        for end, begin in zip(ends, begins[1:], strict=False):
            np.testing.assert_allclose(end[:, :3, 3], begin[:, :3, 3], atol=1e-12)
        assert boards[-1].path[3, 2, 3] > boards[-1].path[1, 2, 3] > 0, "it curls up"

    def test_a_camera_has_what_it_looks_at_in_the_middle(self) -> None:
        T = look_at(np.array([1.0, -2, 1.5]), np.array([0.2, 0.1, 0.0]))
        seen = np.linalg.inv(T) @ [0.2, 0.1, 0.0, 1]
        np.testing.assert_allclose(seen[:2], 0, atol=1e-12)
        assert seen[2] > 0
        assert T[2, 1] < 0, "its y axis points down"


def test_textures_are_what_they_are_called() -> None:
    rng = np.random.default_rng(0)
    plain, mirrored = make_texture("plain", rng), make_texture("mirrored", rng)
    striped, textured = make_texture("striped", rng), make_texture("textured", rng)
    assert len(np.unique(plain.reshape(-1, 3), axis=0)) == 1
    np.testing.assert_array_equal(mirrored[5, 9], mirrored[-6, -10])
    assert len(np.unique(striped.reshape(-1, 3), axis=0)) == 2
    assert cv2.Laplacian(textured, cv2.CV_32F).std() > 10
