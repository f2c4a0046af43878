"""A policy as it goes to the Hub, and as it comes from there: settings in JSON, weights in safetensors, no code."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flowlab.checksums import with_checksum, without_checksum
from flowlab.errors import DataError
from flowlab.files import write_atomically, write_json
from flowlab.hub.cards import policy_page
from flowlab.hub.local_paths import without_local_paths
from flowlab.hub.names import HubName
from flowlab.hub.published_dataset import Staged, pulled_from
from flowlab.hub.repo_layout import CARD, CONFIG, PICTURE, WEIGHTS
from flowlab.policies.checkpoint import load_policy
from flowlab.policies.run_config import read_run_config
from flowlab.policies.tensor_files import check_finite
from flowlab.policies.trained import CHECKPOINTS, POLICY, RUN, TrainedPolicy, checkpoint_name, step_of, validated
from flowlab.untrusted import read_json
from flowlab.viz.training_metrics import METRICS


def stage_policy(path: Path, folder: Path, name: HubName, license_name: str | None) -> Staged:
    """Fill an empty folder with all of a policy that goes to the Hub; its weights as a link.

    Args:
        path: A run, whose newest weights go, or one of its checkpoints.
        folder: What is filled.
        name: What it is called there.
        license_name: Under which license it is; None leaves it as it is.

    Raises:
        DataError: It is damaged, or its settings hold a local path.
    """
    loaded = load_policy(path)
    run = loaded.path.absolute().parents[1]
    sources = _sources(run)
    said = {"dataset": ", ".join(sources) or _last_names(loaded.trained.dataset)}
    said |= {"license": license_name} if license_name else {}
    values = _said_otherwise(run / POLICY, said)
    trained = loaded.trained.model_copy(update=said)
    if places := without_local_paths(values)[1]:
        raise DataError(
            f"{run / POLICY}: {places[0]} is a local path, without which the policy does not load, and with which it "
            "tells of your machine; train with a path that is relative, or without"
        )
    write_json(folder / CONFIG, with_checksum(values))
    (folder / WEIGHTS).symlink_to(loaded.path.resolve())
    picture = _draw_curve(run, folder)
    on_hub = [source.partition("@")[0].removeprefix("hub:") for source in sources if source.startswith("hub:")]
    write_atomically(folder / CARD, policy_page(name, trained, loaded.step, on_hub, picture=picture))
    changed = ("dataset",) if trained.dataset != loaded.trained.dataset else ()
    return Staged(trained.license, changed, fingerprint=trained.fingerprint)


def _said_otherwise(path: Path, said: Mapping[str, str]) -> dict[str, Any]:
    """What ``policy.json`` says, as its weights know it, but for what may be said otherwise."""
    values = without_checksum(read_json(path), path, "restore it")
    return {**{name: value for name, value in values.items() if name != "hub"}, **said}


def _sources(run: Path) -> list[str]:
    """What a run learned from: the names on the Hub, else those of the folders; empty where that is not known."""
    if not (run / RUN).is_file():
        return []
    places = read_run_config(run).datasets
    return [f"hub:{hub}" if (hub := pulled_from(place)) else place.name for place in places]


def _last_names(dataset: str) -> str:
    """Paths of datasets as they were given, without their folders; names on the Hub as they are."""
    return ", ".join(p if p.startswith("hub:") else Path(p).name for p in dataset.split(", "))


def _draw_curve(run: Path, folder: Path) -> bool:
    """Draw how losses fell; whether there was anything to draw."""
    from flowlab.viz.training_figure import draw_training

    if not (run / METRICS).is_file():
        return False
    try:
        draw_training(run / METRICS, folder / PICTURE)
    except DataError:
        return False
    return (folder / PICTURE).is_file()


def finish_policy(fetched: Path, folder: Path, where: HubName) -> None:
    """Make of what was fetched a folder that all commands take for a run's, and load the policy once.

    Raises:
        DataError: It is damaged, not flowlab's, or a policy that is not installed here.
    """
    validated(TrainedPolicy, fetched / CONFIG)
    weights = folder / CHECKPOINTS / checkpoint_name(step_of(fetched / WEIGHTS))
    weights.parent.mkdir()
    write_json(folder / POLICY, with_checksum(_said_otherwise(fetched / CONFIG, {"hub": str(where)})))
    (fetched / WEIGHTS).rename(weights)
    check_finite(weights, load_policy(weights).policy.state_dict())


def policy_pulled_from(folder: Path) -> str:
    """Where a policy was pulled from; empty where it was not, or is none."""
    try:
        return validated(TrainedPolicy, folder / POLICY).hub if (folder / POLICY).is_file() else ""
    except DataError:
        return ""
