"""The adapters of TAPIP3D and both SpatialTrackers against stand-ins that enforce the contracts of the public code."""

import hashlib
import logging
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fake_networks import SIZE
from fake_rgbd_networks import (
    SLOPE,
    slanted,
    write_spatialtracker,
    write_spatialtracker2,
    write_spatialtracker2_weights,
    write_tapip3d,
    write_tapip3d_weights,
)

from flowlab.errors import FlowlabError, MissingFileError, MissingLibraryError, UsageError
from flowlab.records import Clip, PositionSource, Tracks2D
from flowlab.testing.trackers import CHECKS
from flowlab.tracking.base import Tracker, make_tracker
from flowlab.tracking.chunking import ChunkSettings
from flowlab.tracking.labeling import label_clip
from flowlab.tracking.lifting import LiftSettings
from flowlab.tracking.trackers import weights
from flowlab.tracking.trackers.checkout import Checkout
from flowlab.tracking.trackers.rgbd import RgbdTracker, without_holes
from flowlab.tracking.trackers.tapip3d import _resized

Maker = Callable[..., Tracker]
NAMES = ("tapip3d", "spatialtracker", "spatialtracker2")
ALL = pytest.mark.parametrize("name", NAMES)


@pytest.fixture(autouse=True)
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No network, an empty torch.hub cache, and nothing loaded before or after; what runs on CUDA runs on the CPU."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setenv("https_proxy", "http://127.0.0.1:9")
    monkeypatch.setattr(RgbdTracker, "_device", lambda self: "cpu")
    weights._loaded.cache_clear()
    weights._show_license.cache_clear()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # tests run side by side
    yield
    torch.set_num_threads(threads)
    for name in [m for m in sys.modules if m.partition(".")[0] == "omegaconf"]:
        del sys.modules[name]


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Maker:
    """A tracker with code from a checkout and weights from a file."""
    repos = {
        "tapip3d": write_tapip3d(tmp_path),
        "spatialtracker": write_spatialtracker(tmp_path / "SpaTracker"),
        "spatialtracker2": write_spatialtracker2(tmp_path / "SpaTrackerV2"),
    }
    monkeypatch.syspath_prepend(tmp_path / "site")
    torch.save({"model": {"scale": torch.ones(1), "unused": torch.ones(2)}}, tmp_path / "spaT_final.pth")
    files = {
        "tapip3d": write_tapip3d_weights(tmp_path / "tapip3d_final.pth", (96, 144)),
        "spatialtracker": tmp_path / "spaT_final.pth",
        "spatialtracker2": write_spatialtracker2_weights(tmp_path / "offline"),
    }
    quick = {"resolution_factor": 1}

    def made(name: str, **options: Any) -> Tracker:
        given = {"repo": repos[name], "weights": files[name], **(quick if name == "tapip3d" else {}), **options}
        return make_tracker(name, given)

    return made


@ALL
@pytest.mark.parametrize("check", CHECKS, ids=lambda c: c.__name__)
def test_every_promise_of_a_tracker_is_kept(
    make: Maker, name: str, check: Callable[[Callable[[], Tracker]], None]
) -> None:
    check(lambda: make(name))


def asked(truth: np.ndarray, *frames: int) -> np.ndarray:
    """Queries for the red and the green dot by turns, each at its frame, at the nearest pixel."""
    return np.array([[t, *np.round(truth[t, k % 2])] for k, t in enumerate(frames)], np.float32)


def check_tracks(found: Tracks2D, xy: np.ndarray, xyz: np.ndarray, queries: np.ndarray, start: int) -> None:
    """After its frame every point is at its dot, in the picture and in 3D; before it, held and nowhere."""
    assert found.xyz_cam is not None
    for k, (t, *pixel) in enumerate(queries):
        at = int(t) - start
        np.testing.assert_array_equal(found.xy[: at + 1, k], np.broadcast_to(pixel, (at + 1, 2)))
        np.testing.assert_allclose(found.xy[at + 1 :, k], xy[start:][at + 1 : len(found.xy), k % 2], atol=0.06)
        np.testing.assert_allclose(found.xyz_cam[at + 1 :, k], xyz[start:][at + 1 : len(found.xy), k % 2], atol=0.002)
        np.testing.assert_array_equal(found.xyz_cam[:at, k], 0)
        assert np.abs(found.xyz_cam[at, k] - xyz[start + at, k % 2]).max() < 0.01  # of the nearest pixel
        assert abs(found.xyz_cam[at, k, 2] - 1 - SLOPE * pixel[0]) < 1e-5  # as read there
        assert found.visible[:, k].tolist() == [row >= at for row in range(len(found.xy))]


@ALL
@pytest.mark.parametrize(("length", "size"), [(2, SIZE), (6, SIZE), (17, SIZE), (5, (60, 96))])
def test_points_are_followed_in_3d_through_parts_of_any_length(
    make: Maker, name: str, length: int, size: tuple[int, int]
) -> None:
    clip, xy, xyz = slanted(size=size)
    start = 3
    queries = asked(xy, start, start, start + length // 2, start + length - 1)
    found = make(name).open(clip).track(queries, start, start + length)
    check_tracks(found, xy, xyz, queries, start)


@ALL
def test_one_point_is_a_point(make: Maker, name: str) -> None:
    clip, xy, xyz = slanted()
    queries = asked(xy, 0)
    check_tracks(make(name).open(clip).track(queries, 0, 20), xy, xyz, queries, 0)


@ALL
def test_labels_are_where_the_network_says_in_the_world(make: Maker, name: str) -> None:
    clip, xy, xyz = slanted()
    _, tracks = label_clip(clip, asked(xy, 0, 0)[:, 1:], make(name), ChunkSettings(), LiftSettings())
    np.testing.assert_allclose(tracks.xyz_world[1:], clip.to_world(xyz)[1:], atol=0.003)
    assert tracks.quality is not None
    assert (tracks.quality.source[1:] == PositionSource.MODEL).all()


@ALL
def test_a_hidden_point_is_not_visible_until_it_is_back(make: Maker, name: str) -> None:
    clip, xy, _ = slanted(hidden=range(8, 11))
    found = make(name).open(clip).track(asked(xy, 2, 2), 2, 20)
    assert np.flatnonzero(~found.visible[:, 0]).tolist() == [6, 7, 8]
    assert found.visible[:, 1].all()
    assert (found.confidence[6:9, 0] < found.confidence[5, 0]).all()


@ALL
def test_a_point_without_depth_is_held_and_not_visible(make: Maker, name: str) -> None:
    clip, xy, xyz = slanted()
    depth = clip.depth.copy()
    column, row = asked(xy, 0)[0, 1:].astype(int)
    depth[0, row - 1 : row + 2, column - 1 : column + 2] = 0
    holed = Clip(clip.rgb, depth, clip.camera, clip.T_world_cam)
    session, queries = make(name).open(holed), asked(xy, 0, 0)
    found = session.track(queries, 0, 20)
    np.testing.assert_array_equal(found.xy[:, 0], np.broadcast_to(queries[0, 1:], (20, 2)))
    assert found.visible[:, 0].tolist() == [True] + 19 * [False]
    assert not found.xyz_cam[:, 0].any()
    np.testing.assert_allclose(found.xyz_cam[1:, 1], xyz[1:, 1], atol=0.002)
    assert not session.track(queries[:1], 0, 20).xyz_cam.any()


@ALL
def test_what_is_said_of_a_point_behind_or_beside_the_camera_is_no_position(make: Maker, name: str) -> None:
    clip, xy, _ = slanted()
    tracker = make(name)
    for scale, placed in ((-1.0, False), (np.nan, False)):
        for parameter in weights._loaded(tracker).model.parameters():
            parameter.data.fill_(scale)
        found = tracker.open(clip).track(asked(xy, 0, 0), 0, 20)
        assert found.xyz_cam[1:].any() == placed
        assert not found.visible[1:].any()


def test_queries_of_tapip3d_are_in_the_world_and_its_support_is_left_out(make: Maker) -> None:
    clip, _, _ = slanted()
    tracker = make("tapip3d")
    queries = np.float32([[2, 10, 20], [5, 70, 30]])
    found = tracker.open(clip).track(queries, 2, 20)
    given = weights._loaded(tracker).model.asked.numpy()
    xyz_cam = clip.camera.unproject(queries[:, 1:], clip.depth[0, 0, [10, 70]])
    world = [clip.to_world(np.broadcast_to(xyz_cam, (20, 2, 3)))[t, k] for k, t in enumerate((2, 5))]
    np.testing.assert_allclose(given[:2], np.insert(world, 0, [0, 3], 1), atol=1e-5)
    assert len(given) == 2 + 16**2
    assert found.xy.shape == (18, 2, 2)


@pytest.mark.parametrize(("factor", "size"), [(1, (96, 144)), (2, (135, 203))])
def test_tapip3d_sees_more_pixels_than_it_was_trained_on(make: Maker, factor: int, size: tuple[int, int]) -> None:
    tracker = make("tapip3d", resolution_factor=factor)
    clip, xy, xyz = slanted()
    queries = asked(xy, 0, 0)
    check_tracks(tracker.open(clip).track(queries, 0, 20), xy, xyz, queries, 0)
    assert weights._loaded(tracker).model.image_size == size


def test_spatialtracker_is_asked_for_what_becomes_pixel_centers(make: Maker) -> None:
    """By hand: pictures of 256 by 384 become twice as wide, so the first pixel's center lies at (0.5, 0) there."""
    clip, _, _ = slanted(frames=2, size=(256, 384))
    tracker = make("spatialtracker")
    tracker.open(clip).track(np.float32([[0, 0, 0], [1, 255, 383]]), 0, 2)
    expected = [[0, 0.5, 0], [1, 2 * 255 + 0.5, 383]]
    np.testing.assert_allclose(weights._loaded(tracker).model.asked.numpy(), expected, atol=1e-4)


def test_a_resized_camera_sees_the_same(make: Maker) -> None:
    """By hand: twice as wide and three times as high, the center of the first pixel lies at (0.5, 1)."""
    clip, _, _ = slanted(frames=1)
    scene = _resized(clip, (180, 192))
    corner = clip.camera.unproject(np.zeros(2), np.ones(()))
    pixel = scene["intrinsics"][0] @ corner
    np.testing.assert_allclose(pixel[:2] / pixel[2], [0.5, 1])
    assert set(np.unique(scene["depth_obs"])) == set(np.unique(clip.depth))
    np.testing.assert_allclose(scene["extrinsics"][0] @ clip.poses()[0], np.eye(4), atol=1e-12)


def test_spatialtracker2_is_told_the_camera_and_where_depth_holds(make: Maker) -> None:
    clip, xy, _ = slanted()
    clip.depth[4, 10:20, 10:20] = 0
    tracker = make("spatialtracker2")
    found = tracker.open(clip).track(asked(xy, 0, 0), 0, 20)
    model = weights._loaded(tracker).model
    np.testing.assert_allclose(model.extrs, clip.poses(), rtol=1e-6)
    np.testing.assert_array_equal(model.unc_metric, clip.depth > 0)
    np.testing.assert_allclose(found.confidence[1:], 0.6 * 0.75, rtol=1e-5)


def test_holes_are_filled_by_the_nearest_reading() -> None:
    depth = np.zeros((3, 2, 4), np.float32)
    depth[0, :, 0], depth[0, :, 3] = 1, 2
    np.testing.assert_array_equal(without_holes(depth), np.float32([[[1, 1, 2, 2]] * 2] * 3))


class TestCode:
    @ALL
    def test_without_a_checkout_one_is_told_how_to_get_one(self, make: Maker, name: str) -> None:
        with pytest.raises(
            MissingLibraryError, match=r"git clone --recursive https://github.com/.*track.options.repo="
        ):
            make(name, repo=None).open(slanted(2)[0])

    @ALL
    def test_a_folder_of_something_else_is_one_sentence(self, make: Maker, tmp_path: Path, name: str) -> None:
        (tmp_path / "empty").mkdir()
        with pytest.raises(MissingLibraryError, match=r"empty cannot be imported .*expected a checkout: git clone"):
            make(name, repo=tmp_path / "empty").open(slanted(2)[0])

    @ALL
    @pytest.mark.parametrize(
        ("fails", "says"),
        [
            ("import pointops2_cuda", r"install pointops2_cuda as .*README.md says"),
            (
                "raise RuntimeError('operator torchvision::nms does not exist')",
                r"type: pip install torch==\S+ torchvision",
            ),
        ],
    )
    def test_what_the_code_lacks_is_one_sentence(self, make: Maker, name: str, fails: str, says: str) -> None:
        tracker: Any = make(name)
        file = tracker.repo / Path(*tracker.modules[-1].split(".")).with_suffix(".py")
        file.write_text(fails)
        with pytest.raises(MissingLibraryError, match=says):
            tracker.open(slanted(2)[0])

    @ALL
    def test_code_that_fails_when_it_is_called_is_one_sentence(
        self, make: Maker, monkeypatch: pytest.MonkeyPatch, name: str
    ) -> None:
        clip, xy, _ = slanted()
        tracker = make(name)
        monkeypatch.setattr(weights._loaded(tracker).model, "forward", lambda *a, **k: 1 / 0)
        with pytest.raises(FlowlabError, match=r"its code fails \(ZeroDivisionError: .*another version"):
            tracker.open(clip).track(asked(xy, 0), 0, 20)

    def test_checkouts_do_not_get_in_each_others_way(self, make: Maker) -> None:
        clip, xy, xyz = slanted()
        queries = asked(xy, 0, 0)
        sessions = [make(name).open(clip) for name in NAMES]  # each has a package called models
        for session in sessions:
            check_tracks(session.track(queries, 0, 20), xy, xyz, queries, 0)
        assert not {"models", "utils"} & set(sys.modules)

    def test_an_installed_package_of_the_same_name_is_left_as_it_was(self, tmp_path: Path) -> None:
        (tmp_path / "code").mkdir()
        (tmp_path / "code" / "json.py").write_text("mine = True\n")
        import json

        code, path = Checkout(tmp_path / "code"), list(sys.path)
        for entered in range(2):
            with code:
                import json as own

                assert own.mine
                assert hasattr(own, "kept") == bool(entered)
                own.kept = True
        assert sys.modules["json"] is json
        assert sys.path == path


class TestWeights:
    @ALL
    def test_a_file_of_something_else_is_one_sentence(self, make: Maker, tmp_path: Path, name: str) -> None:
        file = tmp_path / "offline" / "else.pth"
        for content in (b"not weights", b"PK\x03\x04"):
            file.write_bytes(content)
            with pytest.raises(FlowlabError, match=r"else.pth does not hold weights that fit .*--weights FILE"):
                make(name, weights=file).open(slanted(2)[0])

    @ALL
    def test_missing_weights_are_not_made_up(self, make: Maker, tmp_path: Path, name: str) -> None:
        """Two of the three public loaders would go on with random ones."""
        if name == "spatialtracker2":
            file = write_spatialtracker2_weights(tmp_path / "other", other=torch.ones(1))
        else:
            file = tmp_path / "other.pth"
            torch.save({"model": {"other": torch.ones(1)}}, file)
        with pytest.raises(FlowlabError, match=r"does not hold weights that fit .*(scale|cfg and weight)"):
            make(name, weights=file).open(slanted(2)[0])

    @pytest.mark.parametrize("name", ["tapip3d", "spatialtracker"])
    def test_a_file_cannot_run_code(self, make: Maker, tmp_path: Path, name: str) -> None:
        torch.save({"cfg": Evil(tmp_path / "touched"), "weight": {}}, tmp_path / "evil.pth")
        with pytest.raises(FlowlabError, match=r"evil.pth does not hold weights that fit"):
            make(name, weights=tmp_path / "evil.pth").open(slanted(2)[0])
        assert not (tmp_path / "touched").exists()

    def test_those_of_spatialtracker2_need_their_settings(self, make: Maker, tmp_path: Path) -> None:
        (tmp_path / "offline" / "config.json").unlink()
        with pytest.raises(MissingFileError, match=r"config.json"):
            make("spatialtracker2").open(slanted(2)[0])

    def test_those_of_spatialtracker_cannot_be_downloaded(self, make: Maker) -> None:
        with pytest.raises(UsageError, match=r"needs its weights: download https://drive.google.*--weights FILE"):
            make("spatialtracker", weights=None).describe()

    @pytest.mark.parametrize("name", ["tapip3d", "spatialtracker2"])
    def test_no_network_is_one_sentence(self, make: Maker, name: str) -> None:
        with pytest.raises(FlowlabError, match=rf"'{name}': the weights could not be downloaded .*--weights FILE"):
            make(name, weights=None).describe()

    def test_those_of_spatialtracker2_have_a_folder_of_their_own(self, make: Maker, tmp_path: Path) -> None:
        kept = tmp_path / "torch" / "hub" / "checkpoints" / "SpatialTrackerV2-Offline"
        file = write_spatialtracker2_weights(kept)
        told = make("spatialtracker2", weights=None).describe()["weights"]
        assert told["sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()
        assert told["source"].endswith("/SpatialTrackerV2-Offline/resolve/main/model.safetensors")


class Evil:
    """Touches a file when it is unpickled."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.file,)


@ALL
def test_without_cuda_another_tracker_is_named(make: Maker, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.undo()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(MissingLibraryError, match=rf"'{name}' runs on CUDA only.*'rigid-bodies'"):
        make(name).open(slanted(2)[0])


@ALL
def test_the_license_is_shown_and_stored(make: Maker, caplog: pytest.LogCaptureFixture, name: str) -> None:
    tracker = make(name)
    with caplog.at_level(logging.WARNING):
        tracker.open(slanted(2)[0])
    assert "CC-BY-NC 4.0" in caplog.text
    assert tracker.describe()["license"] in caplog.text
    assert not type(tracker).chunked
