"""True tracks come back as they were stored; what is wrong with a file is said in one sentence."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic import assert_same

from flowlab.errors import DataError
from flowlab.grading.ground_truth import FILE_NAME, GroundTruth, has_ground_truth, read


@pytest.fixture
def truth() -> GroundTruth:
    rng = np.random.default_rng(0)
    return GroundTruth(
        rng.uniform(0, 99, (7, 2)).astype(np.float32),
        rng.normal(size=(5, 7, 3)).astype(np.float32),
        rng.random((5, 7)) < 0.5,
        np.array([0, 1, 2, 2, -1, 3, 4], np.int8),
    )


@pytest.mark.parametrize("with_role", [True, False])
def test_round_trip(tmp_path: Path, truth: GroundTruth, with_role: bool) -> None:
    truth = truth if with_role else replace(truth, role=None)
    assert not has_ground_truth(tmp_path)
    np.savez_compressed(tmp_path / FILE_NAME, **truth.arrays())
    assert has_ground_truth(tmp_path)
    assert_same(read(tmp_path), truth)
    assert_same(read(tmp_path / FILE_NAME), truth)


def test_other_number_types_are_taken(tmp_path: Path, truth: GroundTruth) -> None:
    wide = {name: a.astype(a.dtype.kind + "8" if a.dtype.kind in "fi" else "?") for name, a in truth.arrays().items()}
    np.savez(tmp_path / "other.npz", **wide)
    assert_same(read(tmp_path / "other.npz"), truth)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"ground_truth.npz: there is no such file; .*--tasks"):
        read(tmp_path)


@pytest.mark.parametrize("damage", ["text", "truncated", "empty", "flipped"])
def test_a_damaged_file(tmp_path: Path, truth: GroundTruth, damage: str) -> None:
    path = tmp_path / FILE_NAME
    np.savez_compressed(path, **truth.arrays())
    whole = path.read_bytes()
    flipped = bytes(b ^ 0x55 if 300 < k < 340 else b for k, b in enumerate(whole))
    damaged = {"text": b"hello", "truncated": whole[: len(whole) // 2], "empty": b"", "flipped": flipped}
    path.write_bytes(damaged[damage])
    with pytest.raises(DataError, match=r"ground_truth.npz: .*not a readable NumPy file"):
        read(tmp_path)


def test_an_array_alone_is_no_truth(tmp_path: Path) -> None:
    np.save(tmp_path / "alone.npy", np.zeros(3))
    with pytest.raises(DataError, match=r"alone.npy: not a readable NumPy file"):
        read(tmp_path / "alone.npy")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"visible": None}, r"has no array 'visible'; found query_px, role, tracks_cam"),
        ({"visible": np.ones((5, 6), bool)}, r"'visible' has the shape \(5, 6\), expected \(5, 7\)"),
        ({"visible": np.ones((5, 7))}, r"'visible' has the type float64, expected booleans"),
        ({"tracks_cam": np.zeros((5, 6, 3), np.float32)}, r"'tracks_cam' has the shape \(5, 6, 3\), expected \(5, 7"),
        ({"tracks_cam": np.zeros((0, 7, 3), np.float32)}, r"holds no track"),
        ({"tracks_cam": np.full((5, 7, 3), np.nan, np.float32)}, r"'tracks_cam' holds 105 values that are not finite"),
        ({"query_px": np.zeros((7, 3), np.float32)}, r"'query_px' has the shape \(7, 3\), expected \(7, 2\)"),
        ({"role": np.zeros(6, np.int8)}, r"'role' has the shape \(6,\), expected \(7,\)"),
        ({"role": np.zeros(7)}, r"'role' has the type float64, expected whole numbers"),
    ],
)
def test_what_does_not_fit(
    tmp_path: Path, truth: GroundTruth, change: dict[str, np.ndarray | None], expected: str
) -> None:
    arrays = {name: a for name, a in {**truth.arrays(), **change}.items() if a is not None}
    np.savez(tmp_path / FILE_NAME, **arrays)
    with pytest.raises(DataError, match=f"ground_truth.npz: {expected}"):
        read(tmp_path)
