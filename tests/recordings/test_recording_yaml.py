"""``recording.yaml``: every mistake is named."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from real_recordings import INTRINSICS, K
from scipy.spatial.transform import Rotation

from flowlab.errors import DataError
from flowlab.recordings.base import load_readers
from flowlab.recordings.intrinsics import Intrinsics
from flowlab.recordings.readers.plain import write_rgbd_recording
from flowlab.recordings.recording import RecordingSettings, describe
from flowlab.recordings.recording_yaml import Metadata, combine, load_metadata

PAGE = (Path(__file__).parents[2] / "docs" / "recordings.md").read_text()


def load(tmp_path: Path, text: str) -> Metadata:
    file = tmp_path / "recording.yaml"
    file.write_text(text)
    return load_metadata(file)


def test_an_empty_file_says_nothing(tmp_path: Path) -> None:
    assert load(tmp_path, "# nothing yet\n") == Metadata()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fsp: 30", r"recording\.yaml: no key is called 'fsp'; did you mean fps"),
        ("intrinsics: {fx: 1, fy: 1, cx: 0, c_y: 0}", "no key is called 'c_y'; did you mean cy"),
        ("intrinsics: {fx: 1, fy: 1, cx: 0}", r"intrinsics\.cy: Field required"),
        ("topics: {colr: /a}", "no key is called 'colr'; did you mean color"),
        ("fps: 0", r"fps: .* greater than or equal to 0\.1"),
        ("fps: 1.0e9", r"fps: .* less than or equal to 240 \(found '1\.0e9'\)"),
        ("fps: true", "'fps' holds true or false, expected numbers"),
        (
            "T_world_cam: [[true, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]",
            "'T_world_cam' holds true or false",
        ),
        ("intrinsics: {fx: true, fy: 1, cx: 0, cy: 0}", "'fx' holds true or false"),
        ("fps: 10\ntask: pour\nfps: 20", "'fps' stands twice, in lines 1 and 3; keep one"),
        (
            "intrinsics: {fx: 1, fy: 1, cx: 0, cy: 0, width: 1" + "0" * 400 + "}",
            "intrinsics.width: .* less than or equal",
        ),
        ("intrinsics:\n  fx: 60\n  fx: 90", "'fx' stands twice, in lines 2 and 3"),
        ("depth_unit_m: millimeter", r"depth_unit_m: .* \(found 'millimeter'\)"),
        ("- fps", "must be a mapping"),
        ("fps: [", "not valid YAML"),
        ("T_world_cam: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]", "T_world_cam"),
        (f"T_world_cam: {np.diag([1, 1, -1, 1]).tolist()}", "must be a rigid transform"),
        (f"T_color_depth: {np.diag([2, 2, 2, 1]).tolist()}", "must be a rigid transform"),
        (f"T_world_cam: {np.ones((4, 4)).tolist()}", "must be a rigid transform"),
    ],
)
def test_a_mistake_is_one_sentence_with_file_and_key(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DataError, match=message) as caught:
        load(tmp_path, text)
    assert "recording.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere\.yaml: there is no such file"):
        load_metadata(tmp_path / "nowhere.yaml")


def test_any_rigid_transform_is_taken_as_it_is(tmp_path: Path) -> None:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=4).as_matrix()
    T[:3, 3] = 1, -2, 3
    found = load(tmp_path, yaml.safe_dump({"T_world_cam": T.tolist()})).T_world_cam
    np.testing.assert_array_equal(np.array(found), T)


def test_intrinsics_survive_their_own_yaml() -> None:
    given = Intrinsics(**INTRINSICS, distortion=(0.1, -0.2, 0.0, 0.0, 1 / 3))
    assert Intrinsics.model_validate(yaml.safe_load(given.to_yaml())) == given
    np.testing.assert_array_equal(given.K, K)
    np.testing.assert_array_equal(Intrinsics.from_matrix(K).K, K)


def test_the_first_source_that_has_a_key_wins() -> None:
    a, b = Metadata(fps=10), Metadata(fps=20, depth_unit_m=0.001, success=False)
    values: dict[str, Any] = combine([("a", a), ("b", b)])[0].model_dump(exclude_defaults=True)
    assert values == {"fps": 10, "depth_unit_m": 0.001, "success": False}
    assert combine([("a", a), ("b", b)])[1] == {"fps": "a", "depth_unit_m": "b", "success": "b"}


# --- the page ---------------------------------------------------------------------------------------------


def test_the_yaml_of_the_page_is_valid_and_has_every_key(tmp_path: Path) -> None:
    whole, registration = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    load(tmp_path, whole + registration)
    uncommented = re.sub(r"^# (\w+:)", r"\1", whole, flags=re.MULTILINE)
    load(tmp_path, uncommented + registration)
    named = set(yaml.safe_load(uncommented + registration))
    elsewhere = {k for k in Metadata.model_fields if f"`{k}" in PAGE}
    assert named | elsewhere == set(Metadata.model_fields)


def test_the_settings_and_readers_of_the_page_exist() -> None:
    assert set(re.findall(r"`recording\.(\w+)", PAGE)) - {"yaml"} <= set(RecordingSettings.model_fields)
    for reader in load_readers():
        assert f"| `{reader.name}`" in PAGE, reader.name


def test_the_recording_of_the_page_is_written_and_read(tmp_path: Path) -> None:
    block = next(b for b in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "write_rgbd_recording" in b)
    exec(block, {"folder": tmp_path / "r"})
    assert write_rgbd_recording.__name__ in block
    about = describe(tmp_path / "r", RecordingSettings())
    assert (about.rows, about.state_width, about.depth_unit_m, about.problem) == (10, 7, 0.0001, None)
