"""Other places that metrics can go to: TensorBoard, Weights & Biases."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from flowlab.errors import FlowlabError, MissingLibraryError, unknown_name
from flowlab.files import write_atomically

LOGS = ("tensorboard", "wandb")


class MetricsLogger(Protocol):
    """Takes named numbers, step by step."""

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Log the numbers of a step; the next must not be an earlier one."""
        ...

    def close(self) -> None:
        """Finish what is not yet written."""
        ...


class LoggerRefusedError(FlowlabError):
    """A log whose service does not take it."""


def make_logger(name: str, folder: Path, run: str, settings: Mapping[str, Any]) -> MetricsLogger:
    """The log of that name for a run in ``folder``; a resumed run writes on where it was.

    Raises :class:`MissingLibraryError` where its library is not installed, :class:`LoggerRefusedError` where its service
    cannot be reached or does not know the user.
    """
    if name not in LOGS:
        raise unknown_name("log", name, LOGS)
    try:
        return TensorBoardLogger(folder) if name == "tensorboard" else WandbLogger(folder, run, settings)
    except ImportError as error:
        raise MissingLibraryError(f"--log {name} needs a library: pip install 'flowlab[{name}]' ({error})") from error


class TensorBoardLogger:
    """Event files in ``tensorboard/``. A resumed run adds one, which replaces what the others say from its first
    step on."""

    def __init__(self, folder: Path) -> None:
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


class WandbLogger:
    """A run of project ``flowlab``, whose id is kept in ``wandb-id.txt``. What a resumed run says again of steps
    that the service has already is passed over there."""

    def __init__(self, folder: Path, run: str, settings: Mapping[str, Any]) -> None:
        import wandb

        kept = folder / "wandb-id.txt"
        known = kept.read_text() if kept.exists() else None
        try:
            self._run: Any = wandb.init(
                project="flowlab", name=run, dir=str(folder), config=dict(settings), id=known, resume="allow"
            )
        except wandb.Error as error:
            reason = str(error).strip().partition("\n")[0].rstrip(".")
            raise LoggerRefusedError(
                f"--log wandb: {reason}; type 'wandb login', or set WANDB_MODE=offline and 'wandb sync' later"
            ) from error
        write_atomically(kept, self._run.id)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """See :class:`MetricsLogger`."""
        self._run.log(dict(values), step=step)

    def close(self) -> None:
        """See :class:`MetricsLogger`."""
        self._run.finish()
