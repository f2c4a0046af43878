"""Trackers by name: what exists, what does not, and what an option may be."""

import pytest

from flowlab.errors import UsageError
from flowlab.registry import TRACKERS
from flowlab.tracking.base import make_tracker
from flowlab.tracking.trackers.lucas_kanade import LucasKanade


def test_trackers_are_found_by_name_and_take_options() -> None:
    assert make_tracker("lucas-kanade") == LucasKanade()
    assert make_tracker("flowlab.tracking.trackers.lucas_kanade:LucasKanade") == LucasKanade()
    assert make_tracker("lucas-kanade", {"window": 15, "levels": "2"}) == LucasKanade(window=15, levels=2)


def test_every_installed_tracker_is_listed_with_where_it_lives() -> None:
    assert TRACKERS.plugins()["lucas-kanade"].place == "flowlab.tracking.trackers.lucas_kanade:LucasKanade"


def test_a_tracker_says_what_made_its_labels() -> None:
    described = make_tracker("lucas-kanade", {"window": 15}).describe()
    assert described["tracker"] == "lucas-kanade"
    assert "Apache-2.0" in described["license"]
    assert described["options"]["window"] == 15


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("lucas-canade", {}, r"no tracker is called 'lucas-canade'; did you mean lucas-kanade\?"),
        ("xyz", {}, r"no tracker is called 'xyz'; there are: .*lucas-kanade"),
        ("lucas-kanade", {"windw": 3}, r"tracker 'lucas-kanade': no option is called 'windw'; did you mean window\?"),
        ("lucas-kanade", {"window": "wide"}, r"tracker 'lucas-kanade': window: .* integer.* \(found 'wide'\)"),
        ("lucas-kanade", {"window": 0}, r"tracker 'lucas-kanade': window: .* greater than .* \(found 0\)"),
    ],
)
def test_what_does_not_exist_is_one_clear_sentence(name: str, options: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make_tracker(name, options)
