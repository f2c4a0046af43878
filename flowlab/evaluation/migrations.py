"""What older versions of flowlab called things in the results of episodes."""

from typing import Any

_EPISODE = {"layout": "scene_seed"}


def migrate_episode(values: Any) -> Any:
    """The values of an episode's result under the names of today; anything else as it is."""
    return rename_keys(values, _EPISODE)


def rename_keys(values: Any, names: dict[str, str]) -> Any:
    """A mapping in which old keys have their new names, in the same order; what is none, or has both, as it is."""
    if not isinstance(values, dict):
        return values
    return {names[k] if k in names and names[k] not in values else k: v for k, v in values.items()}
