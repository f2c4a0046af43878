"""Demonstrations are decoded once, into what the dataset holds, or not at all."""

import resource
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders import random_buffer
from synthetic import files_below, make_dataset, make_episode, with_quality

from flowlab.data.replay_buffer import ReplayBuffer, load_buffer
from flowlab.data.source import TrainingSource, open_training_source
from flowlab.errors import DataError
from flowlab.records import Episode
from flowlab.storage.dataset import Dataset
from flowlab.storage.exporters.dp3 import DP3Exporter


def make_episodes() -> list[Episode]:
    """Two tasks; lengths, state, and what is known of a track's error differ."""
    made = [make_episode(k, task=task, steps=9 + 5 * k) for task in ("push", "roll") for k in range(3)]
    return [with_quality(e) if e.task == "push" else e for e in made]


def write(folder: Path, episodes: list[Episode]) -> TrainingSource:
    """A dataset whose shards hold episodes in another order than that of tasks and seeds."""
    by_task = {e.task: [x for x in episodes if x.task == e.task] for e in episodes}
    make_dataset(folder, [unit for group in by_task.values() for unit in ([group[-1], group[0]], group[1:-1]) if unit])
    source = open_training_source(folder)
    assert [(e.task, e.seed) for e in source.episodes()] != [(e.task, e.seed) for e in episodes]
    return source


def check(buffer: ReplayBuffer, episodes: list[Episode]) -> None:
    wanted = sorted(episodes, key=lambda e: (e.task, e.seed))
    assert [(d.task, d.seed, len(d)) for d in buffer.episodes] == [(e.task, e.seed, len(e)) for e in wanted]
    assert len(buffer.state) == sum(map(len, wanted))
    rows = np.zeros(len(buffer.state), int)
    for k, (demo, e) in enumerate(zip(buffer.episodes, wanted, strict=True)):
        mine = slice(demo.start, demo.stop)
        rows[mine] += 1
        np.testing.assert_array_equal(buffer.point_cloud[mine], e.point_cloud)
        np.testing.assert_array_equal(buffer.state[mine], e.state)
        np.testing.assert_array_equal(buffer.action[mine], e.action)
        np.testing.assert_array_equal(buffer.tracks[mine], e.tracks.xyz_world)
        np.testing.assert_array_equal(buffer.visible[mine], e.tracks.visible)
        sigma = 0 * e.tracks.visible if e.tracks.quality is None else e.tracks.quality.sigma
        np.testing.assert_array_equal(buffer.sigma[mine], sigma)
        pose = np.zeros((len(e), 0)) if e.object_pose is None else e.object_pose
        np.testing.assert_array_equal(buffer.object_pose[mine], pose)
        np.testing.assert_array_equal(buffer.queries[k], e.queries.xyz_world)
        np.testing.assert_array_equal(buffer.query_role[k], e.query_role)
        assert buffer.query_count[k] == e.queries.count
    assert (rows == 1).all(), "a row belongs to no demonstration, or to two"
    assert buffer.point_cloud.dtype == buffer.tracks.dtype == buffer.sigma.dtype == np.float32


def test_a_corpus_is_its_dataset(tmp_path: Path) -> None:
    episodes = make_episodes()
    buffer = load_buffer(write(tmp_path / "d", episodes), tmp_path / "run")
    check(buffer, episodes)
    assert buffer.tasks == ("push", "roll")
    assert not (tmp_path / "run").exists()
    assert len(Dataset(tmp_path / "d")) == 6, "a dataset with a cache is still a dataset"


def test_a_corpus_without_poses_or_tracks_has_none(tmp_path: Path) -> None:
    episodes = [make_episode(k, object_pose=False) for k in range(3)]
    check(load_buffer(write(tmp_path / "d", episodes), tmp_path / "run"), episodes)
    DP3Exporter().export(Dataset(tmp_path / "d"), tmp_path / "store.zarr")
    buffer = load_buffer(open_training_source(tmp_path / "store.zarr"), tmp_path / "run")
    np.testing.assert_array_equal(buffer.action, np.concatenate([e.action for e in episodes]))
    assert [len(d) for d in buffer.episodes] == [len(e) for e in episodes]
    assert buffer.tracks.shape == (36, 0, 3)
    assert buffer.queries.shape == (3, 0, 3)


def test_a_dataset_is_decoded_once(tmp_path: Path) -> None:
    episodes = make_episodes()
    source = write(tmp_path / "d", episodes)
    load_buffer(source, tmp_path / "run")
    before = files_below(tmp_path / "d" / "cache")
    shutil.rmtree(tmp_path / "d" / "shards")
    check(load_buffer(open_training_source(tmp_path / "d"), tmp_path / "run"), episodes)
    assert files_below(tmp_path / "d" / "cache") == before


def test_other_content_is_decoded_anew_in_place_of_the_old(tmp_path: Path) -> None:
    episodes = make_episodes()
    old = load_buffer(write(tmp_path / "d", episodes), tmp_path / "run")
    shutil.rmtree(tmp_path / "d" / "shards")
    shutil.rmtree(tmp_path / "d" / "receipts")
    changed = [replace(e, action=e.action + 1) for e in episodes]
    check(load_buffer(write(tmp_path / "d", changed), tmp_path / "run"), changed)
    assert len(list((tmp_path / "d" / "cache").iterdir())) == 1, "what is outdated takes room"
    check(old, episodes)


def block(folder: Path) -> None:
    """Let nothing be made in a folder below this one, whoever asks: root is not told by permissions."""
    folder.mkdir(exist_ok=True)
    (folder / "cache").write_text("in the way")


def test_beside_a_dataset_that_cannot_be_written_the_run_keeps_the_corpus(tmp_path: Path) -> None:
    episodes = make_episodes()
    source = write(tmp_path / "d", episodes)
    block(tmp_path / "d")
    check(load_buffer(source, tmp_path / "run"), episodes)
    shutil.rmtree(tmp_path / "d" / "shards")
    check(load_buffer(source, tmp_path / "run"), episodes)
    (tmp_path / "d" / "cache").unlink()
    check(load_buffer(source, tmp_path / "run"), episodes)  # what the run has is not decoded again elsewhere
    block(tmp_path / "d")
    block(tmp_path / "other")
    with pytest.raises(DataError, match=f"{tmp_path / 'other'}: cannot be written; choose another --out"):
        load_buffer(source, tmp_path / "other")


def test_what_cannot_be_decoded_leaves_nothing_behind(tmp_path: Path) -> None:
    episodes = make_episodes()
    source = write(tmp_path / "d", episodes)

    def cut_short() -> Iterator[Episode]:
        yield from episodes[:2]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        load_buffer(replace(source, episodes=cut_short), tmp_path / "run")
    assert list((tmp_path / "d" / "cache").iterdir()) == []
    check(load_buffer(source, tmp_path / "run"), episodes)


def test_what_a_kill_left_half_made_is_made_again(tmp_path: Path) -> None:
    episodes = make_episodes()
    source = write(tmp_path / "d", episodes)
    load_buffer(source, tmp_path / "run")
    (cache,) = (tmp_path / "d" / "cache").iterdir()
    (cache / "index.json").unlink()
    (cache / "action.npy").write_bytes(b"half")
    check(load_buffer(source, tmp_path / "run"), episodes)


@contextmanager
def files_no_larger_than(size: int) -> Iterator[None]:
    """As on a full disk, what goes beyond cannot be written."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_disk_without_room_is_one_sentence(tmp_path: Path) -> None:
    episodes = make_episodes()
    source = write(tmp_path / "d", episodes)
    with (
        files_no_larger_than(20_000),
        pytest.raises(DataError, match=r"cache/.*: cannot be written \(File too large\)"),
    ):
        load_buffer(source, tmp_path / "run")
    assert list((tmp_path / "d" / "cache").iterdir()) == []
    check(load_buffer(source, tmp_path / "run"), episodes)


@pytest.mark.parametrize("field", ["point_cloud", "state", "action", "object_pose", "tracks"])
def test_demonstrations_of_different_widths_are_refused(tmp_path: Path, field: str) -> None:
    last = make_episode(2)
    if field == "point_cloud":
        last = replace(last, point_cloud=last.point_cloud[:, :50])
    elif field == "object_pose":
        last = replace(last, object_pose=None)
    elif field == "tracks":
        last = make_episode(2, queries=7)
    else:
        last = replace(last, **{field: getattr(last, field)[:, :3]})
    episodes = [make_episode(0), make_episode(1), last]
    source = replace(write(tmp_path / "d", episodes[:2]), episodes=lambda: iter(episodes), frames=36)
    name = field
    with pytest.raises(
        DataError, match=rf"{tmp_path / 'd'}: roll seed 2: '{name}' is .* wide, .*; train on one of them"
    ):
        load_buffer(source, tmp_path / "run")
    assert list((tmp_path / "d" / "cache").iterdir()) == []


def test_an_empty_dataset_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "d", make_episodes())
    for receipt in (tmp_path / "d" / "receipts").iterdir():
        receipt.unlink()
    with pytest.raises(DataError, match="there are no episodes to train on yet; run the command that makes"):
        open_training_source(tmp_path / "d")


@pytest.mark.parametrize(
    ("demonstrations", "held_out", "train", "held"),
    [
        (None, 0, [0, 1, 2, 3, 4, 5, 6, 7, 8, 9], []),
        (None, 1, [0, 1, 2, 3, 4, 6, 7, 9], [5, 8]),
        (None, 2, [0, 1, 2, 3, 6, 7, 9], [4, 5, 8]),
        (None, 99, [0, 1, 2, 3, 6, 7, 9], [4, 5, 8]),
        (2, 1, [0, 1, 6, 7, 9], [5, 8]),
        (1, 0, [0, 6, 9], []),
        (99, 1, [0, 1, 2, 3, 4, 6, 7, 9], [5, 8]),
    ],
)
def test_the_last_of_each_task_are_held_out(
    demonstrations: int | None, held_out: int, train: list[int], held: list[int]
) -> None:
    """Six of one task, three of the next, one of the last: two thirds of each, rounded up, remain at least."""
    buffer = random_buffer([("a", 3)] * 6 + [("b", 3)] * 3 + [("c", 3)], points=1, queries=1)
    assert buffer.split(demonstrations, held_out) == (train, held)


def pictured(seed: int, *, rgb: bool = True) -> Episode:
    e, rng = make_episode(seed), np.random.default_rng(seed)
    color = rng.integers(0, 256, (len(e), 12, 16, 3), np.uint8)
    return replace(e, rgb=color if rgb else None, depth=rng.random((len(e), 12, 16), np.float32))


def test_pictures_are_decoded_when_they_are_wanted(tmp_path: Path) -> None:
    episodes = [pictured(k) for k in range(3)]
    source = write(tmp_path / "d", episodes)
    plain = load_buffer(source, tmp_path / "run")
    assert (plain.rgb, plain.depth) == (None, None)
    before = files_below(tmp_path / "d/cache")
    assert not any("rgb" in name or "depth" in name for name in before)
    buffer = load_buffer(source, tmp_path / "run", ("rgb",))
    assert buffer.depth is None
    assert buffer.rgb is not None
    assert buffer.rgb.dtype == np.uint8
    for demo, e in zip(buffer.episodes, episodes, strict=True):
        np.testing.assert_array_equal(buffer.rgb[demo.start : demo.stop], e.rgb)
    both = load_buffer(source, tmp_path / "run", ("rgb", "depth"))
    assert both.depth is not None
    np.testing.assert_array_equal(both.depth[both.episodes[1].start], episodes[1].depth[0])
    after = files_below(tmp_path / "d/cache")
    assert {name: after[name] for name in before} == before, "what was decoded is not decoded again"


def test_pictures_that_the_dataset_lacks_are_none(tmp_path: Path) -> None:
    source = write(tmp_path / "d", [make_episode(k) for k in range(3)])
    for _ in range(2):
        buffer = load_buffer(source, tmp_path / "run", ("rgb", "depth"))
        assert (buffer.rgb, buffer.depth) == (None, None)


def test_pictures_of_some_episodes_only_are_refused(tmp_path: Path) -> None:
    episodes = [pictured(0), pictured(1), pictured(2, rgb=False)]
    source = replace(write(tmp_path / "d", episodes[:2]), episodes=lambda: iter(episodes), frames=36)
    load_buffer(source, tmp_path / "run")
    with pytest.raises(DataError, match="roll seed 2: 'rgb' is in some episodes only; train on those that have it"):
        load_buffer(source, tmp_path / "run", ("rgb",))


def test_nothing_is_deleted_that_is_not_ours(tmp_path: Path) -> None:
    """A stranger's dataset may have anything in its cache, or a link in its place."""
    data, home = tmp_path / "data", tmp_path / "home"
    make_dataset(data, [[make_episode(0)]])
    for folder in (data / "cache" / "photos", data / "cache" / "0123456789abcdef-1", home / "photos"):
        folder.mkdir(parents=True)
        (folder / "a.txt").write_text("kept")
    load_buffer(open_training_source(data), tmp_path / "run")
    assert (data / "cache" / "photos" / "a.txt").exists()
    assert (data / "cache" / "0123456789abcdef-1" / "a.txt").exists(), "our form, but not our mark"
    shutil.rmtree(data / "cache")
    (data / "cache").symlink_to(home, target_is_directory=True)
    load_buffer(open_training_source(data), tmp_path / "run")
    assert (home / "photos" / "a.txt").exists()
    assert [p.name for p in home.iterdir()] == ["photos"]
