"""What older versions of flowlab called things in the results of experiments."""

from typing import Any

from flowlab.evaluation.migrations import migrate_episode, rename_keys
from flowlab.policies.migrations import migrate_settings

_EVALUATION = {"executed": "n_action_steps"}


def migrate_result(values: Any) -> Any:
    """The values of a result under the names of today; what is no result is left for validation to refuse."""
    if not isinstance(values, dict):
        return values
    training = values.get("training")
    if isinstance(training, dict):
        values = {**values, "training": {**training, "settings": migrate_settings(training.get("settings"))}}
    evaluations = values.get("evaluations")
    if isinstance(evaluations, list):
        values = {**values, "evaluations": [_migrate_evaluation(e) for e in evaluations]}
    return values


def _migrate_evaluation(values: Any) -> Any:
    """The values of one checkpoint's evaluation under the names of today."""
    values = rename_keys(values, _EVALUATION)
    if isinstance(values, dict) and isinstance(values.get("outcomes"), list):
        values = {**values, "outcomes": [migrate_episode(o) for o in values["outcomes"]]}
    return values
