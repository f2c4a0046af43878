"""Recordings that change, move, take another's place or are still being copied: each is known by its content."""

import json
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from synthetic import call_cli
from synthetic_clip import record

from flowlab.pipeline.stage import EpisodeRequest, Rejected
from flowlab.pipeline.stages.observe import ObserverStage
from flowlab.pipeline.stages.recording import RecordingStage
from flowlab.recordings.identity import difference, identity
from flowlab.recordings.recording import RecordingSettings
from flowlab.storage.dataset import Dataset

BARS = ("quality.min_sure_share=0", "quality.max_median_sigma_m=9", "quality.max_lost_share=1")
SMALL = ("observer.points=64", "queries.points=10", *BARS)
OPTIONS = ("--tracker", "lucas-kanade", "--workers", "1", *(w for s in SMALL for w in ("--set", s)))

Capture = pytest.CaptureFixture[str]


def label(capsys: Capture, *arguments: str | Path) -> Dataset:
    """Label; the dataset that comes of it."""
    code, _, told = call_cli(capsys, "track-real", *arguments, *OPTIONS)
    assert code == 0, told
    return Dataset(Path(arguments[-1]))


def change(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def test_a_corrected_unit_has_the_recording_labeled_again(
    tmp_path: Path, capsys: Capture, caplog: pytest.LogCaptureFixture
) -> None:
    take, out = record(tmp_path / "pour/0", frames=5, depth_unit_m=0.001), tmp_path / "out"
    other = record(tmp_path / "pour/1", frames=5, seed=1)
    far = label(capsys, take.parent, "--out", out).episode(0).depth
    before = {f.name: f.read_bytes() for f in (out / "shards").iterdir()}
    change(take / "recording.yaml", "depth_unit_m: 0.001", "# half as far\ndepth_unit_m: 0.0005")
    near = label(capsys, take.parent, "--out", out).episode(0).depth
    assert near is not None
    assert far is not None
    np.testing.assert_allclose(far, 2 * near, rtol=1e-6)
    (said,) = [r.getMessage() for r in caplog.records if "again" in r.getMessage()]
    assert said.endswith(f"{take}: recording.yaml or its calibration changed since it was labeled; it is labeled again")
    after = {f.name: f.read_bytes() for f in (out / "shards").iterdir()}
    assert before.keys() == after.keys()
    assert [name for name in after if after[name] != before[name]] == ["pour-000000.zarr.zip"]
    # The control: what did not change is left alone, and comments change nothing.
    change(other / "recording.yaml", "times:", "# of the pictures\ntimes:")
    caplog.clear()
    stamps = {f: f.stat().st_mtime_ns for f in (out / "receipts").iterdir()}
    label(capsys, take.parent, "--out", out)
    assert {f: f.stat().st_mtime_ns for f in (out / "receipts").iterdir()} == stamps
    assert not [r for r in caplog.records if "again" in r.getMessage()]
    assert call_cli(capsys, "validate", out)[0] == 0


def test_a_calibration_file_that_changed_has_its_recordings_labeled_again(tmp_path: Path, capsys: Capture) -> None:
    take, out, file = record(tmp_path / "pour/0", frames=5), tmp_path / "out", tmp_path / "calibration.yaml"
    file.write_text("depth_unit_m: 0.001\n")
    far = label(capsys, take, "--calibration", file, "--out", out).episode(0).depth
    file.write_text("depth_unit_m: 0.0005\n")
    near = label(capsys, take, "--calibration", file, "--out", out).episode(0).depth
    assert near is not None
    np.testing.assert_allclose(far, 2 * near, rtol=1e-6)


def test_a_copy_that_was_not_complete_is_labeled_again(tmp_path: Path, capsys: Capture) -> None:
    whole, take, out = record(tmp_path / "whole", frames=8), tmp_path / "pour/0", tmp_path / "out"
    shutil.copytree(whole, take)
    for k in range(5, 8):
        for name in ("color", "depth"):
            (take / name / f"{k:06d}.png").unlink()
    change(take / "recording.yaml", "times: times.txt", "fps: 10")
    np.save(take / "state.npy", np.zeros((5, 2)))
    assert [len(e) for e in label(capsys, take, "--out", out).episodes()] == [5]
    shutil.copytree(whole / "color", take / "color", dirs_exist_ok=True)
    shutil.copytree(whole / "depth", take / "depth", dirs_exist_ok=True)
    shutil.copy(whole / "state.npy", take)
    assert [len(e) for e in label(capsys, take, "--out", out).episodes()] == [8]


def test_a_recording_that_is_being_copied_is_told_and_tried_again(tmp_path: Path, capsys: Capture) -> None:
    whole, take, out = record(tmp_path / "whole", frames=8), tmp_path / "pour/0", tmp_path / "out"
    shutil.copytree(whole, take, ignore=shutil.ignore_patterns("*[3-7].png"))
    change(take / "recording.yaml", "times: times.txt", "fps: 10")
    change(take / "recording.yaml", "state: state.npy", "")
    done = threading.Event()

    def copy() -> None:
        while not done.wait(0.05):  # as slow as a network; the last files come again and again
            for name in ("color", "depth"):
                shutil.copy(whole / name / "000003.png", take / name)
                with (take / name / "000003.png").open("ab") as file:
                    file.write(b"\0" * int(time.monotonic() * 100 % 1000))

    copier = threading.Thread(target=copy)
    copier.start()
    try:
        code, told, _ = call_cli(capsys, "track-real", take, "--out", out, *OPTIONS)
    finally:
        done.set()
        copier.join()
    assert code != 0
    assert "its files changed while it was read, so it is still being written; run the same command again" in told
    for name in ("color", "depth"):
        shutil.copytree(whole / name, take / name, dirs_exist_ok=True)
    assert [len(e) for e in label(capsys, take, "--out", out).episodes()] == [8]


def overwrite_by_another(picture: Path) -> None:
    shutil.copy(picture.with_name("000003.png"), picture)


def cut_short(picture: Path) -> None:
    picture.write_bytes(picture.read_bytes()[:100])


@pytest.mark.parametrize("spoil", [overwrite_by_another, cut_short, Path.unlink])
@pytest.mark.parametrize("stream", ["color", "depth"])
def test_a_picture_that_changes_after_the_recording_was_opened_is_not_labeled(
    tmp_path: Path, stream: str, spoil: Callable[[Path], None]
) -> None:
    take = record(tmp_path / "pour/0", frames=5)
    opened = RecordingStage().process(EpisodeRequest(task="pour", seed=0, source=str(take)))
    look = ObserverStage(points=64, crop={"low": (-1, -1, 0.15), "high": (1, 1, 1.5)})
    assert len(look.process(opened).points_world) == 5  # the control
    spoil(take / stream / "000001.png")
    with pytest.raises(Rejected, match="its files changed while it was read, so it is still being written") as told:
        look.process(opened)
    assert told.value.retry
    assert told.value.reason.startswith(f"{take}: ")


def test_one_of_the_same_name_is_a_new_recording_and_one_that_moved_is_not(tmp_path: Path, capsys: Capture) -> None:
    monday, tuesday, out = tmp_path / "mon/pour/000", tmp_path / "tue/pour/000", tmp_path / "out"
    record(monday, frames=5)
    label(capsys, monday, "--out", out)
    shutil.move(monday, tmp_path / "archive")
    record(tuesday, frames=6, seed=1)
    both = label(capsys, tuesday, "--out", out)
    assert [len(e) for e in both.episodes()] == [5, 6]
    assert [(r.name, r.source) for r in both.manifest.recordings] == [("000", str(monday)), ("000-2", str(tuesday))]
    # Wherever they lie now, they are known again: nothing is labeled twice.
    shutil.move(tmp_path / "archive", tmp_path / "late/pour/monday")
    shutil.move(tuesday, tmp_path / "late/pour/tuesday")
    stamps = {f: f.stat().st_mtime_ns for f in (out / "receipts").iterdir()}
    moved = label(capsys, tmp_path / "late", "--out", out)
    assert [Path(r.source).name for r in moved.manifest.recordings] == ["monday", "tuesday"]
    assert {f: f.stat().st_mtime_ns for f in (out / "receipts").iterdir()} == stamps


def test_two_of_one_name_at_once_are_two_recordings(tmp_path: Path, capsys: Capture) -> None:
    for k, day in enumerate(("mon", "tue")):
        record(tmp_path / day / "pour/000", frames=5, seed=k)
    dataset = label(capsys, tmp_path / "mon", tmp_path / "tue", "--out", tmp_path / "out")
    assert [r.name for r in dataset.manifest.recordings] == ["000", "000-2"]
    shown = json.loads(
        call_cli(capsys, "track-real", tmp_path / "mon", tmp_path / "tue", "--dry-run", "--json", *OPTIONS)[1]
    )
    assert [Path(r["recording"]).parts[-3] for r in shown["recordings"]] == ["mon", "tue"]


def test_an_identity_is_of_content_alone(tmp_path: Path) -> None:
    read = RecordingSettings()
    one = record(tmp_path / "a", frames=3)
    first = identity(one, read)
    shutil.copytree(one, tmp_path / "b/c")
    (tmp_path / "b/c/.hidden").write_text("x")
    assert identity(tmp_path / "b/c", read) == first
    pixel = tmp_path / "b/c/depth/000001.png"
    pixel.write_bytes(pixel.read_bytes() + b"\0")
    assert difference(first, identity(tmp_path / "b/c", read)) == "its files"
    (one / "color/around").symlink_to(one)  # a circle ends
    assert identity(one, read) == first


@pytest.mark.parametrize("name", ["depth.npy", "log.npz", "file-000.parquet"])
def test_a_number_put_right_in_a_large_file_is_seen(name: str, tmp_path: Path) -> None:
    """Its size stays the same, and it lies where no part of a large file is looked at otherwise."""
    one = record(tmp_path / "a", frames=3)
    (one / name).write_bytes(bytes(6 << 20))
    before = identity(one, RecordingSettings())
    with (one / name).open("r+b") as file:
        file.seek((3 << 20) + 5000)
        file.write(b"1")
    assert difference(before, identity(one, RecordingSettings())) == "its files"
