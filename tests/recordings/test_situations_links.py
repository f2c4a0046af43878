"""Links among recordings: followed, each recording once, and told of where they lead nowhere."""

import json
from pathlib import Path

import pytest
from real_recordings import write_folder
from synthetic import call_cli


def test_links_among_recordings_are_followed_or_told_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    write_folder(tmp_path / "all" / "a")
    write_folder(tmp_path / "elsewhere")
    (tmp_path / "all" / "b").symlink_to(tmp_path / "elsewhere")
    code, out, err = call_cli(capsys, "track-real", tmp_path / "all", "--dry-run", "--json")
    assert [Path(f["recording"]).name for f in json.loads(out)["recordings"]] == ["a", "b"]
    assert (code, err, caplog.messages) == (0, "", [])
    (tmp_path / "all" / "c").symlink_to(tmp_path / "on a disk that is not there")
    (tmp_path / "all" / "day2.mcap").symlink_to(tmp_path / "day2.mcap")
    (tmp_path / "all" / "circle").symlink_to(tmp_path / "all" / "circle")
    code, out, _ = call_cli(capsys, "track-real", tmp_path / "all", "--dry-run", "--json")
    assert (code, len(json.loads(out)["recordings"])) == (0, 2)
    lines = [line for line in caplog.messages if "leads nowhere" in line]
    for name, line in zip(("c", "circle", "day2.mcap"), lines, strict=True):
        assert f"all/{name}: " in line
        assert line.endswith("it is left out")
