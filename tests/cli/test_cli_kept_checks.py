"""What was found when recordings were checked is kept with their episodes, and said wherever one looks at them."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from synthetic import call_cli
from synthetic_clip import record

from flowlab.pipeline.kept_checks import kept_checks
from flowlab.recordings.verdicts import Verdict
from flowlab.report.episode_view import view_episode
from flowlab.storage.dataset import Dataset
from flowlab.viz.captions import describe_checks

Capture = pytest.CaptureFixture[str]
SETTINGS = ("observer.points=64", "queries.points=8", "quality.min_sure_share=0", "quality.max_median_sigma_m=9")
SMALL = ("--tracker", "lucas-kanade", *(word for change in SETTINGS for word in ("--set", change)))
OLD = Path(__file__).parents[1] / "fixtures" / "old" / "dataset-real"


@pytest.fixture
def dataset(tmp_path: Path, capsys: Capture) -> Path:
    """Two recordings; beside the pictures of the second lies an action that nothing names."""
    for name in ("good", "odd <b>"):
        record(tmp_path / "slide" / name, 4)
    np.save(tmp_path / "slide" / "odd <b>" / "action.npy", np.zeros((4, 2)))
    out = tmp_path / "data"
    assert call_cli(capsys, "track-real", tmp_path / "slide", "--out", out, "--workers", "1", *SMALL)[0] == 0
    return out


def test_info_validate_and_the_viewer_say_what_was_doubtful(dataset: Path, capsys: Capture) -> None:
    told = json.loads(call_cli(capsys, "info", dataset, "--json")[1])["checks"]
    assert told["verdicts"]["doubtful"] == 1
    assert told["episodes_not_checked"] == told["verdicts"]["refused"] == 0
    (doubt,) = told["doubtful"]
    assert (doubt["task"], doubt["seed"], doubt["recording"]) == ("slide", 1, "odd <b>")
    assert doubt["checks"][0]["about"] == "action"
    out = call_cli(capsys, "info", dataset)[1]
    assert f"checks of recordings: {told['verdicts']['ok']} ok" in out
    assert "doubtful: slide seed 1 (odd <b>): action: action.npy is not used" in out
    code, out, err = call_cli(capsys, "validate", dataset)
    assert (code, out) == (0, f"{dataset}: sound\n")
    assert "slide-000001.zarr.zip: slide seed 1 (odd <b>): action is doubtful: action.npy is not used" in err
    assert err.count("warning") == 1
    code, out, _ = call_cli(capsys, "validate", dataset, "--json")
    assert (code, json.loads(out)) == (0, [])
    shown = describe_checks(view_episode(dataset, 1).episode).splitlines()
    assert shown[2].startswith("| doubtful | action | action.npy is not used")
    assert len(shown) == 2 + len(list(kept_checks(Dataset(dataset)))[1].checks or ())


def test_an_episode_of_an_earlier_flowlab_was_not_checked(tmp_path: Path, capsys: Capture) -> None:
    old = Path(shutil.copytree(OLD, tmp_path / "old"))
    told = json.loads(call_cli(capsys, "info", old, "--json")[1])["checks"]
    assert told == {"verdicts": dict.fromkeys(map(str, Verdict), 0), "episodes_not_checked": 1, "doubtful": []}
    assert "checks of recordings: 1 episode not checked" in call_cli(capsys, "info", old)[1]
    assert "1 episode was labeled without checks" in call_cli(capsys, "validate", old)[2]
    assert "was not checked" in describe_checks(Dataset(old).episode(0))
