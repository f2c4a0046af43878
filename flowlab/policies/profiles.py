"""From a profile and changes to the settings of a training run, of whatever policy."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, SerializeAsAny, ValidationError

from flowlab.config import Settings, explain, merge, override, read_named
from flowlab.data.training_settings import TrainSettings
from flowlab.errors import UsageError, unknown_name
from flowlab.policies.settings import OWN
from flowlab.registry import POLICIES
from flowlab.text import shown
from flowlab.untrusted import parse_yaml

_EXTENDS, _POLICIES = "extends", "policies"
"""Keys of a profile beside the settings."""
_EXAMPLE = "batch.windows=64"


def settings_class(policy: str, folder: Path | None = None) -> type[TrainSettings]:
    """The settings that a policy has, by its name or import path; see :meth:`flowlab.registry.Registry.load`.

    Raises:
        UsageError: There is no such policy.
    """
    offered = [plugin for plugin in POLICIES.offers() if plugin.name == policy.replace("_", "-")]
    if len(offered) == 1 and offered[0].place in OWN:  # without PyTorch, which takes a second
        return OWN[offered[0].place]
    found: type[TrainSettings] = POLICIES.load(policy, folder).settings_class
    return found


def _of_policy(values: Any) -> Any:
    """Settings as they were written, as those of their policy."""
    if not isinstance(values, Mapping):
        return values
    if not isinstance(values.get("policy"), str):
        raise ValueError("policy: must be the name of a policy")
    model = settings_class(values["policy"])
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ValueError(explain(error, model)) from error


AnyTrainSettings = Annotated[SerializeAsAny[TrainSettings], BeforeValidator(_of_policy)]
"""A field of a record that holds the settings of any policy, and reads them back from JSON as what they were."""


def load_settings(
    profile: str, policy: str, overrides: Iterable[str] = (), folder: Path | None = None
) -> TrainSettings:
    """The settings of a policy: its defaults, with what a profile and then single changes say otherwise.

    Args:
        profile: Name of a profile that comes with flowlab (``fast``, ``paper``), or a YAML file. It holds the settings
            that differ from the defaults; ``extends`` names a profile or a file that it begins with, and ``policies``
            has, by a policy's name, what holds for that policy only.
        policy: Name of a policy, or ``module:Class``.
        overrides: Changes that come last, each as ``key.path=value``.
        folder: Where the module of ``module:Class`` may lie beside what is installed; the user must have named it.

    Returns:
        The settings, of the class that the policy has.

    Raises:
        UsageError: The policy or the profile does not exist, or a setting is unknown or wrong; the message names it.
    """
    model = settings_class(policy, folder)
    defaults = {n: f.default for n, f in model.model_fields.items() if not f.is_required()}
    groups = {n: v.model_dump() if isinstance(v, Settings) else v for n, v in defaults.items()}
    values = {**merge(groups, _read_profile(profile, policy, ())), "policy": policy}
    for text in overrides:
        _check_known(text.partition("=")[0].partition(".")[0], model, policy, prefix="")
        override(values, text, model.model_fields, _EXAMPLE)
    for name in values:
        _check_known(name, model, policy, prefix=f"profile {profile}: ")
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise UsageError(f"profile {profile}: {explain(error, model)}") from error


def _check_known(name: str, model: type[TrainSettings], policy: str, prefix: str) -> None:
    """All there are, not only near misses: the setting may well be another policy's."""
    if name and name not in model.model_fields:
        raise UsageError(
            f"{prefix}no setting of {policy} is called '{name}'; there are: {', '.join(sorted(model.model_fields))}"
        )


def _read_profile(profile: str, policy: str, before: tuple[str, ...]) -> dict[str, Any]:
    """What a profile says of a policy, on top of what those say that it extends."""
    origin = f"profile {profile}"
    if profile in before:
        raise UsageError(f"{origin}: extends itself ({' -> '.join((*before, profile))}); take one extends: out")
    try:
        values: Any = parse_yaml(read_named("profile", profile, "train")) or {}
    except ValueError as error:
        raise UsageError(f"{origin}: not valid YAML: {error}") from error
    if not isinstance(values, dict):
        raise UsageError(f"{origin}: must be a mapping of settings, as in 'extends: fast' and 'horizon: 8'")
    parent, by_policy = values.pop(_EXTENDS, None), values.pop(_POLICIES, None) or {}
    if (named := values.pop("policy", policy)) != policy:
        raise UsageError(f"{origin}: is for policy {named}, and {policy} was asked for")
    base = {} if parent is None else _read_profile(_beside(profile, parent), policy, (*before, profile))
    return merge(merge(base, values), _part_of(policy, by_policy, origin))


def _part_of(policy: str, by_policy: Any, origin: str) -> dict[str, Any]:
    """What a profile says of one policy only."""
    if not isinstance(by_policy, dict) or not all(isinstance(part, dict) for part in by_policy.values()):
        raise UsageError(f"{origin}: policies: must hold settings by policy, as in 'fdp: {{motion: {{points: 50}}}}'")
    for name in by_policy:
        if ":" not in str(name) and name != policy and name not in POLICIES.plugins():
            raise UsageError(f"{origin}: policies: {unknown_name('policy', str(name), POLICIES.plugins())}")
    return dict(by_policy.get(policy, {}))


def _beside(profile: str, parent: Any) -> str:
    """The profile that another extends: by its name, or a file whose path is relative to the other's folder."""
    if not isinstance(parent, str):
        raise UsageError(f"profile {profile}: extends: must be the name of a profile or a file; found {shown(parent)}")
    return str(Path(profile).parent / parent) if Path(parent).suffix else parent
