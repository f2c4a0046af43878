"""The sensor's statistics against what its settings say, on surfaces whose depth is known."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from thoroughness import examples

from flowlab.config import SettingsError
from flowlab.sim.sensor import CLEAN, KINECT, PRESETS, Sensor, SensorSettings

HEIGHT, WIDTH = 240, 320


def wall(z: float) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), z, np.float32)


def box_before_wall(near: float = 1.0, far: float = 2.0) -> np.ndarray:
    z = wall(far)
    z[60:180, 80:240] = near
    return z


def edge_pixels() -> np.ndarray:
    """Pixels of :func:`box_before_wall` within one pixel of its edge, on either side."""
    inside = box_before_wall() == 1.0
    grown, shrunk = inside.copy(), inside.copy()
    for dv, du in np.ndindex(3, 3):
        moved = np.roll(inside, (dv - 1, du - 1), (0, 1))
        grown, shrunk = grown | moved, shrunk & moved
    return grown & ~shrunk


def only(**on: Any) -> SensorSettings:
    """A clean sensor with some effects of the Kinect."""
    return CLEAN.model_copy(update=on)


def correlation(noise: np.ndarray, pixels: int) -> float:
    """Of neighbors along a row."""
    return float(np.corrcoef(noise[:, pixels:].ravel(), noise[:, :-pixels].ravel())[0, 1])


@pytest.mark.parametrize("z", [0.5, 1.0, 2.0, 4.0])
def test_depth_noise_grows_with_the_square_of_depth(z: float) -> None:
    sensor = Sensor(only(axial_noise=0.0015, axial_correlation_px=1.0), 0)
    error = np.stack([sensor.depth(wall(z)) - z for _ in range(5)])
    assert error.std() == pytest.approx(0.0015 * z**2, rel=0.03)
    assert abs(error.mean()) < 0.0001 * z**2
    border = np.concatenate([error[:, :2].ravel(), error[:, -2:].ravel()])
    assert border.std() == pytest.approx(0.0015 * z**2, rel=0.1), "no stronger at the border"


def test_neighbors_err_alike() -> None:
    """White noise smoothed by a Gaussian of s pixels correlates as exp(-d^2 / 4 s^2)."""
    error = Sensor(only(axial_noise=0.01, axial_correlation_px=2.0), 0).depth(wall(1)) - 1
    assert correlation(error, 1) == pytest.approx(np.exp(-1 / 16), abs=0.03)
    assert correlation(error, 3) == pytest.approx(np.exp(-9 / 16), abs=0.05)
    white = Sensor(only(axial_noise=0.01, axial_correlation_px=0), 0).depth(wall(1)) - 1
    assert white.std() == pytest.approx(0.01, rel=0.02)
    assert abs(correlation(white, 1)) < 0.02


@pytest.mark.parametrize("z", [0.7, 1.0, 3.0])
def test_depth_comes_in_steps_of_disparity(z: float) -> None:
    """A focal length of 290 px and a baseline of 75 mm, read to a sixteenth of a pixel."""
    slope = np.linspace(z, z * 1.1, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
    read = Sensor(only(inverse_depth_step=KINECT.inverse_depth_step), 0).depth(slope)
    disparity = 290 * 0.075 / np.unique(read).astype(float)
    np.testing.assert_allclose(disparity * 16, np.rint(disparity * 16), atol=1e-3)
    expected_steps = 16 * 290 * 0.075 * (1 / z - 1 / (1.1 * z))
    assert abs(len(disparity) - expected_steps) < 2
    assert np.abs(1 / read - 1 / slope).max() <= KINECT.inverse_depth_step / 2 + 1e-6


def test_edges_wander_and_surfaces_stay() -> None:
    truth = box_before_wall()
    read = Sensor(only(edge_smear_px=0.56), 0).depth(truth)
    assert set(np.unique(read)) == {1.0, 2.0}, "no depth between the two surfaces"
    changed = read != truth
    assert 0.1 < changed[edge_pixels()].mean() < 0.3
    inner = np.zeros_like(changed)
    inner[64:176, 84:236] = True
    assert not changed[inner].any()
    slope = np.linspace(1, 2, WIDTH, dtype=np.float32)[None].repeat(HEIGHT, 0)
    assert (Sensor(only(edge_smear_px=0.56), 0).depth(slope) == slope).all()


def test_holes_at_edges_and_at_random() -> None:
    truth, edge = box_before_wall(), edge_pixels()
    sensor = Sensor(only(edge_holes=0.25, random_holes=0.003), 0)
    hole = np.stack([sensor.depth(truth) == 0 for _ in range(20)])
    assert hole[:, edge].mean() == pytest.approx(0.25 * 0.997 + 0.003, abs=0.01)
    assert hole[:, ~edge].mean() == pytest.approx(0.003, abs=0.0003)
    faint = box_before_wall(near=1.96)  # a step of 2 %
    assert (Sensor(only(edge_holes=1), 0).depth(faint) > 0).all()


def test_blotches_are_rare_and_larger_than_pixels() -> None:
    sensor = Sensor(only(blotch_sigmas=3.0), 0)
    hole = np.stack([sensor.depth(wall(1)) == 0 for _ in range(40)])
    assert hole.mean() == pytest.approx(0.00135, rel=0.25), "the tail of a normal distribution"
    neighbor = hole[:, :, 1:] & hole[:, :, :-1]
    assert neighbor.sum() > 0.4 * hole.sum()


@pytest.mark.parametrize("name", list(PRESETS))
def test_nothing_is_seen_beyond_the_range_or_where_there_is_nothing(name: str) -> None:
    truth = wall(0.9 * PRESETS[name].max_range_m)
    truth[:, :100], truth[:, 100:200] = 0, 6.5
    read = Sensor(PRESETS[name], 0).depth(truth)
    assert (read[:, :98] == 0).all()
    assert (read[:, 102:198] == 0).all()
    assert (read[:, 202:] > 0).mean() > 0.95


def test_a_clean_sensor_changes_nothing() -> None:
    truth = box_before_wall()
    picture = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    sensor = Sensor(CLEAN, 0)
    assert (sensor.depth(truth) == truth).all()
    assert (sensor.rgb(picture) == picture).all()


def test_color_noise_and_flicker() -> None:
    gray = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    noise = Sensor(only(color_noise=3.0), 0).rgb(gray) - 128.0
    assert noise.std() == pytest.approx(3, rel=0.03)
    assert abs(noise.mean()) < 0.05
    sensor = Sensor(only(gain_noise=0.015), 0)
    brightness = [float(sensor.rgb(gray).mean()) for _ in range(200)]
    assert np.std(brightness) == pytest.approx(0.015 * 128, rel=0.2)


@pytest.mark.parametrize(("channel", "weight"), [(0, 0.299), (1, 0.587), (2, 0.114)])
def test_compression_knows_red_from_blue(channel: int, weight: float) -> None:
    """JPEG averages color over 2x2 pixels and keeps brightness, to which each channel adds its own weight."""
    stripes = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    stripes[:, ::2, channel], stripes[:, 1::2, channel] = 128 + 40, 128 - 40
    read = Sensor(only(jpeg_quality=95), 0).rgb(stripes).astype(float)
    ripple = (read[:, ::2] - read[:, 1::2]).mean((0, 1)) / 2
    np.testing.assert_allclose(ripple, 40 * weight, atol=1.5)


def test_the_same_seed_sees_the_same() -> None:
    truth, picture = box_before_wall(), np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    a, b, other = Sensor(KINECT, 7), Sensor(KINECT, 7), Sensor(KINECT, 8)
    first = a.depth(truth)
    assert (first == b.depth(truth)).all()
    assert (a.rgb(picture) == b.rgb(picture)).all()
    assert (first != other.depth(truth)).any()
    assert (first != a.depth(truth)).any(), "every picture has noise of its own"


@settings(max_examples=examples(25), deadline=None)
@given(st.floats(0.2, 8), st.floats(0.2, 8), st.integers(0, 99))
def test_readings_are_sane(near: float, far: float, seed: int) -> None:
    read = Sensor(KINECT, seed).depth(box_before_wall(near, far)[40:100, 60:120])
    assert read.dtype == np.float32
    assert np.isfinite(read).all()
    assert ((read == 0) | ((read > 0.1) & (read <= KINECT.max_range_m))).all()


def test_settings_refuse_nonsense() -> None:
    with pytest.raises(SettingsError):
        SensorSettings(edge_holes=1.5)
    with pytest.raises(ValidationError):
        SensorSettings.model_validate({"edge_hole": 0.1})


def test_stereo_fattens_what_is_near_along_rows() -> None:
    z = box_before_wall()
    read = Sensor(only(fattened_px=3), 0).depth(z)
    assert (read[100, 77:243] == 1).all()
    assert read[100, 76] == 2
    assert read[59, 100] == 2, "windows slide along rows"


def test_stereo_reads_nothing_in_patches_of_what_is_plain() -> None:
    rgb = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    rgb[:, :160] = np.random.default_rng(0).integers(0, 255, (HEIGHT, 160, 3))
    shares = [Sensor(only(plain_holes=0.3), seed).depth(wall(1.0), rgb) == 0 for seed in range(12)]
    holes = np.mean(shares, 0)
    assert holes[:, :150].max() == 0
    assert holes[:, 170:].mean() == pytest.approx(0.3, abs=0.06)


def test_time_of_flight_reads_between_surfaces_at_their_edges() -> None:
    z = box_before_wall()
    read = Sensor(only(flying_pixels=0.5), 0).depth(z)
    flying = (read > 1.001) & (read < 1.999)
    assert not flying[~edge_pixels()].any()
    assert flying[edge_pixels()].mean() == pytest.approx(0.5, abs=0.05)
