"""The CoTracker adapter against a stand-in that enforces the calling contract of CoTracker's public code."""

import hashlib
import logging
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fake_networks import SIZE, dots, write_cotracker, write_cotracker_weights

from flowlab.errors import FlowlabError, MissingLibraryError, UsageError
from flowlab.records import Clip, Tracks2D
from flowlab.testing.trackers import CHECKS
from flowlab.tracking.base import Tracker, make_tracker
from flowlab.tracking.trackers import weights
from flowlab.tracking.trackers.cotracker import CoTracker2, CoTracker3

Maker = Callable[..., Tracker]
WINDOWS = {("cotracker3", "offline"): 60, ("cotracker3", "online"): 16, ("cotracker2", "offline"): 8}
VARIANTS = [*WINDOWS, ("cotracker2", "online")]
NOWHERE = "http://127.0.0.1:9"
"""Nothing listens there."""


@pytest.fixture(autouse=True)
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No network, an empty torch.hub cache, and nothing loaded before or after."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setenv("https_proxy", NOWHERE)
    weights._loaded.cache_clear()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # tests run side by side
    weights._show_license.cache_clear()
    yield
    torch.set_num_threads(threads)
    for name in [m for m in sys.modules if m.partition(".")[0] == "cotracker"]:
        del sys.modules[name]


@pytest.fixture
def make(tmp_path: Path) -> Maker:
    """A tracker as a user without a network makes it: code from a checkout, weights from a file."""
    repo = write_cotracker(tmp_path / "co-tracker")

    def made(name: str = "cotracker3", mode: str = "offline", **options: Any) -> Tracker:
        window = WINDOWS.get((name, mode), 8)
        file = write_cotracker_weights(tmp_path / f"{name}-{mode}.pth", name == "cotracker2", window)
        return make_tracker(name, {"mode": mode, "repo": str(repo), "weights": file, **options})

    return made


@pytest.mark.parametrize(("name", "mode"), VARIANTS)
@pytest.mark.parametrize("check", CHECKS, ids=lambda c: c.__name__)
def test_every_promise_of_a_tracker_is_kept(
    make: Maker, name: str, mode: str, check: Callable[[Callable[[], Tracker]], None]
) -> None:
    check(lambda: make(name, mode))


def asked(truth: np.ndarray, *frames: int) -> np.ndarray:
    """Queries for the red and the green dot by turns, each at its frame, at the nearest pixel."""
    return np.array([[t, *np.round(truth[t, k % 2])] for k, t in enumerate(frames)], np.float32)


def check_tracks(found: Tracks2D, truth: np.ndarray, queries: np.ndarray, start: int) -> None:
    """After its frame every point is at its dot, at its frame as asked, before it held and not visible."""
    assert found.xy.dtype == found.confidence.dtype == np.float32
    for k, (t, *xy) in enumerate(queries):
        at = int(t) - start
        np.testing.assert_array_equal(found.xy[: at + 1, k], np.broadcast_to(xy, (at + 1, 2)))
        np.testing.assert_allclose(found.xy[at + 1 :, k], truth[start:][at + 1 : len(found.xy), k % 2], atol=0.05)
        assert found.visible[:, k].tolist() == [row >= at for row in range(len(found.xy))]
        np.testing.assert_array_equal(found.confidence[:, k], found.visible[:, k])


@pytest.mark.parametrize(("name", "mode"), VARIANTS)
@pytest.mark.parametrize("length", [2, 8, 9, 16, 17, 33])
def test_points_are_followed_through_chunks_of_any_length(make: Maker, name: str, mode: str, length: int) -> None:
    clip, truth = dots()
    start = 3
    queries = asked(truth, start, start, start + length // 2, start + length - 1)
    found = make(name, mode).open(clip).track(queries, start, start + length)
    assert found.xy.shape == (length, 4, 2)
    check_tracks(found, truth, queries, start)


@pytest.mark.parametrize("mode", ["offline", "online"])
def test_a_hidden_point_is_not_visible_until_it_is_back(make: Maker, mode: str) -> None:
    clip, truth = dots(hidden=range(20, 26))
    found = make(mode=mode).open(clip).track(asked(truth, 10, 10), 10, 34)
    assert np.flatnonzero(~found.visible[:, 0]).tolist() == [*range(10, 16)]
    assert found.visible[:, 1].all()
    np.testing.assert_array_equal(found.confidence, found.visible)


@pytest.mark.parametrize("mode", ["offline", "online"])
def test_one_session_answers_any_chunk_in_any_order(make: Maker, mode: str) -> None:
    clip, truth = dots()
    session = make(mode=mode).open(clip)
    for start, stop in [(25, 40), (0, 12), (25, 40), (7, 8), (39, 40)]:
        queries = asked(truth, start, stop - 1)
        check_tracks(session.track(queries, start, stop), truth, queries, start)


@pytest.mark.parametrize("mode", ["offline", "online"])
@pytest.mark.parametrize(("count", "length"), [(0, 5), (0, 1), (3, 1)])
def test_no_points_and_single_frames_need_no_network(make: Maker, mode: str, count: int, length: int) -> None:
    clip, _ = dots()
    queries = np.array([[4, k, 59 - k] for k in range(count)], np.float32).reshape(-1, 3)
    found = make(mode=mode).open(clip).track(queries, 4, 4 + length)
    assert found.xy.shape == (length, count, 2)
    np.testing.assert_array_equal(found.xy, np.broadcast_to(queries[:, 1:], found.xy.shape))
    assert found.visible.all()


def test_the_support_grid_does_not_leak_into_the_answer(make: Maker) -> None:
    clip, truth = dots()
    queries = asked(truth, 0, 0)
    check_tracks(make(mode="online", support_grid=True).open(clip).track(queries, 0, 40), truth, queries, 0)


def test_loading_leaves_random_numbers_as_they_were(make: Maker) -> None:
    torch.manual_seed(7)
    expected = torch.rand(3)
    torch.manual_seed(7)
    make().open(dots(2)[0])
    assert torch.equal(torch.rand(3), expected)


def test_a_clip_that_cannot_be_written_to_is_no_trouble(make: Maker) -> None:
    clip, truth = dots(frames=6)
    clip.rgb.flags.writeable = False
    queries = asked(truth, 0, 0)
    check_tracks(make().open(clip).track(queries, 0, 6), truth, queries, 0)


def test_code_of_an_installed_package_is_used(make: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clip, truth = dots(frames=20)
    monkeypatch.syspath_prepend(tmp_path / "co-tracker")
    for name, mode in VARIANTS:
        queries = asked(truth, 0, 0)
        check_tracks(make(name, mode, repo=None).open(clip).track(queries, 0, 20), truth, queries, 0)


def test_a_repository_that_is_asked_for_goes_before_an_installed_package(
    make: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "cotracker.py").write_text("raise ImportError\n")
    monkeypatch.syspath_prepend(tmp_path / "site")
    make().open(dots(2)[0])


def test_an_installed_package_of_another_age_is_one_sentence(
    make: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path / "co-tracker")
    (tmp_path / "co-tracker" / "cotracker" / "predictor.py").write_text("def CoTrackerPredictor(checkpoint): pass\n")
    tracker = make(repo=None)
    with pytest.raises(MissingLibraryError, match=r"cotracker cannot be used .*; type: pip install -U git"):
        tracker.open(dots(2)[0])


@pytest.mark.parametrize("installed", [True, False])
def test_a_torchvision_that_does_not_fit_is_one_sentence(
    make: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, installed: bool
) -> None:
    monkeypatch.syspath_prepend(tmp_path / "co-tracker")
    unfit = "raise RuntimeError('operator torchvision::nms does not exist')\n"
    (tmp_path / "co-tracker" / "cotracker" / "predictor.py").write_text(unfit)
    tracker = make(repo=None) if installed else make()
    with pytest.raises(MissingLibraryError, match=r"does not fit torch; type: pip install torch==\S+ torchvision"):
        tracker.open(dots(2)[0])


class TestWeights:
    def test_published_weights_come_from_the_hubs_cache(self, make: Maker, tmp_path: Path) -> None:
        file = write_cotracker_weights(tmp_path / "torch" / "hub" / "checkpoints" / "scaled_online.pth", False, 16)
        clip, truth = dots(20)
        tracker, queries = make(mode="online", weights=None), asked(truth, 0, 0)
        check_tracks(tracker.open(clip).track(queries, 0, 20), truth, queries, 0)
        assert tracker.describe()["weights"] == {
            "source": "https://huggingface.co/facebook/cotracker3/resolve/main/scaled_online.pth",
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        }

    def test_they_are_downloaded_once(self, make: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        published = write_cotracker_weights(tmp_path / "published.pth", False, 60)
        monkeypatch.setattr(CoTracker3, "weights_url", published.as_uri())
        digest = make(weights=None).describe()["weights"]["sha256"]
        assert digest == hashlib.sha256(published.read_bytes()).hexdigest()
        published.unlink()
        make(weights=None).open(dots(2)[0])

    def test_no_network_is_one_sentence(self, make: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(CoTracker3, "weights_url", f"{NOWHERE}/scaled_offline.pth")
        with pytest.raises(FlowlabError) as caught:
            make(weights=None).open(dots(2)[0])
        kept = tmp_path / "torch" / "hub" / "checkpoints" / "scaled_offline.pth"
        for part in ["'cotracker3'", f"{NOWHERE}/scaled_offline.pth", str(kept), "--weights FILE"]:
            assert part in str(caught.value)
        assert not kept.exists()

    @pytest.mark.parametrize("wrap", ["model", "state_dict"])
    def test_a_checkpoint_of_training_is_unwrapped(self, make: Maker, tmp_path: Path, wrap: str) -> None:
        state = torch.load(write_cotracker_weights(tmp_path / "bare.pth", False, 60))
        torch.save({wrap: state, "step": 7}, tmp_path / "wrapped.pth")
        clip, truth = dots(6)
        queries = asked(truth, 0, 0)
        tracker = make(weights=tmp_path / "wrapped.pth")
        check_tracks(tracker.open(clip).track(queries, 0, 6), truth, queries, 0)

    def test_those_of_another_variant_are_refused(self, make: Maker, tmp_path: Path) -> None:
        for name, mode in VARIANTS:
            for v2, window in [(False, 60), (False, 16), (True, 8)]:
                if (v2, window) != (name == "cotracker2", WINDOWS.get((name, mode), 8)):
                    file = write_cotracker_weights(tmp_path / "other.pth", v2, window)
                    with pytest.raises(FlowlabError, match=r"other.pth does not hold weights that fit .*time_emb"):
                        make(name, mode, weights=file).open(dots(2)[0])

    @pytest.mark.parametrize("content", [b"", b"not weights", b"PK\x03\x04"])
    def test_a_file_of_something_else_is_one_sentence(self, make: Maker, tmp_path: Path, content: bytes) -> None:
        (tmp_path / "else.pth").write_bytes(content)
        with pytest.raises(FlowlabError, match=r"else.pth does not hold weights that fit .*--weights FILE"):
            make(weights=tmp_path / "else.pth").open(dots(2)[0])

    def test_a_file_cannot_run_code(self, make: Maker, tmp_path: Path) -> None:
        torch.save({"scale": Evil(tmp_path / "touched")}, tmp_path / "evil.pth")
        with pytest.raises(FlowlabError, match=r"evil.pth does not hold weights that fit"):
            make(weights=tmp_path / "evil.pth").open(dots(2)[0])
        assert not (tmp_path / "touched").exists()

    def test_a_missing_file_is_an_error_of_use(self, make: Maker) -> None:
        with pytest.raises(UsageError, match=r"'cotracker3': weights: .*nothere.pth"):
            make(weights="nothere.pth")


class Evil:
    """Touches a file when it is unpickled."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.file,)


class TestCode:
    def test_no_network_is_one_sentence(self, make: Maker) -> None:
        with pytest.raises(MissingLibraryError) as caught:
            make(repo=None).open(dots(2)[0])
        for part in ["'cotracker3'", "facebookresearch/co-tracker", "git clone https://github.com", "option repo"]:
            assert part in str(caught.value)

    def test_an_outdated_copy_is_one_sentence(self, make: Maker, tmp_path: Path) -> None:
        (tmp_path / "co-tracker" / "hubconf.py").write_text("def cotracker_w8(): pass\n")
        with pytest.raises(MissingLibraryError, match=r"Cannot find callable cotracker3_offline .*outdated copy"):
            make().open(dots(2)[0])

    def test_a_folder_of_something_else_is_one_sentence(self, make: Maker, tmp_path: Path) -> None:
        (tmp_path / "empty").mkdir()
        with pytest.raises(MissingLibraryError, match=r"hubconf.py.*git clone"):
            make(repo=str(tmp_path / "empty")).open(dots(2)[0])

    def test_what_the_code_itself_lacks_is_named(self, make: Maker, tmp_path: Path) -> None:
        (tmp_path / "co-tracker" / "cotracker" / "predictor.py").write_text("import no_such_package\n")
        with pytest.raises(MissingLibraryError, match="type: pip install no_such_package"):
            make().open(dots(2)[0])


def test_what_is_stored_says_where_labels_come_from(make: Maker, tmp_path: Path) -> None:
    file = tmp_path / "cotracker2-online.pth"
    told = make("cotracker2", "online", device="cpu").describe()
    assert told["tracker"] == "cotracker2"
    assert told["license"].startswith("CC-BY-NC 4.0")
    assert told["options"]["mode"] == "online"
    assert told["weights"] == {"source": str(file), "sha256": hashlib.sha256(file.read_bytes()).hexdigest()}


def test_the_license_is_shown_once(make: Maker, caplog: pytest.LogCaptureFixture) -> None:
    clip, _ = dots(2)
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            make().open(clip)
        make(mode="online").open(clip)
    assert len(caplog.messages) == 1
    assert "'cotracker3'" in caplog.text
    assert "CC-BY-NC 4.0" in caplog.text


def test_the_network_is_loaded_once_for_all_clips(make: Maker, tmp_path: Path) -> None:
    tracker = make()
    tracker.open(dots(2)[0])
    (tmp_path / "co-tracker" / "hubconf.py").unlink()
    clip, truth = dots(6, size=(64, 80))
    queries = asked(truth, 0, 0)
    check_tracks(tracker.open(clip).track(queries, 0, 6), truth, queries, 0)


def test_cuda_that_is_not_there_is_one_sentence(make: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(MissingLibraryError, match=r"option device is 'cuda'.* use 'auto' or 'cpu'"):
        make(device="cuda").open(dots(2)[0])


def test_offline_has_no_choice_of_grid(make: Maker) -> None:
    with pytest.raises(UsageError, match=r"'cotracker3': support_grid: .*'offline' always has its grid"):
        make(support_grid=True)


def test_they_are_installed_under_their_names() -> None:
    assert type(make_tracker("cotracker3")) is CoTracker3
    assert type(make_tracker("cotracker2")) is CoTracker2


@pytest.mark.parametrize("wrong", ["batch", "float64", "bytes", "range", "late", "early"])
def test_the_stand_in_refuses_what_the_real_one_refuses(make: Maker, wrong: str) -> None:
    make().open(dots(2)[0])
    from cotracker.predictor import CoTrackerPredictor

    video, queries = torch.full((1, 4, 3, *SIZE[::-1]), 200.0), torch.tensor([[[1.0, 5, 5]]])
    predictor = CoTrackerPredictor(checkpoint=None)
    predictor(video, queries=queries)
    match wrong:
        case "batch":
            video, queries = video.repeat(2, 1, 1, 1, 1), queries.repeat(2, 1, 1)
        case "float64":
            queries = queries.double()
        case "bytes":
            video = video.byte()
        case "range":
            video = video / 255
        case "late":
            queries[..., 0] = 4
        case "early":
            queries[..., 0] = -1
    with pytest.raises((RuntimeError, IndexError)):
        predictor(video, queries=queries)


def test_a_clip_is_what_it_says() -> None:
    clip, truth = dots(5)
    assert isinstance(clip, Clip)
    v, u = np.unravel_index(clip.rgb[3, ..., 0].argmax(), clip.rgb.shape[1:3])
    assert np.abs([u, v] - truth[3, 0]).max() <= 0.5
