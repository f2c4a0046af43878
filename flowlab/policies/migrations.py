"""Runs of earlier versions, read as those of today: their settings and the names of their weights.

Format 1 is that of flowlab up to commit 79a7dbb.
"""

import re
from collections.abc import Mapping
from typing import Any

from flowlab.storage.migrations import migrate_observer

FORMAT = 2
"""Of ``policy.json``."""
_SETTINGS = {"history": "n_obs_steps", "executed": "n_action_steps", "optimiser": "optimizer"}
_SPEC = {"normaliser": "normalizer", "layout": "channels"}
_CHANNELS = {"state_places": "state_positions", "action_place": "action_position"}
_MOTION_OF_ALL = {"condition", "condition_noise", "weight", "features", "denoiser"}
"""Settings of a motion that every policy has which predicts one; the others were 3D FDP's alone."""
_OLD_OPTIMIZER = "optimiser"
"""What resume files of format 1 call it."""
_TENSORS = (
    (r"^places\.", "query_encoder."),
    (r"^motion\.project\.", "motion.query_projection."),
    (r"^motion\.convolve\.", "motion.summary_layer."),
    (r"^motion\.leave\.", "motion.summary_output."),
    (r"\benter\.", "input_layer."),
    (r"\bleave\.", "output_layer."),
    (r"\bof_condition\.", "condition_layer."),
    (r"\bof_step\.", "step_layer."),
    (r"\bof_motion\.", "motion_layer."),
    (r"\bof_place\.", "query_layer."),
    (r"\bpast\.", "skip."),
    (r"\bshorten\.", "downsample."),
    (r"\blengthen\.", "upsample."),
)
"""Names of weights, old and new, as patterns and what stands in their place."""


def is_old(values: Any) -> bool:
    """Whether a ``policy.json`` is of format 1, and with it all weights beside it: a name of today is left as it is."""
    return isinstance(values, dict) and values.get("format", 1) == 1


def migrate_policy(values: Any) -> Any:
    """The values of a ``policy.json`` in today's format; anything else than one of format 1 is left as it is."""
    if not is_old(values):
        return values
    moved = _renamed(values, {"layouts": "scene_seeds"})
    if not isinstance(values.get("policy"), dict):
        return {**moved, "format": FORMAT}  # whoever reads it says what is wrong
    spec = _renamed(values["policy"], _SPEC)
    spec["settings"] = migrate_settings(spec.get("settings"))
    spec["channels"] = _renamed(spec.get("channels"), _CHANNELS)
    spec["normalizer"] = _normalizer(spec.get("normalizer"), spec["settings"])
    if isinstance(observer := spec.get("observer"), dict):
        spec["observer"] = migrate_observer(dict(observer))
    return {**moved, "format": FORMAT, "policy": spec}


def migrate_tensor(name: str) -> str:
    """The name that a weight of format 1 has today; of a resume file too, where what it is comes first
    (``policy:``, ``optimizer:exp_avg/``)."""
    prefix, weight = re.fullmatch(r"(.*[:/])?(.*)", name).groups("")  # type: ignore[union-attr]
    for pattern, replacement in _TENSORS:
        weight = re.sub(pattern, replacement, weight)
    return prefix.replace(f"{_OLD_OPTIMIZER}:", "optimizer:") + weight


def _renamed(values: Any, names: Mapping[str, str]) -> Any:
    return {names.get(k, k): v for k, v in values.items()} if isinstance(values, dict) else values


def migrate_settings(values: Any) -> Any:
    """Each policy's own: a motion was among the settings of all of them."""
    if not isinstance(values, dict):
        return values
    settings = _renamed(values, _SETTINGS)
    motion = settings.pop("motion", None)
    if not isinstance(motion, dict) or settings.get("policy") == "dp3":
        return settings
    if settings.get("policy") == "mba":
        return {**settings, "motion": {k: v for k, v in motion.items() if k in _MOTION_OF_ALL}}
    return {**settings, "motion": _renamed(motion, {"layout": "flow_representation"})}


def _normalizer(values: Any, settings: Any) -> Any:
    """Of flow only where it is learned: there was one for all policies."""
    normalizer = _renamed(values, {"place": "position"})
    if isinstance(normalizer, dict) and isinstance(settings, dict) and settings.get("policy") != "fdp":
        return {k: v for k, v in normalizer.items() if k not in ("flow", "flow_clip")}
    return normalizer
