"""What earlier versions of flowlab wrote, as this one reads it: migrated on read, so that no other module knows of it.

Until schema version 1 had a ``provenance``, what a dataset is was told by the names of its stages. Here, and nowhere
else, is that still asked.
"""

import hashlib
import json
from collections.abc import Callable, Mapping
from typing import Any

from flowlab.provenance import Channels, Provenance

Json = dict[str, Any]

_HAND, _RIGHT_FINGER, _LEFT_FINGER = (0, 1, 2), (3, 4, 5), (6, 7, 8)


def migrate_manifest(values: Json) -> Json:
    """A manifest as this flowlab would have written it, with the digest that its shards carry."""
    if "provenance" in values or not isinstance(values.get("settings"), Mapping):
        return values  # of this format, or of none: then reading it says what is wrong
    migrated = {k: v for k, v in values.items() if k not in ("camera", "world_frame", "units")}
    settings = {name: _renamed(name, stage) for name, stage in values["settings"].items()}
    return migrated | {
        "settings": settings,
        "provenance": _provenance(values, settings).model_dump(mode="json"),
        "first_settings_digest": _settings_digest(values["settings"]),
    }


def migrate_receipt(values: Json) -> Json:
    """A receipt whose rejects say whether they are tried again."""
    rejects = values.get("rejects") if isinstance(values, dict) else None
    if not isinstance(rejects, list) or not all(isinstance(x, Mapping) for x in rejects):
        return values
    return values | {"rejects": [{"retry": x.get("stage") == "recording", **x} for x in rejects]}


def _settings_digest(settings: Mapping[str, Any]) -> str:
    """As it was computed: of the stages' names, too."""
    return hashlib.sha256(json.dumps(list(settings.items()), sort_keys=True).encode()).hexdigest()[:16]


def _renamed(name: str, stage: Any) -> Any:
    """The settings of a stage by their names of today."""
    rename = _RENAMED.get(name)
    return rename(dict(stage)) if rename is not None and isinstance(stage, Mapping) else stage


def migrate_observer(stage: Json) -> Json:
    """Settings of the Observer by their names of today."""
    stray = stage.get("remove_outliers")
    if isinstance(stray, Mapping):
        names = {"neighbours": "neighbors", "deviations": "std_ratio"}
        stage["remove_outliers"] = {names.get(k, k): v for k, v in stray.items()}
    return stage


def _track(stage: Json) -> Json:
    return stage | {"tracker": "rigid-bodies"} if stage.get("tracker") == "bodies" else stage


_RENAMED: dict[str, Callable[[Json], Json]] = {"observer": migrate_observer, "track": _track}


def _provenance(values: Json, settings: Mapping[str, Any]) -> Provenance:
    """What the stages of those days would say today."""
    known: Json = {
        "world_frame": values.get("world_frame", ""),
        "camera": values.get("camera", {}),
        "observer": settings.get("observer"),
        "queries": settings.get("queries"),
    }
    if "recording" in settings:
        known |= {"kind": "recorded"}
    if "expert" in settings:
        known |= _metaworld(_setting(settings, "expert", "scene"))
    if "rigid-flow" in settings:
        known |= {"tracks": "exact"}
    if "track" in settings:
        known |= {"tracks": "estimated", "tracker": _setting(settings, "track", "tracker")}
    return Provenance.model_validate(known)


def _setting(settings: Mapping[str, Any], stage: str, name: str) -> Any:
    """One setting of a stage; None where a damaged manifest lacks it."""
    return settings[stage].get(name) if isinstance(settings[stage], Mapping) else None


def _metaworld(scene: Any) -> Json:
    dp3 = isinstance(scene, Mapping) and scene.get("convention") == "dp3"
    frame = "simulator" if dp3 else "world"
    fingers = (("hand", _HAND), ("right finger", _RIGHT_FINGER), ("left finger", _LEFT_FINGER))
    return {
        "kind": "simulated",
        "simulator": "metaworld",
        "scene": scene,
        "state": [Channels(name=n, index=i, kind="position", frame=frame, unit="m") for n, i in fingers],
        "action": [
            Channels(name="hand", index=_HAND, kind="displacement", frame=frame, unit="cm"),
            Channels(name="gripper", index=(3,), kind="effort", frame="", unit="1"),
        ],
        "action_limits": [[-1.0] * 4, [1.0] * 4],
    }
