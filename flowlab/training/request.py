"""What is wrong with a request for training, told before PyTorch is loaded, which takes seconds."""

from collections.abc import Sequence
from pathlib import Path

from flowlab.errors import MissingFileError, UsageError
from flowlab.policies.profiles import load_settings
from flowlab.training.loggers import check_loggers
from flowlab.untrusted import is_there


def check_request(
    sources: Sequence[Path], *, policy: str, profile: str, settings: Sequence[str], timed: bool, logs: Sequence[str]
) -> None:
    """Refuse what :func:`flowlab.train` would refuse without having looked into the data.

    Raises:
        UsageError: A name or a setting is wrong, or the length of training is ``timed``, and given as a setting, too.
        MissingFileError: A dataset is not there.
    """
    if timed and (length := [s for s in settings if s.startswith(("run.steps=", "run.epochs=", "run.minutes="))]):
        raise UsageError(f"--minutes and --set {length[0]} both say how long to train; give one of them")
    load_settings(profile, policy, settings, Path.cwd())
    check_loggers(tuple(logs), Path.cwd())
    for source in sources:
        if not str(source).startswith("hub:") and not is_there(source):
            raise MissingFileError(f"{source}: there is no such folder")
