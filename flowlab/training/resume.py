"""Going on with a training run that ended early."""

from collections.abc import Sequence
from pathlib import Path

from flowlab.data.mixture import describe_mixture, without_names
from flowlab.data.replay_buffer import load_buffer
from flowlab.data.source import open_training_source
from flowlab.errors import DataError
from flowlab.policies.checkpoint import build_policy, check_observer
from flowlab.policies.run_config import check_positions, read_run_config
from flowlab.policies.run_folder import read_resume
from flowlab.policies.trained import POLICY, RUN, read_trained
from flowlab.registry import names_from_file
from flowlab.training.distributed import ProcessGroup
from flowlab.training.loggers import check_loggers
from flowlab.training.precision import Precision
from flowlab.training.trainer import Trainer
from flowlab.untrusted import is_there


def resume_run(
    folder: Path,
    data: Sequence[Path] = (),
    *,
    device: str | None = None,
    threads: int | None = None,
    precision: Precision | None = None,
    logs: Sequence[str] | None = None,
) -> Trainer:
    """A run that ended early, as it was after the last step that was saved; it computes on what it did, but for what
    is given. ``data`` is where its datasets are, if they have moved.

    Raises:
        DataError: The dataset is no longer what the run began with, or there is nothing to resume.
    """
    trained, began = read_trained(folder), read_run_config(folder)
    given = {
        "dataset": data[0].resolve() if data else None,
        "more_datasets": tuple(path.resolve() for path in data[1:]) if data else None,
        "device": device,
        "threads": threads,
        "precision": precision,
        "logs": None if logs is None else (*logs,),
    }
    config = began.model_copy(update={k: v for k, v in given.items() if v is not None})
    with names_from_file(but=logs or ()):
        check_loggers(config.logs)
    processes = ProcessGroup(config.device, config.threads, config.precision)
    for place in config.datasets:
        if not is_there(place):
            name = "dataset" if place == config.dataset else "more_datasets"
            raise DataError(
                f"{folder}: its dataset is no longer at {place}; restore it, or change '{name}' in {folder / RUN}"
            )
    source = open_training_source(*config.datasets, known=True)
    check_observer(trained, folder, source)
    if source.fingerprint != trained.fingerprint:
        raise DataError(
            f"{folder}: began with content {trained.fingerprint} of {config.dataset}, now {source.fingerprint}; "
            "restore the dataset, or start a new run"
        )
    step, groups = read_resume(folder)
    buffer = load_buffer(source, folder, trained.policy.settings.needs.pictures)
    check_positions(folder, config, len(buffer.episodes))
    found = describe_mixture(source.parts, buffer, config.train, config.held_out, config.weights)
    if without_names(found) != without_names(trained.mixture):
        raise DataError(
            f"{folder}: its {RUN} and {POLICY} tell of other datasets or weights; restore both from one run"
        )
    policy = build_policy(
        trained.policy, groups.get("policy", {}), f"{folder}: its resume file does not fit its {POLICY}"
    )
    trainer = Trainer(folder, config, policy, buffer, processes)
    trainer.load_state(step, groups)
    return trainer
