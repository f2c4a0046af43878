"""Numbers are brought to [-1, 1] and back, lengths alike along all axes, and no motion is zero."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from builders import recorded, tiny_settings
from synthetic import make_dataset, make_episode, with_tracks

from flowlab.data.channels import ChannelSpec, infer_channels
from flowlab.data.normalizer import Normalizer, Scale, fit_normalizer
from flowlab.data.replay_buffer import ReplayBuffer, load_buffer
from flowlab.data.scaler import Scaler
from flowlab.data.source import TrainingSource, open_training_source
from flowlab.data.training_settings import TrainSettings
from flowlab.errors import DataError
from flowlab.records import Episode
from flowlab.storage.dataset import Dataset
from flowlab.storage.exporters.dp3 import DP3Exporter

FIRST = (0, 1, 2)


def open_both(folder: Path, episodes: list[Episode]) -> tuple[TrainingSource, ReplayBuffer]:
    make_dataset(folder, [episodes])
    source = open_training_source(folder)
    return source, load_buffer(source, folder)


def fitted(folder: Path, episodes: list[Episode], *overrides: str, layout: ChannelSpec | None = None) -> Normalizer:
    _, buffer = open_both(folder, episodes)
    return fit_normalizer(buffer, layout or ChannelSpec(), tiny_settings("fdp", *overrides))


def normal(values: np.ndarray, scale: Scale) -> np.ndarray:
    return (values - np.array(scale.offset)) / np.array(scale.unit)


def all_of(episodes: list[Episode], name: str) -> np.ndarray:
    return np.concatenate([getattr(e, name).reshape(-1, getattr(e, name).shape[-1]) for e in episodes])


def test_limits_of_state_and_action_become_one(tmp_path: Path) -> None:
    episodes = [make_episode(k) for k in range(3)]
    found = fitted(tmp_path / "d", episodes)
    for name, scale in (("state", found.state), ("action", found.action)):
        values = normal(all_of(episodes, name), scale)
        np.testing.assert_allclose(values.min(0), -1, atol=1e-6)
        np.testing.assert_allclose(values.max(0), 1, atol=1e-6)


def test_where_scenes_are_turned_displacements_are_alike_in_all_directions(tmp_path: Path) -> None:
    def narrow(e: Episode) -> Episode:
        return replace(e, action=e.action * np.array([0.9, 0.2, 0.5, 1], np.float32))

    episodes = [narrow(make_episode(k)) for k in range(3)]
    layout = ChannelSpec(gripper=FIRST, state_positions=(FIRST,), action_displacement=FIRST)
    _, buffer = open_both(tmp_path / "d", episodes)
    plain, turned = (
        fit_normalizer(buffer, layout, tiny_settings("fdp", f"batch.turn_deg={d}")).action for d in (0, 30)
    )
    largest = np.abs(all_of(episodes, "action")[:, :3]).max()
    np.testing.assert_allclose(turned.unit[:3], largest)
    assert turned.offset[:3] == (0, 0, 0)
    assert (turned.unit[3], turned.offset[3]) == (plain.unit[3], plain.offset[3])
    assert plain.unit[1] < 0.3


def test_what_never_changes_is_centered_and_not_blown_up(tmp_path: Path) -> None:
    def still(e: Episode) -> Episode:
        action = e.action.copy()
        action[:, 1] = 0.7 + np.linspace(0, 5e-5, len(e))
        action[:, 2] = np.linspace(0, 2e-4, len(e))
        return replace(e, action=action)

    found = fitted(tmp_path / "d", [still(make_episode(k)) for k in range(3)]).action
    assert found.unit[1] == 1
    assert found.offset[1] == pytest.approx(0.7, abs=1e-4)
    assert found.unit[2] == pytest.approx(1e-4, rel=1e-3)


def test_points_keep_their_proportions(tmp_path: Path) -> None:
    episodes = [make_episode(k) for k in range(3)]
    found = fitted(tmp_path / "d", episodes).position
    assert found.unit[0] == found.unit[1] == found.unit[2]
    values = normal(all_of(episodes, "point_cloud"), found)
    longest = np.ptp(values, axis=0).argmax()
    np.testing.assert_allclose([values[:, longest].min(), values[:, longest].max()], [-1, 1], atol=1e-6)
    np.testing.assert_allclose(values.min(0), -values.max(0), atol=1e-6, err_msg="the scene lies in the middle")
    assert np.abs(values).max() <= 1 + 1e-6


def test_relative_to_the_gripper_points_have_the_same_unit_and_the_gripper_is_zero(tmp_path: Path) -> None:
    episodes = [make_episode(k) for k in range(3)]
    layout = ChannelSpec(gripper=FIRST, state_positions=(FIRST,))
    absolute = fitted(tmp_path / "a", episodes, layout=layout)
    relative = fitted(tmp_path / "b", episodes, "encoder.relative=true", layout=layout)
    unknown = fitted(tmp_path / "c", episodes, "encoder.relative=true")
    assert relative.position == Scale(offset=(0, 0, 0), unit=absolute.position.unit)
    assert unknown == absolute
    assert relative.action == absolute.action, "displacements are relative as they are"
    assert relative.state == absolute.state


@pytest.mark.parametrize("scale", ["limits", "quantile"])
def test_no_motion_is_zero_and_all_axes_are_alike(tmp_path: Path, scale: str) -> None:
    found = fitted(tmp_path / "d", [make_episode(k) for k in range(3)], f"motion.scale={scale}").flow
    assert found.offset == (0, 0, 0)
    assert found.unit[0] == found.unit[1] == found.unit[2]
    scaler = Scaler(found)
    assert torch.equal(scaler(torch.zeros(2, 3)), torch.zeros(2, 3))
    assert torch.equal(scaler.invert(torch.zeros(2, 3)), torch.zeros(2, 3))


def flow_of(episodes: list[Episode]) -> np.ndarray:
    return np.concatenate([np.diff(e.tracks.xyz_world, axis=0).reshape(-1, 3) for e in episodes])


def test_with_limits_the_largest_component_of_flow_is_one(tmp_path: Path) -> None:
    episodes = [make_episode(k) for k in range(3)]
    found = fitted(tmp_path / "d", episodes, "motion.scale=limits", "motion.clip=7.0")
    assert np.abs(normal(flow_of(episodes), found.flow)).max() == pytest.approx(1, rel=1e-6)
    assert found.flow_clip == 1


def hasty(seed: int) -> Episode:
    """Every point moves faster and faster, each step by 2 % more: from 0.1 mm to 4 cm; at last it jumps by 30 cm."""
    e = make_episode(seed, steps=302)
    length = np.append(1e-4 * 1.02 ** np.arange(300), 0.3)
    x = np.append(0, np.cumsum(length))
    tracks = np.zeros_like(e.tracks.xyz_world)
    tracks[..., 1] = -x[:, None]
    return with_tracks(e, tracks)


def test_with_a_quantile_rare_jumps_do_not_decide(tmp_path: Path) -> None:
    episodes = [hasty(k) for k in range(3)]
    found = fitted(tmp_path / "d", episodes, "motion.scale=quantile", "motion.clip=2.5")
    length = np.linalg.norm(flow_of(episodes), axis=1)
    assert np.quantile(length, 0.95) < 0.9 * np.quantile(length, 0.98)
    assert found.flow.unit[0] == pytest.approx(np.quantile(length, 0.99), rel=0.07)
    assert found.flow_clip == 2.5
    limits = fitted(tmp_path / "e", episodes, "motion.scale=limits")
    assert limits.flow.unit[0] == pytest.approx(0.3, rel=1e-3)


@pytest.mark.parametrize("scale", ["limits", "quantile"])
def test_a_scene_in_which_nothing_moves_is_not_blown_up(tmp_path: Path, scale: str) -> None:
    e = make_episode()
    still = with_tracks(e, np.repeat(e.tracks.xyz_world[:1], len(e), 0))
    found = fitted(tmp_path / "d", [still, replace(still, seed=1), replace(still, seed=2)], f"motion.scale={scale}")
    assert found.flow.unit == (1e-4,) * 3


def test_without_flow_there_is_a_normalizer_too(tmp_path: Path) -> None:
    make_dataset(tmp_path / "d", [[make_episode(k) for k in range(3)]])
    DP3Exporter().export(Dataset(tmp_path / "d"), tmp_path / "s.zarr")
    source = open_training_source(tmp_path / "s.zarr")
    settings = tiny_settings("dp3")
    found = fit_normalizer(load_buffer(source, tmp_path), ChannelSpec(), settings)
    dataset = open_training_source(tmp_path / "d")
    wanted = fit_normalizer(load_buffer(dataset, tmp_path), ChannelSpec(), settings)
    for name in ("position", "state", "action"):
        assert getattr(found, name) == getattr(wanted, name), name


def relative_actions(buffer: ReplayBuffer, s: TrainSettings) -> np.ndarray:
    """Every action of every window, seen from the gripper as it is when the window is decided on."""
    found = []
    for d in buffer.episodes:
        for now in range(d.start, d.stop):
            for row in range(now - s.n_obs_steps + 1, now - s.n_obs_steps + 1 + s.horizon):
                action = buffer.action[min(max(row, d.start), d.stop - 1)].copy()
                action[:3] -= buffer.state[now, :3]
                found.append(action)
    return np.array(found)


@pytest.mark.parametrize("overrides", [(), ("n_obs_steps=3",), ("horizon=16",)])
def test_limits_of_actions_relative_to_the_gripper_are_those_of_all_windows(
    tmp_path: Path, overrides: tuple[str, ...]
) -> None:
    episodes = [recorded(k) for k in range(3)]
    source, buffer = open_both(tmp_path / "d", episodes)
    layout = infer_channels(source, buffer)
    assert layout.action_position == FIRST
    settings = tiny_settings("dp3", "encoder.relative=true", *overrides)
    found = fit_normalizer(buffer, layout, settings).action
    values = normal(relative_actions(buffer, settings), found)
    moving = np.array(found.unit) != 1  # the hand goes neither sideways nor up
    assert moving.tolist() == [True, False, False, True, True, True, True, True]
    np.testing.assert_allclose(values.min(0)[moving], -1, atol=1e-5)
    np.testing.assert_allclose(values.max(0)[moving], 1, atol=1e-5)
    assert np.abs(values[:, ~moving]).max() < 1e-4
    absolute = fit_normalizer(buffer, layout, tiny_settings("dp3", *overrides)).action
    np.testing.assert_allclose(normal(buffer.action, absolute).max(0)[[0, *range(3, 8)]], 1, atol=1e-5)


def test_there_and_back() -> None:
    scaler = Scaler(Scale(offset=(1, -2, 3), unit=(0.5, 4, 0.1)))
    values = torch.randn(5, 2, 3)
    torch.testing.assert_close(scaler.invert(scaler(values)), values)
    found = scaler(torch.tensor([1.5, 2, 2.9]))
    torch.testing.assert_close(found, torch.tensor([1.0, 1, -1]), rtol=1e-5, atol=1e-5)
    assert not scaler.state_dict(), "its numbers are kept with the settings"


@pytest.mark.parametrize("field", ["state", "action", "point_cloud", "tracks"])
def test_what_is_no_number_is_refused(field: str, tmp_path: Path) -> None:
    """A single one is enough, which a dataset's own statistics may not tell of."""
    _, buffer = open_both(tmp_path / "d", [make_episode(k) for k in range(2)])
    values = np.array(getattr(buffer, field))
    values.reshape(-1)[-5] = np.nan
    with pytest.raises(DataError, match=f"'{field}' has values that are not finite; 'flowlab validate' tells where"):
        fit_normalizer(replace(buffer, **{field: values}), ChannelSpec(), tiny_settings("fdp"))


@pytest.mark.parametrize("scale", ["limits", "quantile"])
def test_scales_are_those_of_the_datas_statistics_bit_for_bit(scale: str, tmp_path: Path) -> None:
    """And of the data themselves: what receipts say of them changes nothing."""
    source, buffer = open_both(tmp_path / "d", [make_episode(k) for k in range(3)])
    stats = Dataset(source.path).stats
    settings = tiny_settings("fdp", f"motion.scale={scale}")
    found = fit_normalizer(buffer, ChannelSpec(), settings)
    for name in ("state", "action"):
        assert getattr(found, name) == Scale.of_limits(stats["arrays"][name]["min"], stats["arrays"][name]["max"])
    largest = max(map(abs, [*stats["arrays"]["flow"]["min"], *stats["arrays"]["flow"]["max"]]))
    assert found.flow is not None
    assert found.flow.unit[0] == (largest if scale == "limits" else min(stats["motion"]["step_m"]["p99"], largest))
    for path in (source.path / "receipts").iterdir():
        path.write_text(path.read_text().replace('"max": [', '"max": [1000').replace('"steps": [', '"steps": [9'))
    assert fit_normalizer(load_buffer(source, tmp_path), ChannelSpec(), settings) == found
