"""What tells of somebody's machine stays there."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from hub_server import HubServer, standing_in
from synthetic import SETTINGS, call_cli, make_dataset, make_episode, make_provenance

from flowlab.hub.local_paths import told_names, without_local_paths
from flowlab.storage.dataset import Dataset
from flowlab.storage.merging import merge
from flowlab.storage.recorded import Recorded

SECRET = "/home/joe bloggs/robots"


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[HubServer]:
    with standing_in(monkeypatch, tmp_path) as server:
        yield server


@pytest.mark.parametrize(
    ("text", "clean"),
    [
        ("/home/joe/data/pour", "pour"),
        ("cannot read '/home/joe/data/cam.yaml' (denied)", "cannot read 'cam.yaml' (denied)"),
        ("~/data/x and ~joe/data/y", "x and y"),
        ("C:\\Users\\joe\\data\\x", "x"),
        ("\\\\server\\share\\joe\\x", "x"),
        ("file:///home/joe/x/y", "y"),
        ("../../joe/x", "x"),
        ("/home/joe", "(a local path)"),
        ("/camera/color/image_raw", "/camera/color/image_raw"),
        ("https://example.org/home/joe/x", "https://example.org/home/joe/x"),
        ("m/s", "m/s"),
        ("demos/pour/take-1", "demos/pour/take-1"),
    ],
)
def test_local_paths_are_cut_and_topics_and_addresses_are_not(text: str, clean: str) -> None:
    assert without_local_paths({"a": [text]})[0] == {"a": [clean]}
    assert without_local_paths({"a": [text]})[1] == ([] if text == clean else ["a"])


def test_what_is_a_path_may_have_spaces() -> None:
    assert without_local_paths({"source": f"{SECRET}/take 1"}) == ({"source": "take 1"}, ["source"])


def test_names_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("socket.gethostname", lambda: "zeppelin7")
    assert told_names("made on zeppelin7.") == ["zeppelin7"]
    assert told_names("zeppelin70") == []


def test_a_merged_dataset_has_the_license_that_all_have(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    places = []
    for k, name in enumerate(("mit", "mit", "cc-by-4.0")):
        about = make_provenance(license=name, hub=f"anna/d{k}@{'0' * 40}")
        places.append(make_dataset(tmp_path / f"d{k}", [[make_episode(k)]], provenance=about).path)
    same, other = merge(places[:2], tmp_path / "same"), merge(places[1:], tmp_path / "other")
    assert (same.provenance.license, same.provenance.hub) == ("mit", "")
    assert other.provenance.license == ""
    assert "licenses differ" in caplog.text
    assert [d["license"] for d in other.manifest.settings["merge"]["of"]] == ["mit", "cc-by-4.0"]


def test_a_dataset_goes_without_the_paths_of_its_machine(
    hub: HubServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    odd = replace(make_episode(1), extras={"origin": {"K": f"from {SECRET.split()[0]}/x/cam.yaml"}})
    recordings = tuple(
        Recorded(task="roll", name=f"take-{k}", seed=k, source=f"{SECRET}/take-{k}", content=f"c{k}") for k in (0, 1)
    )
    settings = {**SETTINGS, "weights": {"file": "/home/joe/models/w.pt"}}
    data = make_dataset(tmp_path / "d", [[make_episode(0)], [odd]], recordings=recordings, settings=settings)
    (data.path / "failures.log").write_text(f"{SECRET}: Traceback")
    code, out, err = call_cli(capsys, "hub", "push", data.path, "anna/it", "--yes")
    assert code == 0, err
    files = hub.files("datasets/anna/it")
    assert not any(b"joe" in content for content in files.values())
    assert "failures.log" not in files
    assert "stays here: failures.log" in out
    assert "cut to their last names in: settings.weights.file, recordings.source, shards.extras.origin.K" in out
    assert "written anew without them: shards/roll-000001-000001.zarr.zip; the fingerprint there is" in out
    code, out, err = call_cli(capsys, "hub", "pull", "anna/it", "--out", tmp_path / "back")
    assert code == 0, err
    back = Dataset(tmp_path / "back")
    assert back.manifest.settings_digest == data.manifest.settings_digest
    assert [r.source for r in back.manifest.recordings] == ["take-0", "take-1"]
    assert back[1].extras == {"origin": {"K": "from cam.yaml"}}
    name = "shards/roll-000000-000000.zarr.zip"
    assert (back.path / name).read_bytes() == (data.path / name).read_bytes()
    assert call_cli(capsys, "validate", back.path)[0] == 0
    assert (data.path / "flowlab.json").read_text().count("joe") == 3, "what is here stays as it is"
