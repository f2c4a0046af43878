"""Tables and outliers are removed, and nothing else: scenes made by hand, so what belongs to what is known."""

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from thoroughness import examples

from flowlab.config import SettingsError
from flowlab.errors import MissingLibraryError
from flowlab.geometry.camera import Camera
from flowlab.perception.cleaning import OutlierSettings, TableSettings, outlier_mask, table_mask
from flowlab.perception.observer import Box, Observer, ObserverSettings
from flowlab.records import Frame

EYE = np.array([0.1, -0.2, 0.8])
"""Above the table, which is z = 0."""


def scene(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A noisy table top, a box on it, and clutter below it; which of these each point is (0, 1, 2)."""
    rng = np.random.default_rng(seed)
    table = np.append(rng.uniform(-0.4, 0.4, (3000, 2)), rng.normal(0, 0.002, (3000, 1)), 1)
    box = rng.uniform([-0.05, -0.05, 0.015], [0.05, 0.05, 0.1], (800, 3))
    below = rng.uniform([-0.4, -0.4, -0.5], [0.4, 0.4, -0.02], (400, 3))
    parts = (table, box, below)
    return np.concatenate(parts), np.repeat([0, 1, 2], [len(p) for p in parts])


@settings(max_examples=examples(25), deadline=None, derandomize=True)
@given(st.integers(0, 10**6))
def test_what_stands_on_the_table_stays_and_the_rest_goes_wherever_the_table_is(seed: int) -> None:
    xyz, kind = scene(seed)
    turn, shift = Rotation.random(random_state=seed), np.random.default_rng(seed).uniform(-1, 1, 3)
    kept = ~table_mask(
        (turn.apply(xyz) + shift).astype(np.float32), turn.apply(EYE) + shift, TableSettings(distance_m=0.01)
    )
    np.testing.assert_array_equal(kept, kind == 1)


def test_the_distance_is_how_far_above_the_table_things_begin() -> None:
    """A stack of levels above a flat table."""
    rng = np.random.default_rng(0)
    table = np.append(rng.uniform(-0.4, 0.4, (3000, 2)), np.zeros((3000, 1)), 1)
    levels = np.array([[0, 0, z] for z in (0.004, 0.019, 0.021, 0.3)])
    kept = ~table_mask(np.concatenate([table, levels]), EYE, TableSettings(distance_m=0.02))
    assert kept[-4:].tolist() == [False, False, True, True]


def test_the_same_cloud_gives_the_same_table() -> None:
    """Few trials and no plane in it: chance decides, and the seed decides on chance."""
    xyz = np.random.default_rng(1).uniform(-1, 1, (2000, 3))
    found = [table_mask(xyz, EYE, TableSettings(trials=3, min_share=0, seed=s)) for s in (4, 4, 5)]
    np.testing.assert_array_equal(found[0], found[1])
    assert (found[0] != found[2]).any()


def test_a_scene_without_a_table_keeps_everything() -> None:
    xyz = np.random.default_rng(0).uniform(-1, 1, (2000, 3))
    assert not table_mask(xyz, EYE, TableSettings()).any()
    assert table_mask(xyz, EYE, TableSettings(min_share=0.0)).any()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_clouds_too_small_for_a_plane_are_kept(count: int) -> None:
    assert not table_mask(np.zeros((count, 3), np.float32), EYE, TableSettings()).any()
    assert len(outlier_mask(np.zeros((count, 3), np.float32), OutlierSettings())) == count


@pytest.mark.parametrize(("neighbors", "std_ratio"), [(3, 0.2), (12, 1.5)])
def test_outliers_go_by_the_rule_that_is_stated(neighbors: int, std_ratio: float) -> None:
    """The mean distance to the nearest neighbors, against its mean and deviation over the cloud."""
    rng = np.random.default_rng(3)
    xyz = np.concatenate([rng.normal(0, 0.05, (2000, 3)), rng.uniform(-2, 2, (40, 3))])
    kept = ~outlier_mask(xyz, OutlierSettings(neighbors=neighbors, std_ratio=std_ratio))
    distance = np.asarray(cKDTree(xyz).query(xyz, k=neighbors)[0]).mean(1)  # Open3D counts the point itself
    np.testing.assert_array_equal(kept, distance < distance.mean() + std_ratio * distance.std(ddof=1))
    assert kept[:2000].mean() > 0.9
    assert kept[2000:].mean() < 0.1


def look_down() -> tuple[Frame, np.ndarray]:
    """A camera 80 cm above a table with a box on it, and one stray reading in mid-air; the box's pixels."""
    T = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.8], [0, 0, 0, 1]])
    camera = Camera.from_fovy(80, 60, 50.0, T)
    depth = np.full((60, 80), 0.8, np.float32)
    depth += np.random.default_rng(0).normal(0, 0.001, depth.shape).astype(np.float32)
    box = np.zeros(depth.shape, bool)
    box[20:35, 30:50] = True
    depth[box] -= 0.1
    depth[5, 70] = 0.35
    return Frame(depth, camera), np.flatnonzero(box)


def test_the_observer_clears_its_clouds_as_told() -> None:
    frame, box = look_down()
    plain = {"crop": Box(low=(-2, -2, -2), high=(2, 2, 2))}
    stray = 5 * 80 + 70

    def pixels(**values: object) -> set[int]:
        cloud = Observer(ObserverSettings.model_validate({**plain, **values}), "x").cloud(frame)
        uv = np.stack([cloud.pixel % 80, cloud.pixel // 80], -1)
        again = frame.camera.unproject(uv, frame.depth.reshape(-1)[cloud.pixel])
        np.testing.assert_allclose(cloud.xyz_world, again, atol=1e-6)
        return set(cloud.pixel.tolist())

    assert len(pixels()) == 80 * 60
    assert pixels(remove_table=True) == {*box.tolist(), stray}
    assert pixels(remove_outliers=True) >= set(box.tolist()) - {stray}
    assert stray not in pixels(remove_outliers=True)
    assert pixels(remove_table=True, remove_outliers={"neighbors": 8}) == set(box.tolist())


def test_options_are_switched_on_and_off_in_words() -> None:
    assert ObserverSettings(remove_table=True).remove_table == TableSettings()  # type: ignore[arg-type]
    assert ObserverSettings(remove_table=False, remove_outliers=None) == ObserverSettings()  # type: ignore[arg-type]
    assert ObserverSettings(remove_outliers={"neighbors": 5}).remove_outliers == OutlierSettings(neighbors=5)  # type: ignore[arg-type]
    with pytest.raises(SettingsError, match="remove_table"):
        ObserverSettings(remove_table="yes")  # type: ignore[arg-type]


def test_where_open3d_cannot_be_loaded_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingLibraryError, match=r"apt-get install libusb-1\.0-0"):
        outlier_mask(np.zeros((9, 3)), OutlierSettings())


def test_open3d_is_not_loaded_unless_it_is_needed() -> None:
    code = (
        "import sys, numpy as np; from flowlab.perception.observer import *\n"
        "from flowlab.geometry.camera import Camera\n"
        "frame = Frame(np.ones((4, 5), np.float32), Camera(5, 4, np.eye(3), np.eye(4)))\n"
        "Observer(ObserverSettings(), 'x').cloud(frame)\n"
        "print('open3d' in sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["False"]
