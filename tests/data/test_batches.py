"""Batches hold what the definitions say: compared with slow loops over demonstrations."""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from builders import HAND, every_window, random_buffer, tiny_settings
from hypothesis import given, settings
from hypothesis import strategies as st
from thoroughness import examples

from flowlab.data.batch_builder import BatchBuilder
from flowlab.data.batches import Batch, ObservationBatch
from flowlab.data.channels import ChannelSpec
from flowlab.data.needs import CloudNeeds, FlowNeeds, Needs
from flowlab.data.query_subset import choose_queries
from flowlab.data.replay_buffer import ReplayBuffer
from flowlab.data.training_settings import BatchSettings, TrainSettings
from flowlab.data.window_sampler import WindowIndex, WindowSampler, index_windows
from flowlab.errors import DataError, UsageError
from flowlab.policies.settings import FDPSettings
from flowlab.records import Role

HISTORY, HORIZON = 2, 8


def builder(
    settings: TrainSettings, buffer: ReplayBuffer | None = None, layout: ChannelSpec | None = None
) -> BatchBuilder:
    buffer = buffer or random_buffer()
    return BatchBuilder(buffer, layout or ChannelSpec(), settings, buffer.tasks)


class EverySettings(FDPSettings):
    """Of a policy that needs whatever fdp needs, and the object's pose."""

    @property
    def needs(self) -> Needs:
        return replace(super().needs, object_pose=True)


def fdp(*overrides: str) -> Any:
    return EverySettings.model_validate(tiny_settings("fdp", *overrides).model_dump())


# Which windows there are.


def test_windows_are_those_of_dp3() -> None:
    """DP3 pads a demonstration by one step in front and seven behind, and takes every sequence of 16: 193 of 200."""
    for length in (200, 60, 16, 9):
        padded = 1 + length + 7
        buffer = random_buffer([("push", length)], points=1, queries=1)
        windows = index_windows(buffer, [0], n_action_steps=8)
        assert len(windows.now) == padded - 16 + 1
        assert windows.now.tolist() == list(range(length - 7))


def test_windows_of_chosen_demonstrations_lie_in_them() -> None:
    buffer = random_buffer([("a", 14), ("a", 9), ("b", 2), ("b", 11)])
    windows = index_windows(buffer, [3, 2, 0], n_action_steps=4)
    found = list(zip(windows.episode.tolist(), windows.now.tolist(), strict=True))
    # The third has 2 steps, fewer than are executed, and still a window.
    assert found == [(3, 25 + k) for k in range(8)] + [(2, 23)] + [(0, k) for k in range(11)]


def numbered(count: int) -> WindowIndex:
    return WindowIndex(np.arange(count) // 10, np.arange(count), np.zeros(count, int))


@settings(max_examples=examples(80), deadline=None, derandomize=True)
@given(
    count=st.integers(1, 60),
    segment=st.integers(1, 9),
    runs=st.integers(1, 6),
    seed=st.integers(0, 5),
    first_epoch=st.integers(0, 3),
)
def test_an_epoch_deals_out_every_run_once(count: int, segment: int, runs: int, seed: int, first_epoch: int) -> None:
    sampler = WindowSampler(numbered(count), runs * segment, segment, seed)
    segment = min(segment, count)
    per_epoch = count // segment
    assert sampler.steps_per_epoch == pytest.approx(per_epoch / runs)
    first_run = first_epoch * per_epoch
    first_step, last_step = first_run // runs, (first_run + per_epoch - 1) // runs
    dealt = []
    for step in range(first_step, last_step + 1):
        windows = sampler.windows(step)
        assert len(windows.now) == runs * segment
        assert (windows.episode == windows.now // 10).all(), "a window lost its demonstration"
        for r in range(runs):
            run = windows.now[windows.run == r]
            # Consecutive; what lies behind the last window is the first.
            assert run.tolist() == [(run[0] + k) % count for k in range(segment)]
            dealt.append(run.tolist())
    begin = first_run - first_step * runs
    seen = Counter(x for run in dealt[begin : begin + per_epoch] for x in run)
    assert set(seen.values()) == {1}
    assert len(seen) == count - count % segment


def test_every_window_is_seen_once_an_epoch_where_windows_are_dealt_singly() -> None:
    sampler = WindowSampler(numbered(50), 5, 1, seed=0)
    for epoch in range(3):
        seen = np.concatenate([sampler.windows(10 * epoch + k).now for k in range(10)])
        assert sorted(seen) == list(range(50))
        assert seen.tolist() != sorted(seen)


def test_epochs_cut_and_shuffle_differently() -> None:
    sampler = WindowSampler(numbered(50), 10, 10, seed=0)
    starts = [[int(sampler.windows(5 * epoch + k).now[0]) for k in range(5)] for epoch in range(8)]
    assert len({min(s % 10 for s in epoch) for epoch in starts}) > 3
    assert len({tuple(epoch) for epoch in starts}) == 8


def test_windows_are_a_function_of_seed_and_step() -> None:
    def at(seed: int, step: int) -> list[int]:
        return WindowSampler(numbered(100), 16, 4, seed).windows(step).now.tolist()

    assert at(0, 7) == at(0, 7)
    assert at(0, 7) != at(0, 8)
    assert at(0, 7) != at(1, 7)
    together = WindowSampler(numbered(100), 16, 4, 0)
    for step in (9, 2, 7):
        assert together.windows(step).now.tolist() == at(0, step)


# What they hold.


def expected(buffer: ReplayBuffer, s: Any, demo: int, now: int) -> dict[str, np.ndarray]:
    """One window, by its definition; weights are not yet brought to a mean of 1."""
    d = buffer.episodes[demo]
    frames = [max(now - back, d.start) for back in reversed(range(s.n_obs_steps))]
    chosen = choose_queries(buffer, s.needs.flow)[demo]
    rows: dict[str, list[Any]] = {n: [] for n in ("action", "action_weight", "flow", "flow_weight", "object_pose")}
    for k in range(s.horizon):
        row = now - (s.n_obs_steps - 1) + k
        inside = d.start <= row < d.stop
        there = min(max(row, d.start), d.stop - 1)
        rows["action"].append(buffer.action[there])
        rows["object_pose"].append(buffer.object_pose[there])
        rows["action_weight"].append(float(inside or s.batch.pad))
        flow, weight = np.zeros((len(chosen), 3), np.float32), np.zeros(len(chosen))
        for m, q in enumerate(chosen):
            if d.start <= row < d.stop - 1:
                flow[m] = buffer.tracks[row + 1, q] - buffer.tracks[row, q]
                weight[m] = min(
                    (1.0 if buffer.visible[r, q] else s.motion.occluded_weight)
                    / (1 + (buffer.sigma[r, q] / s.motion.sigma_m) ** 2)
                    for r in (row, row + 1)
                )
        rows["flow"].append(flow)
        rows["flow_weight"].append(weight)
    return {name: np.stack(values) for name, values in rows.items()} | {
        "points": buffer.point_cloud[frames, : s.encoder.points],
        "state": buffer.state[frames],
        "queries": buffer.queries[demo, chosen],
        "task": np.array(buffer.tasks.index(d.task)),
    }


def of_window(batch: Batch, w: int) -> dict[str, np.ndarray]:
    names = ("action", "action_weight", "flow", "flow_weight", "object_pose", "queries", "task")
    found = {name: getattr(batch, name)[w].numpy() for name in names}
    return found | {name: getattr(batch, name)[batch.observed[w]].numpy() for name in ("points", "state")}


@pytest.mark.parametrize(
    "overrides",
    [
        (),
        ("n_obs_steps=1",),
        ("n_obs_steps=3", "encoder.points=5", "motion.points=3"),
        ("motion.occluded_weight=0.0", "motion.sigma_m=0.002"),
        ("motion.occluded_weight=1.0", "motion.sampling=object", "motion.points=2"),
        ("horizon=16", "n_action_steps=15"),
    ],
)
def test_a_batch_holds_what_the_definitions_say(overrides: tuple[str, ...]) -> None:
    buffer, s = random_buffer(), fdp(*overrides)
    windows = every_window(buffer, s)
    batch = builder(s, buffer).build(windows)
    wanted = [expected(buffer, s, d, n) for d, n in zip(windows.episode, windows.now, strict=True)]
    for name in ("action_weight", "flow_weight"):
        mean = np.mean([w[name] for w in wanted])
        for w in wanted:
            w[name] = w[name] / mean
        assert getattr(batch, name).mean() == pytest.approx(1, rel=1e-5)
    for w in range(len(windows.now)):
        found = of_window(batch, w)
        assert found.keys() == wanted[w].keys()
        for name, values in wanted[w].items():
            np.testing.assert_allclose(found[name], values, rtol=1e-5, atol=1e-7, err_msg=f"{name} of window {w}")


def test_padding_counts_repeated_actions_and_no_more_flow() -> None:
    buffer, s = random_buffer(), fdp("batch.pad=true")
    windows = every_window(buffer, s)
    batch, without = builder(s, buffer).build(windows), builder(fdp(), buffer).build(windows)
    assert (batch.action_weight == 1).all()
    assert (without.action_weight == 0).any()
    assert torch.equal(batch.action, without.action)
    for name in ("flow", "flow_weight"):
        assert torch.equal(getattr(batch, name), getattr(without, name)), name


def test_other_policies_need_no_queries() -> None:
    buffer = replace(
        random_buffer(queries=1),
        tracks=np.zeros((34, 0, 3), np.float32),
        visible=np.zeros((34, 0), bool),
        sigma=np.zeros((34, 0), np.float32),
        queries=np.zeros((3, 0, 3), np.float32),
        query_role=np.zeros((3, 0), int),
        query_count=np.zeros((3, 1), int),
    )
    for policy in ("dp3", "mba"):
        s = tiny_settings(policy)
        batch = builder(s, buffer).build(every_window(buffer, s), np.random.default_rng(0))
        assert batch.flow.shape == (25, HORIZON, 0, 3)
        assert batch.flow_weight.shape == (25, HORIZON, 0)
        assert batch.queries.shape == (25, 0, 3)


def test_windows_of_a_run_share_frames_and_runs_do_not() -> None:
    buffer, s = random_buffer(), fdp()
    demo, now = np.zeros(8, int), np.array([4, 5, 6, 7, 5, 6, 7, 8])
    batch = builder(s, buffer).build(WindowIndex(demo, now, np.repeat([0, 1], 4)))
    assert len(batch.points) == len(batch.state) == 5 + 5
    assert set(batch.observed[:4].flatten().tolist()).isdisjoint(batch.observed[4:].flatten().tolist())
    for w, row in enumerate(now):
        np.testing.assert_array_equal(batch.state[batch.observed[w]], buffer.state[[row - 1, row]])


def test_a_run_is_shifted_as_a_whole_with_all_that_has_a_place() -> None:
    buffer, s = random_buffer(), fdp("batch.shift_m=0.1")
    windows = WindowSampler(every_window(buffer, s), 24, 4, seed=0).windows(0)
    plain = builder(s, buffer, HAND).build(windows)
    shifted = builder(s, buffer, HAND).build(windows, np.random.default_rng(0))
    shift = np.empty((6, 3), np.float32)
    for run in range(6):
        of_run = np.flatnonzero(windows.run == run)
        frames = np.unique(plain.observed[of_run])
        by = {
            "points": (shifted.points - plain.points)[frames],
            "gripper": (shifted.state - plain.state)[frames][:, :3],
            "another place": (shifted.state - plain.state)[frames][:, 3:6],
            "queries": (shifted.queries - plain.queries)[of_run],
            "pose": (shifted.object_pose - plain.object_pose)[of_run][..., :3],
            "action": (shifted.action - plain.action)[of_run][..., :3],
        }
        shift[run] = by["points"][0, 0]
        for name, moved in by.items():
            wanted = np.broadcast_to(shift[run], moved.shape)
            np.testing.assert_allclose(moved, wanted, atol=1e-6, err_msg=name)
    assert np.abs(shift[:, 2]).max() < 1e-7, "scenes stay on the table"
    assert np.abs(shift).max() <= 0.1
    assert np.abs(shift[:, :2]).max(0).min() > 0.05
    assert len(np.unique(shift[:, :2])) == 12, "every run goes elsewhere, in x and in y"
    for name in ("flow", "flow_weight", "action_weight", "observed", "task"):
        assert torch.equal(getattr(shifted, name), getattr(plain, name)), name
    for name, columns in (("state", slice(6, None)), ("action", slice(3, None)), ("object_pose", slice(3, None))):
        assert torch.equal(getattr(shifted, name)[..., columns], getattr(plain, name)[..., columns]), name


ALL_PLACES = ChannelSpec(
    gripper=(0, 1, 2), state_positions=((0, 1, 2), (3, 4, 5), (6, 7, 8)), action_displacement=(0, 1, 2)
)


def test_a_run_is_turned_as_a_whole_about_where_the_gripper_usually_is() -> None:
    buffer, s = random_buffer(), fdp("batch.turn_deg=60", "batch.shift_m=0.1")
    windows = WindowSampler(every_window(buffer, s), 24, 4, seed=0).windows(0)
    plain = builder(s, buffer, ALL_PLACES).build(windows)
    turned = builder(s, buffer, ALL_PLACES).build(windows, np.random.default_rng(0))
    center, angles = buffer.state[:, :3].mean(0), []
    for run in range(6):
        of_run = np.flatnonzero(windows.run == run)
        frames = np.unique(plain.observed[of_run])
        here, there = plain.points[frames].numpy(), turned.points[frames].numpy()
        (x, y, _), (u, v, _) = here[0, 1] - here[0, 0], there[0, 1] - there[0, 0]
        angles.append(np.angle((u + 1j * v) / (x + 1j * y)))
        R = np.eye(3)
        R[:2, :2] = [[np.cos(angles[-1]), -np.sin(angles[-1])], [np.sin(angles[-1]), np.cos(angles[-1])]]
        shift = there[0, 0] - center - R @ (here[0, 0] - center)
        assert np.abs(shift).max() <= 0.1
        assert abs(shift[2]) < 1e-6
        places = {"points": frames, "state": frames, "queries": of_run, "object_pose": of_run}
        directions = {"flow": slice(None), "action": slice(0, 3), "object_pose": slice(3, None)}
        for name, rows in places.items():
            width = 3 if name == "object_pose" else None
            before, after = (getattr(b, name)[rows].numpy()[..., :width] for b in (plain, turned))
            before, after = before.reshape(-1, 3), after.reshape(-1, 3)
            np.testing.assert_allclose(after, (before - center) @ R.T + center + shift, atol=1e-5, err_msg=name)
        for name, columns in directions.items():
            before, after = (getattr(b, name)[of_run].numpy()[..., columns].reshape(-1, 3) for b in (plain, turned))
            np.testing.assert_allclose(after, before @ R.T, atol=1e-5, err_msg=name)
    assert np.degrees(np.abs(angles)).max() <= 60
    assert np.degrees(np.ptp(angles)) > 30
    assert torch.equal(turned.action[..., 3:], plain.action[..., 3:])
    assert torch.equal(turned.flow_weight, plain.flow_weight)


@pytest.mark.parametrize("unknown", ["state", "action"])
def test_where_not_every_direction_is_known_nothing_is_turned(unknown: str) -> None:
    """The last numbers of the state, or of the action, might be a quaternion: the scene is shifted, but not turned."""
    buffer, s = random_buffer(), fdp("batch.turn_deg=60", "batch.shift_m=0.1")
    layout = HAND if unknown == "state" else ALL_PLACES
    if unknown == "action":
        buffer = replace(buffer, action=np.tile(buffer.action, (1, 2)))
    windows = every_window(buffer, s)
    plain, moved = (builder(s, buffer, layout).build(windows, rng) for rng in (None, np.random.default_rng(0)))
    torch.testing.assert_close(moved.flow, plain.flow)
    shift = (moved.points - plain.points).flatten(0, 1)
    torch.testing.assert_close(shift, shift[:1].expand_as(shift), rtol=1e-4, atol=1e-6)
    assert shift.abs().max() > 0.01


@pytest.mark.parametrize("known", [(), ("gripper",), ("action_displacement",)])
def test_a_scene_stays_where_nobody_knows_what_its_actions_would_be_elsewhere(known: tuple[str, ...]) -> None:
    buffer, s = random_buffer(), fdp("batch.shift_m=0.1")
    channels = ChannelSpec(**dict.fromkeys(known, (0, 1, 2)))
    windows = every_window(buffer, s)
    plain, shifted = (builder(s, buffer, channels).build(windows, rng) for rng in (None, np.random.default_rng(0)))
    for name in ("state", "action", "queries", "flow"):
        torch.testing.assert_close(getattr(shifted, name), getattr(plain, name))
    assert torch.equal(shifted.points, plain.points)


def test_variation_is_a_function_of_the_generator_and_leaves_the_corpus_alone() -> None:
    buffer, s = random_buffer(), fdp("batch.shift_m=0.1", "encoder.subset=7", "motion.subset=3")
    before = {
        name: getattr(buffer, name).copy() for name in ("point_cloud", "state", "action", "object_pose", "queries")
    }
    windows = every_window(buffer, s)
    a, b, c = (builder(s, buffer, HAND).build(windows, np.random.default_rng(seed)) for seed in (0, 0, 1))
    for name in ("points", "state", "queries", "action", "flow", "flow_weight", "object_pose"):
        assert torch.equal(getattr(a, name), getattr(b, name)), name
        assert not torch.equal(getattr(a, name), getattr(c, name)), name
    for name, values in before.items():
        assert np.array_equal(getattr(buffer, name), values), name


def columns(part: np.ndarray, whole: np.ndarray) -> list[int]:
    """Which columns of ``whole`` (R, N, 3) are those of ``part`` (R, n, 3), the same in every row."""
    index = [np.flatnonzero((whole == part[:, k, None]).all((0, 2))) for k in range(part.shape[1])]
    assert all(len(i) == 1 for i in index)
    return [int(i[0]) for i in index]


def test_random_points_and_queries_are_trained_on() -> None:
    buffer, s = random_buffer(), fdp("encoder.points=20", "encoder.subset=7", "motion.subset=3")
    windows = every_window(buffer, s)
    make = builder(s, buffer)
    whole = make.build(windows)
    assert whole.points.shape[1] == 20, "only training varies"
    assert whole.queries.shape[1] == 6
    seen_points, seen_queries = set(), set()
    for seed in range(20):
        batch = make.build(windows, np.random.default_rng(seed))
        points = columns(batch.points.numpy(), whole.points.numpy())
        queries = columns(batch.queries.numpy(), whole.queries.numpy())
        assert (len(set(points)), len(set(queries))) == (7, 3)
        assert torch.equal(batch.flow, whole.flow[:, :, queries])
        weight = whole.flow_weight[:, :, queries]
        torch.testing.assert_close(batch.flow_weight, weight / weight.mean())
        seen_points |= set(points)
        seen_queries |= set(queries)
    assert seen_points == set(range(20))
    assert seen_queries == set(range(6))


def test_how_many_points_are_trained_on_may_be_random_too() -> None:
    buffer, s = random_buffer(), fdp("encoder.points=20", "encoder.subset=5", "encoder.subset_most=20")
    windows, make = every_window(buffer, s), builder(s, buffer)
    count = [make.build(windows, np.random.default_rng(seed)).points.shape[1] for seed in range(200)]
    assert (min(count), max(count)) == (5, 20)
    assert 80 < sum(n < 10 for n in count) < 120, "as often by halves as by doubles"
    assert make.build(windows).points.shape[1] == 20
    for most in (4, 21):
        with pytest.raises(UsageError, match=rf"subset_most is from subset \(5\) to points \(20\); found {most}"):
            fdp("encoder.points=20", "encoder.subset=5", f"encoder.subset_most={most}")
    with pytest.raises(UsageError, match="subset_most=9 needs the least number"):
        fdp("encoder.subset=null", "encoder.subset_most=9")


def test_channels_are_never_a_subset_since_each_has_its_query() -> None:
    buffer, s = random_buffer(), fdp("motion.subset=3", "motion.flow_representation=channels")
    windows = every_window(buffer, s)
    batch, whole = (builder(s, buffer).build(windows, rng) for rng in (np.random.default_rng(0), None))
    assert torch.equal(batch.queries, whole.queries)


@pytest.mark.parametrize("pieces", [1, 2, 4])
def test_parts_of_a_batch_together_are_the_whole(pieces: int) -> None:
    buffer, s = random_buffer(), fdp("batch.shift_m=0.1")
    windows = WindowSampler(every_window(buffer, s), 24, 8, seed=0).windows(0)
    batch = builder(s, buffer, HAND).build(windows, np.random.default_rng(0))
    size = 24 // pieces
    for k in range(pieces):
        part = batch.part(slice(k * size, (k + 1) * size))
        assert len(part.points) == len(part.state) == len(torch.unique(batch.observed[k * size : (k + 1) * size]))
        for w in range(size):
            mine, whole = of_window(part, w), of_window(batch, k * size + w)
            for name, values in whole.items():
                assert np.array_equal(mine[name], values), name


def test_a_cloud_with_too_few_points_is_refused() -> None:
    wanted = (
        r"encoder.points is 25, and the dataset's clouds have 24; add --set encoder.points=24, or extract with "
        "--set observer.points=25"
    )
    with pytest.raises(UsageError, match=wanted):
        builder(fdp("encoder.points=25"))


# Which queries they follow.


def textbook(xyz: np.ndarray, wanted: int, chosen: list[int] | None = None) -> list[int]:
    """Farthest-point sampling as one would write it down; what is chosen already comes first."""
    taken = list(chosen or [0])
    while len(taken) < wanted:
        gap = np.linalg.norm(xyz[:, None] - xyz[taken], axis=-1).min(1)
        taken.append(int(gap.argmax()))
    return taken[:wanted]


def scene_corpus(queries: int = 12) -> ReplayBuffer:
    """Queries are farthest-point samples, as of a dataset that was extracted with scene sampling."""
    buffer = random_buffer(queries=queries)
    rng = np.random.default_rng(1)
    clouds = rng.normal(size=(3, 200, 3)).astype(np.float32)
    sampled = np.stack([cloud[textbook(cloud, queries)] for cloud in clouds])
    role = rng.choice([Role.OBJECT, Role.ROBOT, -1], (3, queries), p=[0.5, 0.3, 0.2])
    return replace(buffer, queries=sampled, query_role=role)


def motion(*overrides: str) -> Any:
    return fdp(*overrides).needs.flow


@pytest.mark.parametrize("wanted", [1, 5, 12])
def test_the_first_of_scene_queries_are_a_scene_sample(wanted: int) -> None:
    found = choose_queries(scene_corpus(), motion(f"motion.points={wanted}"))
    assert found.tolist() == [list(range(wanted))] * 3


def test_scene_queries_of_another_dataset_are_its_farthest_points() -> None:
    buffer = random_buffer(queries=12)
    found = choose_queries(buffer, motion("motion.points=5"))
    assert found.tolist() == [textbook(xyz, 5) for xyz in buffer.queries]


def test_object_queries_lie_on_objects() -> None:
    buffer = scene_corpus(30)
    found = choose_queries(buffer, motion("motion.points=5", "motion.sampling=object"))
    for demo, chosen in enumerate(found):
        movable = np.flatnonzero(buffer.query_role[demo] == Role.OBJECT)
        assert chosen.tolist() == movable[textbook(buffer.queries[demo, movable], 5)].tolist()


@pytest.mark.parametrize(("wanted", "on_objects"), [(9, 3), (10, 4), (1, 1)])
def test_a_third_of_stratified_queries_lies_on_objects_and_the_rest_around_them(wanted: int, on_objects: int) -> None:
    buffer = scene_corpus(30)
    found = choose_queries(buffer, motion(f"motion.points={wanted}", "motion.sampling=stratified"))
    for demo, chosen in enumerate(found):
        movable = np.flatnonzero(buffer.query_role[demo] == Role.OBJECT)
        guaranteed = movable[textbook(buffer.queries[demo, movable], on_objects)].tolist()
        assert chosen.tolist() == textbook(buffer.queries[demo], wanted, guaranteed)
        assert len(set(chosen)) == wanted


def test_missing_queries_repeat_those_there_are() -> None:
    buffer = replace(scene_corpus(), query_count=np.array([[3], [12], [12]]))
    assert choose_queries(buffer, motion("motion.points=8"))[0].tolist() == [0, 1, 2, 0, 1, 2, 0, 1]
    buffer.query_role[0] = [Role.ROBOT, Role.OBJECT, Role.ROBOT] + [Role.OBJECT] * 9  # what lies behind repeats
    chosen = choose_queries(buffer, motion("motion.points=4", "motion.sampling=object"))
    assert chosen[0].tolist() == [1, 1, 1, 1]


def test_queries_that_are_not_there_are_refused() -> None:
    buffer = scene_corpus()
    many = "motion.points is 13, and the dataset has 12 query points; add --set motion.points=12, or make the dataset "
    with pytest.raises(DataError, match=many + "with --set queries.points=13"):
        choose_queries(buffer, motion("motion.points=13"))
    nothing = {name: getattr(buffer, name)[:, :0] for name in ("tracks", "visible", "sigma", "queries", "query_role")}
    none = replace(buffer, **nothing)
    with pytest.raises(DataError, match=r"the dataset has no query points, .*; train --policy dp3"):
        choose_queries(none, motion())
    buffer.query_role[1] = Role.ROBOT
    for sampling in ("object", "stratified"):
        with pytest.raises(DataError, match=r"pour seed 1: none of its 12 query points is known to lie on an object"):
            choose_queries(buffer, motion(f"motion.sampling={sampling}"))
    assert choose_queries(buffer, motion("motion.sampling=scene")).shape == (3, 6)


# What a policy needs.


def needing(needs: Needs) -> Any:
    class Settings(TrainSettings):
        @property
        def needs(self) -> Needs:
            return needs

    return Settings(policy="x", horizon=8, n_action_steps=4, batch=BatchSettings(shift_m=0, turn_deg=0))


def with_pictures() -> ReplayBuffer:
    rng, buffer = np.random.default_rng(0), random_buffer()
    frames = len(buffer.state)
    return replace(
        buffer,
        rgb=rng.integers(0, 256, (frames, 4, 6, 3), np.uint8),
        depth=rng.random((frames, 4, 6), np.float32),
    )


@pytest.mark.parametrize(
    ("needs", "shapes"),
    [
        (Needs(), {}),
        (Needs(point_cloud=CloudNeeds(5)), {"points": (5, 3)}),
        (Needs(flow=FlowNeeds(4)), {"queries": (4, 3), "flow": (8, 4, 3), "flow_weight": (8, 4)}),
        (Needs(object_pose=True), {"object_pose": (8, 9)}),
        (Needs(rgb=True), {"rgb": (4, 6, 3)}),
        (Needs(depth=True), {"depth": (4, 6)}),
    ],
)
def test_a_batch_has_what_is_needed_and_nothing_else(needs: Needs, shapes: dict[str, tuple[int, ...]]) -> None:
    buffer, s = with_pictures(), needing(needs)
    batch = builder(s, buffer).build(every_window(buffer, s))
    empty = {"points": (0, 3), "queries": (0, 3), "flow": (8, 0, 3), "flow_weight": (8, 0), "object_pose": (8, 0),
             "rgb": None, "depth": None}  # fmt: skip
    for name, nothing in empty.items():
        value = getattr(batch, name)
        assert (None if value is None else tuple(value.shape[1:])) == shapes.get(name, nothing), name
    assert batch.action.shape[1:] == (8, 4)
    assert batch.state.shape[1:] == (9,)


def test_windows_share_pictures_as_they_share_frames() -> None:
    buffer, s = with_pictures(), needing(Needs(rgb=True, depth=True))
    assert buffer.rgb is not None
    assert buffer.depth is not None
    windows = every_window(buffer, s)
    batch = builder(s, buffer).build(windows)
    for part, first in ((batch, 0), (batch.part(slice(7, 19)), 7)):
        assert part.rgb is not None
        assert part.depth is not None
        assert len(part.rgb) == len(part.depth) == len(part.state)
        for w in range(len(part.observed)):
            now = windows.now[first + w]
            np.testing.assert_array_equal(part.rgb[part.observed[w, -1]], buffer.rgb[now])
            np.testing.assert_array_equal(part.depth[part.observed[w, -1]], buffer.depth[now])


def test_batches_together_have_the_windows_of_all() -> None:
    buffer, s = with_pictures(), needing(Needs(point_cloud=CloudNeeds(5), rgb=True))
    batch = builder(s, buffer).build(every_window(buffer, s))
    parts = [batch.part(slice(k, k + 5)) for k in (0, 5, 10)]
    whole = ObservationBatch.concatenate(parts)
    assert whole.depth is None
    assert whole.rgb is not None
    assert len(whole.state) == sum(len(p.state) for p in parts)
    for w in range(15):
        for name in ("points", "state", "rgb"):
            mine, theirs = getattr(whole, name)[whole.observed[w]], getattr(batch, name)[batch.observed[w]]
            assert torch.equal(mine, theirs), name
