"""Example 3 labels a recording by a tracker of its own."""

import re
from pathlib import Path

import synthetic_clip
from run_example import run_example

from flowlab.storage.dataset import Dataset


def test_a_recording_is_labeled_by_it(tmp_path: Path) -> None:
    recording = synthetic_clip.record(tmp_path / "slide" / "rec", frames=8)
    output = run_example("03_own_tracker.py", recording, tmp_path / "data")
    stated = re.search(r"slide: half of all positions are stated to ([\d.]+) mm or better", output)
    assert stated, output
    (episode,) = Dataset(tmp_path / "data").episodes()
    assert episode.extras["tracker"]["tracker"] == "patches"
    assert episode.extras["tracker"]["options"] == {"radius": 9}
    error = episode.tracks.xyz_world - synthetic_clip.truth(episode.queries.xyz_world, 8)
    assert abs(error[episode.tracks.visible]).max(initial=0) < 0.05
    assert episode.tracks.visible.mean() > 0.8
