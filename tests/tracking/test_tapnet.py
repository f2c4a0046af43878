"""The tapnet adapters against stand-ins that enforce the calling contracts of the public PyTorch code."""

import hashlib
import logging
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fake_networks import SIZE, TAPNext, dots, write_tapnet

from flowlab.errors import FlowlabError, MissingLibraryError, UsageError
from flowlab.records import Tracks2D
from flowlab.testing.trackers import CHECKS
from flowlab.tracking.base import Tracker, make_tracker
from flowlab.tracking.trackers import weights
from flowlab.tracking.trackers.tapnet import BootsTapir, TapNext

Maker = Callable[..., Tracker]
BOTH = pytest.mark.parametrize("name", ["bootstapir", "tapnext"])


@pytest.fixture(autouse=True)
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """An empty torch.hub cache, and nothing loaded before or after."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    weights._loaded.cache_clear()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # tests run side by side
    yield
    torch.set_num_threads(threads)
    for module in [m for m in sys.modules if m.partition(".")[0] == "tapnet"]:
        del sys.modules[module]


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Maker:
    """A tracker with the package installed and weights from a file."""
    monkeypatch.syspath_prepend(write_tapnet(tmp_path / "site"))
    torch.save({"scale": torch.ones(1)}, tmp_path / "bootstapir.pt")
    np.savez(tmp_path / "tapnext.npz", scale=np.ones(1, np.float32))
    files = {"bootstapir": tmp_path / "bootstapir.pt", "tapnext": tmp_path / "tapnext.npz"}
    return lambda name, **options: make_tracker(name, {"weights": files[name], **options})


@BOTH
@pytest.mark.parametrize("check", CHECKS, ids=lambda c: c.__name__)
def test_every_promise_of_a_tracker_is_kept(
    make: Maker, name: str, check: Callable[[Callable[[], Tracker]], None]
) -> None:
    check(lambda: make(name))


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


@BOTH
@pytest.mark.parametrize(("length", "size"), [(2, SIZE), (6, SIZE), (4, (60, 96)), (5, (320, 240))])
def test_points_are_followed_to_a_twentieth_of_a_pixel(
    make: Maker, name: str, length: int, size: tuple[int, int]
) -> None:
    clip, truth = dots(frames=10, size=size)
    start = 3
    queries = asked(truth, start, start, start + length // 2, start + length - 1)
    found = make(name).open(clip).track(queries, start, start + length)
    assert found.xy.shape == (length, 4, 2)
    check_tracks(found, truth, queries, start)


@BOTH
def test_queries_are_asked_for_in_raster_coordinates(make: Maker, name: str) -> None:
    """By hand: in 128×64 pixels each pixel is 2×4 of the square's, so the first one's center is at (1, 2)."""
    clip, _ = dots(frames=6, size=(128, 64))
    tracker = make(name)
    queries = np.array([[2, 0, 0], [3, 127, 63], [4, 127, 0], [2, 10.25, 20.5]], np.float32)
    tracker.open(clip).track(queries, 2, 6)
    expected = [[0, 2, 1], [1, 254, 255], [2, 2, 255], [0, 84, 21.5]]  # (t, y, x), t from the chunk's first frame
    np.testing.assert_array_equal(weights._loaded(tracker).asked.numpy(), expected)


@BOTH
def test_a_hidden_point_is_not_visible_until_it_is_back(make: Maker, name: str) -> None:
    clip, truth = dots(frames=10, hidden=range(5, 7))
    found = make(name).open(clip).track(asked(truth, 3, 3), 3, 10)
    assert np.flatnonzero(~found.visible[:, 0]).tolist() == [2, 3]
    assert found.visible[:, 1].all()


def test_confidence_of_bootstapir_is_the_chance_of_seen_and_near(make: Maker) -> None:
    clip, truth = dots(frames=6, hidden=range(4, 6))
    found = make("bootstapir").open(clip).track(asked(truth, 0), 0, 6)
    odds = np.exp([4, 2])  # of the stand-in's logits, for and against
    np.testing.assert_allclose(found.confidence[1:4, 0], np.prod(odds / (1 + odds)), rtol=1e-5)
    np.testing.assert_allclose(found.confidence[4:, 0], np.prod(1 / (1 + odds)), rtol=1e-5)


def test_confidence_of_tapnext_is_the_chance_of_seen_and_certain(make: Maker) -> None:
    clip, truth = dots(frames=6, hidden=range(4, 6))
    found = make("tapnext").open(clip).track(asked(truth, 0), 0, 6)
    near = ((np.exp(6) + 15) / (np.exp(6) + 255)) ** 2  # one of 256 bins stands out by 6, 16 are within 8 px
    np.testing.assert_allclose(found.confidence[1:4, 0], near / (1 + np.exp(-3)), rtol=0.01)
    assert (found.confidence[4:, 0] < 1 / (1 + np.exp(3))).all()


@BOTH
def test_one_session_answers_any_chunk_in_any_order(make: Maker, name: str) -> None:
    clip, truth = dots(frames=10)
    session = make(name).open(clip)
    for start, stop in [(6, 10), (0, 4), (1, 6), (2, 4), (7, 10), (0, 10), (9, 10)]:
        queries = asked(truth, start, stop - 1)
        check_tracks(session.track(queries, start, stop), truth, queries, start)


@pytest.mark.parametrize(("length", "stride"), [(4, 1), (4, 3), (12, 1)])
def test_bootstapir_encodes_every_frame_once(make: Maker, length: int, stride: int) -> None:
    clip, truth = dots(frames=12)
    tracker = make("bootstapir")
    session = tracker.open(clip)
    for start in range(0, 12 - length + 1, stride):
        for _ in range(2):
            session.track(asked(truth, start), start, start + length)
    assert weights._loaded(tracker).encoded == start + length


def test_bootstapir_refines_at_a_larger_size(make: Maker) -> None:
    clip, truth = dots(frames=5)
    session = make("bootstapir", size=320).open(clip)
    for start in (0, 2):
        queries = asked(truth, start, start + 1)
        check_tracks(session.track(queries, start, start + 3), truth, queries, start)


@BOTH
@pytest.mark.parametrize(("count", "length"), [(0, 5), (0, 1), (3, 1)])
def test_no_points_and_single_frames_need_no_network(make: Maker, name: str, count: int, length: int) -> None:
    clip, _ = dots(frames=10)
    queries = np.array([[4, k, 59 - k] for k in range(count)], np.float32).reshape(-1, 3)
    found = make(name).open(clip).track(queries, 4, 4 + length)
    assert found.xy.shape == (length, count, 2)
    np.testing.assert_array_equal(found.xy, np.broadcast_to(queries[:, 1:], found.xy.shape))
    assert found.visible.all()


def test_tracking_is_the_same_every_time_and_leaves_random_numbers_as_they_were(make: Maker) -> None:
    clip, truth = dots(frames=3)
    tracker, queries = make("bootstapir"), np.repeat(asked(truth, 0), 20, 0)
    session, orders = tracker.open(clip), []
    for seed in (7, 8):
        torch.manual_seed(seed)
        expected = torch.rand(3)
        torch.manual_seed(seed)
        session.track(queries, 0, 3)
        assert torch.equal(torch.rand(3), expected)
        orders.append(weights._loaded(tracker).order.tolist())
    assert orders[0] == orders[1]


@pytest.mark.parametrize(
    ("file", "options", "side"),
    [
        ("tapnextpp_512.ckpt", {}, 512),
        ("tapnextpp_ckpt.pt", {}, 256),
        ("tapnextpp_512.ckpt", {"size": 256}, 256),
        ("renamed.pt", {"size": 512}, 512),
    ],
)
def test_tapnext_sees_pictures_of_the_size_its_weights_were_trained_on(
    make: Maker, tmp_path: Path, file: str, options: dict[str, Any], side: int
) -> None:
    torch.save({"state_dict": {"tapnext.scale": torch.ones(1)}}, tmp_path / file)
    clip, truth = dots(frames=4)
    queries = asked(truth, 0, 0, 1)
    tracker = make("tapnext", weights=tmp_path / file, **options)
    check_tracks(tracker.open(clip).track(queries, 0, 4), truth, queries, 0)
    assert weights._loaded(tracker).side == side
    assert tracker.describe()["options"]["size"] == side


def test_a_package_too_old_for_larger_pictures_is_one_sentence(make: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(TAPNext, "_video_pos_emb")
    with pytest.raises(MissingLibraryError, match=r"size 512 need a newer package tapnet.*track.options.size=256"):
        make("tapnext", size=512).open(dots(2)[0])


class TestWeights:
    @BOTH
    def test_published_weights_come_from_the_hubs_cache(self, make: Maker, tmp_path: Path, name: str) -> None:
        kept = tmp_path / "torch" / "hub" / "checkpoints"
        kept.mkdir(parents=True)
        torch.save({"scale": torch.ones(1)}, kept / "bootstapir_checkpoint_v2.pt")
        np.savez(kept / "bootstapnext_ckpt.npz", scale=np.ones(1, np.float32))
        clip, truth = dots(frames=4)
        tracker, queries = make(name, weights=None), asked(truth, 0, 0)
        check_tracks(tracker.open(clip).track(queries, 0, 4), truth, queries, 0)
        source = tracker.describe()["weights"]["source"]
        assert source.startswith("https://storage.googleapis.com/dm-tapnet/")
        content = (kept / source.rpartition("/")[2]).read_bytes()
        assert tracker.describe()["weights"]["sha256"] == hashlib.sha256(content).hexdigest()

    def test_torch_checkpoints_of_tapnext_load_too(self, make: Maker, tmp_path: Path) -> None:
        torch.save({"state_dict": {"tapnext.scale": torch.ones(1)}, "epoch": 3}, tmp_path / "plus.pt")
        clip, truth = dots(frames=4)
        queries = asked(truth, 0, 0)
        tracker = make("tapnext", weights=tmp_path / "plus.pt")
        check_tracks(tracker.open(clip).track(queries, 0, 4), truth, queries, 0)

    @BOTH
    @pytest.mark.parametrize("suffix", [".pt", ".npz"])
    def test_a_file_of_something_else_is_one_sentence(
        self, make: Maker, tmp_path: Path, name: str, suffix: str
    ) -> None:
        file = tmp_path / f"else{suffix}"
        file.write_bytes(b"not weights")
        with pytest.raises(FlowlabError, match=rf"else{suffix} does not hold weights that fit .*dm-tapnet"):
            make(name, weights=file).open(dots(2)[0])

    @BOTH
    def test_no_network_is_one_sentence(self, make: Maker, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
        monkeypatch.setenv("https_proxy", "http://127.0.0.1:9")
        with pytest.raises(FlowlabError, match=rf"'{name}': the weights could not be downloaded .*--weights FILE"):
            make(name, weights=None).describe()


@BOTH
def test_a_missing_package_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(torch, "__version__", "2.13.0+cpu")
    with pytest.raises(MissingLibraryError, match=rf"'{name}' needs the Python package tapnet") as caught:
        make_tracker(name).open(dots(2)[0])
    _, _, advice = str(caught.value).partition("type: ")
    assert [step.strip().split()[2:4] for step in advice.split("&&")] == [
        ["torch==2.13.0", "torchvision"],
        ["--no-deps", "'tapnet"],
        ["einops", "einshape"],
    ]
    assert "--index-url https://download.pytorch.org/whl/cpu " in advice


@BOTH
@pytest.mark.parametrize(
    ("fails", "says"),
    [
        ("import einops_of_another_world", "einops_of_another_world.*type: pip install einops_of_another_world$"),
        ("raise ModuleNotFoundError('no tree', name='tree')", "type: pip install dm-tree$"),
        (
            "raise RuntimeError('operator torchvision::nms does not exist')",
            r"torchvision is missing or does not fit torch; type: pip install torch==\S+ torchvision",
        ),
        (
            "raise ModuleNotFoundError(\"No module named 'torchvision'\", name='torchvision')",
            r"type: pip install torch==\S+ torchvision",
        ),
        ("from torch import nothing_of_that_name", "nothing_of_that_name.*pip install --no-deps 'tapnet"),
    ],
)
def test_what_the_package_lacks_is_named(make: Maker, tmp_path: Path, name: str, fails: str, says: str) -> None:
    for module in ("torch/tapir_model.py", "tapnext/tapnext_torch.py"):
        (tmp_path / "site" / "tapnet" / module).write_text(f"{fails}\n")
    with pytest.raises(MissingLibraryError, match=says):
        make(name).open(dots(2)[0])


def test_who_waits_for_a_network_is_told_for_what(
    make: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        make("bootstapir").open(dots(2)[0])
        assert "MB" not in caplog.text
        weights._loaded.cache_clear()
        monkeypatch.setattr(weights, "SLOW_S", 0.01)
        for step in ("build", "restore"):
            slowly = getattr(BootsTapir, step)
            monkeypatch.setattr(BootsTapir, step, lambda *given, slowly=slowly: (time.sleep(0.3), slowly(*given))[1])
        make("bootstapir").open(dots(2)[0])
    assert "'bootstapir': importing its code" in caplog.text
    assert f"'bootstapir': reading its weights from {tmp_path / 'bootstapir.pt'} (0 MB)" in caplog.text


def test_sizes_that_the_network_cannot_take_are_refused(make: Maker) -> None:
    for size in (128, 300):
        with pytest.raises(UsageError, match="'bootstapir': size"):
            make("bootstapir", size=size)


def test_they_are_installed_under_their_names() -> None:
    assert type(make_tracker("bootstapir")) is BootsTapir
    assert type(make_tracker("tapnext")) is TapNext


@BOTH
def test_what_is_stored_says_where_labels_come_from(make: Maker, name: str) -> None:
    told: dict[str, Any] = make(name).describe()
    assert (told["tracker"], told["license"]) == (name, "Apache-2.0 (code and weights)")
    assert told["weights"]["source"] == told["options"]["weights"]
