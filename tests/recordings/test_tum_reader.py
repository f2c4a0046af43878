"""The layout of the TUM RGB-D benchmark."""

from pathlib import Path

import numpy as np
import pytest
from real_recordings import INTRINSICS, colors, counts, opened, said, write_png, write_yaml

from flowlab.errors import DataError
from flowlab.recordings.readers.tum import KINECTS
from flowlab.recordings.recording import RecordingSettings, describe, find_recordings

COLOR_S = 1305031102.175304 + np.arange(6) / 30
DEPTH_S = COLOR_S[[0, 1, 2, 4, 5]] - 0.01
"""One depth picture is missing, as often."""


def write_sequence(folder: Path, *, lists: bool = True) -> Path:
    for name, times, pictures in (("rgb", COLOR_S, colors()), ("depth", DEPTH_S, counts()[[0, 1, 2, 4, 5]] * 5)):
        lines = [f"# {name} images", "# timestamp filename"]
        for t, picture in zip(times, pictures, strict=True):
            write_png(folder / name / f"{t:.6f}.png", picture)
            lines.append(f"{t:.6f} {name}/{t:.6f}.png")
        if lists:
            (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return folder


def test_a_sequence_is_read_by_its_lists(tmp_path: Path) -> None:
    path = write_sequence(tmp_path / "seq")
    write_yaml(path / "recording.yaml", intrinsics=INTRINSICS)
    assert find_recordings([tmp_path]) == [path]
    recording = opened(path, max_bad_share=0.2)
    for k, t in enumerate([0, 1, 2, 4, 5]):
        np.testing.assert_allclose(recording.frame(k).depth, counts()[t] / 1000, rtol=1e-6)
        np.testing.assert_array_equal(recording.frame(k).rgb, colors()[t])
    ((name, _),) = recording.extras["bad_frames"]
    assert name == f"rgb/{COLOR_S[3]:.6f}.png"
    assert recording.extras["max_sync_error_s"]["depth"] == pytest.approx(1 / 30 - 0.01, abs=1e-4)
    np.testing.assert_allclose(recording.time_s, (COLOR_S - COLOR_S[0])[[0, 1, 2, 4, 5]], atol=2e-6)
    assert recording.extras["depth_unit_m"] == pytest.approx(0.0002)


def test_intrinsics_must_be_given(tmp_path: Path) -> None:
    path = write_sequence(tmp_path / "seq")
    with pytest.raises(DataError, match=r"intrinsics of the color camera are not known; write into .*recording\.yaml"):
        opened(path)


@pytest.mark.parametrize("camera", sorted(KINECTS))
def test_the_benchmarks_cameras_are_known(tmp_path: Path, camera: str) -> None:
    path = write_sequence(tmp_path / f"rgbd_dataset_{camera}_desk")
    about = describe(path, RecordingSettings(max_bad_share=0.5))
    assert about.metadata.intrinsics == KINECTS[camera]
    assert about.origin["intrinsics"] == f"TUM RGB-D's calibration of {camera}"
    assert about.problem is not None
    assert "pictures of 640x480, but these have 32x24" in about.problem


def test_associations_do_without_lists(tmp_path: Path) -> None:
    path = write_sequence(tmp_path / "seq", lists=False)
    pairs = list(zip(COLOR_S[[0, 1, 2, 4, 5]], DEPTH_S, strict=True))
    lines = [f"{c:.6f} rgb/{c:.6f}.png {d:.6f} depth/{d:.6f}.png" for c, d in pairs]
    (path / "associations.txt").write_text("\n".join(lines))
    write_yaml(path / "recording.yaml", intrinsics=INTRINSICS, depth_unit_m=0.001)
    for k, t in enumerate([0, 1, 2, 4, 5]):
        recording = opened(path)
        np.testing.assert_array_equal(recording.frame(k).rgb, colors()[t])
        np.testing.assert_allclose(recording.frame(k).depth, counts()[t] * 0.005, rtol=1e-6)


def test_a_millimeter_sequence_in_this_layout(tmp_path: Path) -> None:
    path = write_sequence(tmp_path / "seq")
    (path / "groundtruth.txt").touch()
    write_yaml(path / "recording.yaml", intrinsics=INTRINSICS, depth_unit_m=0.001)
    recording = opened(path, every=4)
    assert recording.extras["depth_unit_m"] == 0.001
    assert said(recording, "poses").startswith("groundtruth.txt is not used")


@pytest.mark.parametrize("line", ["1305031102.2", "now rgb/a.png", "1.0 rgb/a.png more", "nan rgb/a.png"])
def test_a_broken_line_is_named(tmp_path: Path, line: str) -> None:
    path = write_sequence(tmp_path / "seq")
    with (path / "rgb.txt").open("a") as file:
        file.write(line + "\n")
    with pytest.raises(DataError, match=r"rgb\.txt: line 9 is not time file"):
        opened(path)


def test_a_listed_picture_that_is_missing_is_bad(tmp_path: Path) -> None:
    path = write_sequence(tmp_path / "seq")
    write_yaml(path / "recording.yaml", intrinsics=INTRINSICS)
    (path / "rgb" / f"{COLOR_S[1]:.6f}.png").unlink()
    bad = opened(path, max_bad_share=0.5).extras["bad_frames"]
    assert bad[0] == [f"rgb/{COLOR_S[1]:.6f}.png", "cannot be read (there is no such file)"]
