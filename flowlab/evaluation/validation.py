"""Everything that would spoil the use of a training run, found before it does."""

from collections.abc import Callable, Iterator
from pathlib import Path

from flowlab.checksums import CHECKSUM
from flowlab.data.source import open_training_source
from flowlab.errors import DataError
from flowlab.evaluation.checkpoints import CHOOSING, FOLDER
from flowlab.evaluation.episode_log import EPISODES, read_results
from flowlab.policies.checkpoint import build_policy, load_policy
from flowlab.policies.run_config import has_begun, read_run_config
from flowlab.policies.run_folder import lines_behind, read_resume
from flowlab.policies.tensor_files import check_finite
from flowlab.policies.trained import (
    POLICY,
    RESUME,
    RUN,
    checkpoint_files,
    checkpoint_name,
    read_trained,
    warn_of_lost_checkpoints,
)
from flowlab.storage.validation import Finding, finding_of
from flowlab.untrusted import is_there, read_json
from flowlab.viz.training_metrics import METRICS, metrics_lines


def has_checksums(run: Path) -> bool:
    """Whether a run's files tell their checksums; those of earlier versions do not, so that damage may not be found."""
    return CHECKSUM in read_json(run / POLICY)


def validate_run(path: Path) -> Iterator[Finding]:
    """Every finding about a training run; none if it is sound, be it finished or not.

    The policy must be installed here, as for its use.
    """
    warn_of_lost_checkpoints(path)
    checks: list[Callable[[], None]] = [lambda: _check_begun(path), lambda: _check_plan(path)]
    checks += [lambda w=w: _check_checkpoint(w) for w in checkpoint_files(path)]  # type: ignore[misc]
    checks += [lambda: _check_resume(path), lambda: _check_metrics(path)]
    tried = [e for folder in (FOLDER, CHOOSING) for e in sorted((path / folder).glob(f"*/{EPISODES}"))]
    checks += [lambda e=e: _check_episodes(e) for e in tried]  # type: ignore[misc]
    seen = set()
    for check in checks:
        try:
            check()
        except DataError as error:
            finding = finding_of(path, error)
            if finding not in seen:  # what is wrong with policy.json, all that is read with it meets
                seen.add(finding)
                yield finding


def _check_begun(path: Path) -> None:
    if not has_begun(path):
        raise DataError(f"{path}: a run that has not begun yet; give the command that began it again")
    read_trained(path)


def _check_plan(path: Path) -> None:
    """The plan, and the dataset that it is about; both stay behind where a policy is pushed to the Hub."""
    trained = read_trained(path)
    if trained.hub and not (path / RUN).exists():
        return
    planned = read_run_config(path)
    for place in planned.datasets:
        if not is_there(place):
            raise DataError(f"{path / RUN}: dataset: {place} is not there; restore it, or change where it is")
    if (found := open_training_source(*planned.datasets, known=True).fingerprint) != trained.fingerprint:
        raise DataError(
            f"{planned.dataset}: its content is {found}, and {path} was trained on {trained.fingerprint}; restore it"
        )


def _check_checkpoint(weights: Path) -> None:
    """Digest, shapes and numbers of a checkpoint, and its name."""
    loaded = load_policy(weights)
    if weights.name != checkpoint_name(loaded.step):
        raise DataError(f"{weights}: holds the weights after {loaded.step} steps; call it after them")
    check_finite(weights, loaded.policy.state_dict())


def _check_resume(path: Path) -> None:
    if not (path / RESUME).exists():  # whoever is done with training may delete it
        return
    step, groups = read_resume(path)
    for name in ("policy", "average"):
        build_policy(read_trained(path).policy, groups.get(name, {}), f"{path / RESUME}: does not fit {path / POLICY}")
    for tensors in groups.values():
        check_finite(path / RESUME, tensors)
    if step > read_run_config(path).steps:
        raise DataError(f"{path / RESUME}: is of step {step}, beyond the last; restore it")


def _check_metrics(path: Path) -> None:
    steps = [line.step for line in metrics_lines(path / METRICS)]
    step, groups = read_resume(path) if (path / RESUME).exists() else (0, {})
    if (found := sum(s <= step for s in steps)) < (known := lines_behind(groups)):
        raise DataError(f"{path / METRICS}: has {found} of {known} lines up to step {step}; restore it")
    if steps != sorted(steps):
        raise DataError(f"{path / METRICS}: its steps do not rise; restore it")


def _check_episodes(path: Path) -> None:
    read_results(path)
