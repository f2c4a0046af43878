"""Other places that metrics can go to: TensorBoard, Weights & Biases, or what a package adds."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flowlab.errors import FlowlabError, MissingLibraryError, first_line
from flowlab.files import write_atomically
from flowlab.registry import LOGGERS


class MetricsLogger(ABC):
    """Takes named numbers, step by step. Offered under an entry point of group ``flowlab.loggers``."""

    @abstractmethod
    def __init__(self, folder: Path, run: str, settings: Mapping[str, Any]) -> None:
        """Begin, or go on where a run that is resumed was.

        Args:
            folder: Of the run; what is written belongs into a folder of its own in it.
            run: Name of the run.
            settings: Of its training, as JSON values.

        Raises:
            ImportError: A library is missing.
            LoggerRefusedError: The service behind it cannot be reached, or does not know the user.
        """

    @abstractmethod
    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Log the numbers of a step; the next must not be an earlier one."""

    @abstractmethod
    def close(self) -> None:
        """Finish what is not yet written."""


class LoggerRefusedError(FlowlabError):
    """A log whose service does not take it."""


def check_loggers(names: tuple[str, ...], folder: Path | None = None) -> None:
    """Look whether there are loggers of these names, before anything takes long.

    Args:
        names: Installed names, or import paths.
        folder: See :meth:`flowlab.registry.Registry.load`.

    Raises:
        UsageError: One does not exist; the message names those that do.
    """
    for name in names:
        LOGGERS.load(name, folder)


def make_logger(name: str, folder: Path, run: str, settings: Mapping[str, Any]) -> MetricsLogger:
    """The log of that name for a run in ``folder``; a resumed run writes on where it was.

    Raises:
        UsageError: There is none of that name.
        MissingLibraryError: Its library is not installed.
        LoggerRefusedError: Its service cannot be reached or does not know the user.
    """
    logger: type[MetricsLogger] = LOGGERS.load(name)
    try:
        return logger(folder, run, settings)
    except ImportError as error:
        ours = LOGGERS.plugins().get(name)
        hint = f": pip install 'flowlab[{name}]'" if ours is not None and ours.package.startswith("flowlab ") else ""
        raise MissingLibraryError(f"--log {name} needs a library{hint} ({first_line(error)})") from error


class TensorBoardLogger(MetricsLogger):
    """Event files in ``tensorboard/``. A resumed run adds one, which replaces what the others say from its first
    step on."""

    def __init__(self, folder: Path, run: str, settings: Mapping[str, Any]) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._open: Any = SummaryWriter
        self._folder = folder / "tensorboard"
        self._writer: Any = None

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """See :class:`MetricsLogger`."""
        if self._writer is None:
            self._writer = self._open(str(self._folder), purge_step=step)
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)
        self._writer.flush()  # else a killed run would lose two minutes, more than it may repeat when resumed

    def close(self) -> None:
        """See :class:`MetricsLogger`."""
        if self._writer is not None:
            self._writer.close()


class WandbLogger(MetricsLogger):
    """A run of project ``flowlab``, whose id is remembered in ``wandb-id.txt``. What a resumed run says again of steps
    that the service has already is passed over there."""

    def __init__(self, folder: Path, run: str, settings: Mapping[str, Any]) -> None:
        import wandb

        id_file = folder / "wandb-id.txt"
        known = id_file.read_text() if id_file.exists() else None
        try:
            self._run: Any = wandb.init(
                project="flowlab", name=run, dir=str(folder), config=dict(settings), id=known, resume="allow"
            )
        except wandb.Error as error:
            raise LoggerRefusedError(
                f"--log wandb: {first_line(error).rstrip('.')}; type 'wandb login', or set WANDB_MODE=offline and "
                "'wandb sync' later"
            ) from error
        write_atomically(id_file, self._run.id)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """See :class:`MetricsLogger`."""
        self._run.log(dict(values), step=step)

    def close(self) -> None:
        """See :class:`MetricsLogger`."""
        self._run.finish()
