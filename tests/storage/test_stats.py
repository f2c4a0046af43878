"""Statistics gathered in parts are those of the whole, as numpy computes them."""

import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import make_dataset, make_episode, make_manifest, with_quality, with_tracks
from thoroughness import examples
from zarr.storage import ZipStore

from flowlab.records import Episode, PositionSource
from flowlab.storage import stats
from flowlab.storage.dataset import Dataset, begin, summarize

ARRAYS: dict[str, Callable[[Episode], np.ndarray | None]] = {
    "point_cloud": lambda e: e.point_cloud,
    "state": lambda e: e.state,
    "action": lambda e: e.action,
    "tracks": lambda e: e.tracks.xyz_world,
    "flow": lambda e: e.tracks.xyz_world[1:] - e.tracks.xyz_world[:-1],
    "object_pose": lambda e: e.object_pose,
}


def check_limits_and_moments(found: dict[str, Any], parts: dict[str, list[np.ndarray]]) -> None:
    """Every array's limits, mean and deviation against numpy over all its rows at once."""
    assert found.keys() == {name for name, a in parts.items() if a}
    for name, values in found.items():
        whole = np.concatenate([a.reshape(-1, a.shape[-1]) for a in parts[name]]).astype(np.float64)
        assert values["count"] == len(whole)
        assert values["min"] == whole.min(0).tolist()
        assert values["max"] == whole.max(0).tolist()
        np.testing.assert_allclose(values["mean"], whole.mean(0), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(values["std"], whole.std(0), rtol=1e-7, atol=1e-10)


@settings(max_examples=examples(40), deadline=None)
@given(
    lengths=st.lists(st.integers(1, 30), min_size=1, max_size=8),
    with_pose=st.lists(st.booleans(), min_size=8, max_size=8),
    offset=st.sampled_from([0.0, 100.0]),
    seed=st.integers(0, 1000),
)
def test_merging_any_split_in_any_order_gives_the_statistics_of_all(
    lengths: list[int], with_pose: list[bool], offset: float, seed: int
) -> None:
    made = [make_episode(seed + k, steps=n, object_pose=with_pose[k]) for k, n in enumerate(lengths)]
    made = [with_tracks(e, e.tracks.xyz_world + np.float32(offset)) for e in made]
    rng = random.Random(seed)
    shuffled = rng.sample(made, len(made))
    cuts = sorted(rng.randrange(len(made) + 1) for _ in range(3))
    groups = [shuffled[a:b] for a, b in zip([0, *cuts], [*cuts, len(made)], strict=True)]
    parts = [stats.summarize(g) for g in groups]  # empty groups among them
    merged = stats.merge(json.loads(json.dumps(parts)))
    found = stats.describe(merged)
    assert found["episodes"] == len(made)
    assert found["frames"] == sum(lengths)
    expected = {name: [a for e in made if (a := of(e)) is not None and a.size] for name, of in ARRAYS.items()}
    check_limits_and_moments(found["arrays"], expected)


steps_m = st.floats(2e-6, 0.9) | st.sampled_from([0.99e-4, 1.01e-4])


@settings(max_examples=examples(60), deadline=None)
@given(st.lists(steps_m, min_size=1, max_size=40) | st.lists(steps_m | st.just(0.0), min_size=1, max_size=40))
def test_motion_is_right_to_6_percent(lengths: list[float]) -> None:
    """One point that makes these steps along x: numpy's quantiles are the truth."""
    xyz = np.zeros((len(lengths) + 1, 1, 3))
    xyz[1:, 0, 0] = np.cumsum(lengths)
    tracks = xyz.astype(np.float32)
    episode = with_tracks(make_episode(steps=len(tracks), queries=1), tracks)
    motion = stats.describe(stats.summarize([episode]))["motion"]
    step = np.linalg.norm(np.diff(tracks, axis=0), axis=-1).ravel().astype(np.float64)
    for q in (50, 90, 95, 99):
        # Between two ranks a rounded q may fall on either.
        low, high = np.quantile(step, [q / 100 - 1e-9, q / 100 + 1e-9], method="inverted_cdf")
        assert 0.94 * low - 1e-6 <= motion["step_m"][f"p{q}"] <= 1.06 * high + 1e-6
    assert motion["still_share"] == np.mean(step < 1e-4)
    assert motion["moving_point_share"] == float(np.abs(tracks - tracks[0]).max() > 0.01)


def test_points_count_as_moving_from_1_cm_on() -> None:
    """Wherever they are at the end: the third returns to where it was."""
    far = np.array([[0.0, 0.0, 0.0], [0.009, 0.011, 0.011], [0.009, 0.011, 0.0]], np.float32)
    tracks = np.zeros((3, 3, 3), np.float32)
    tracks[..., 1] = far
    motion = stats.describe(stats.summarize([with_tracks(make_episode(steps=3, queries=3), tracks)]))["motion"]
    assert motion["moving_point_share"] == pytest.approx(2 / 3)


def test_an_empty_dataset_has_statistics_too(tmp_path: Path) -> None:
    begin(tmp_path, make_manifest({"roll": 3}))
    dataset = summarize(tmp_path)
    assert dataset.stats["episodes"] == dataset.stats["frames"] == 0
    assert dataset.stats["arrays"] == {}
    assert dataset.stats["motion"]["step_m"] == dict.fromkeys(["p50", "p90", "p95", "p99"], 0.0)
    assert json.loads((tmp_path / "stats.json").read_text()) == dataset.stats
    assert "0 episodes" in (tmp_path / "README.md").read_text()


def test_an_episode_of_one_step_has_no_flow() -> None:
    found = stats.describe(stats.summarize([make_episode(steps=1)]))
    assert "flow" not in found["arrays"]
    assert found["motion"] == {
        "still_share": 0.0,
        "moving_point_share": 0.0,
        "step_m": dict.fromkeys(["p50", "p90", "p95", "p99"], 0.0),
    }


def test_flow_does_not_reach_over_the_end_of_an_episode(tmp_path: Path) -> None:
    """The ball jumps back by 10 cm between the two episodes; no statistic may know."""
    flow = make_dataset(tmp_path, [[make_episode(0), make_episode(1)]]).stats["arrays"]["flow"]
    assert max(flow["max"]) < 0.03
    assert min(flow["min"]) > -0.03


def test_statistics_of_a_real_dataset_follow_from_its_arrays(small_dataset: Path) -> None:
    """Read with plain zarr, cut at the stored ends."""
    parts: dict[str, list[np.ndarray]] = {name: [] for name in ARRAYS}
    steps, traveled = [], []
    for path in sorted((small_dataset / "shards").glob("*.zarr.zip")):
        group = zarr.open_group(ZipStore(path, mode="r"), mode="r")
        ends = np.asarray(group["meta/episode_ends"])
        for rows in map(slice, [0, *ends[:-1]], ends):
            for name in ("point_cloud", "state", "action", "tracks", "object_pose"):
                parts[name].append(np.asarray(group[f"data/{name}"])[rows])
            xyz = parts["tracks"][-1]
            parts["flow"].append(xyz[1:] - xyz[:-1])
            steps.append(np.linalg.norm(parts["flow"][-1], axis=-1).ravel())
            traveled.append(np.linalg.norm(xyz - xyz[0], axis=-1).max(0))
    found = json.loads((small_dataset / "stats.json").read_text())
    assert found["episodes"] == 6
    assert found["frames"] == sum(map(len, parts["state"]))
    check_limits_and_moments(found["arrays"], parts)
    step = np.concatenate(steps)
    assert found["motion"]["still_share"] == pytest.approx(np.mean(step < 1e-4), abs=1e-12)
    assert found["motion"]["moving_point_share"] == pytest.approx(np.mean(np.concatenate(traveled) > 0.01))
    for q, value in found["motion"]["step_m"].items():
        truth = np.quantile(step, int(q[1:]) / 100)
        assert truth == pytest.approx(value, rel=0.06, abs=1e-6)
    assert Dataset(small_dataset).stats == found


def test_quality_is_that_of_all_positions_together(tmp_path: Path) -> None:
    made = [with_quality(make_episode(k, steps=5 + 7 * k), k) for k in range(4)]
    found = make_dataset(tmp_path, [made[:1], made[1:3], made[3:]], settings={"track": {"tracker": "by-hand"}}).stats
    quality = [e.tracks.quality for e in made]
    sigma = np.concatenate([q.sigma.ravel() for q in quality if q])
    source = np.concatenate([q.source.ravel() for q in quality if q])
    visible = np.concatenate([e.tracks.visible.ravel() for e in made])
    for name, values in {"sigma_m": sigma, "visible_sigma_m": sigma[visible]}.items():
        for q in (50, 90, 95):
            assert np.quantile(values, q / 100) == pytest.approx(found["quality"][name][f"p{q}"], rel=0.06)
    assert found["quality"]["visible_share"] == pytest.approx(visible.mean())
    shares = {
        s.name.lower(): np.mean(source == s)
        for s in (PositionSource.MEASURED, PositionSource.MODEL, PositionSource.FILLED)
    }
    assert found["quality"]["source_share"] == pytest.approx(shares)
    card = (tmp_path / "README.md").read_text()
    assert "estimated from pictures, by the tracker by-hand" in card
    assert f"{shares['measured']:.0%} are measured, {shares['model']:.0%} are model" in card


def test_exact_tracks_have_no_quality_to_tell_of(small_dataset: Path) -> None:
    assert "quality" not in Dataset(small_dataset).stats
    assert "estimated" not in (small_dataset / "README.md").read_text()
