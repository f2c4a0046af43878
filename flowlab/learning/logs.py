"""Other places that metrics can go to: TensorBoard, Weights & Biases."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from flowlab.errors import MissingLibraryError, unknown

LOGS = ("tensorboard", "wandb")


class Log(Protocol):
    """Takes named numbers, step by step."""

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Log the numbers of a step."""
        ...

    def close(self) -> None:
        """Finish what is not yet written."""
        ...


def make_log(name: str, folder: Path, run: str, settings: Mapping[str, Any]) -> Log:
    """The log of that name for a run in ``folder``; a resumed run writes on where it was.

    Raises :class:`MissingLibraryError` where its library is not installed.
    """
    if name not in LOGS:
        raise unknown("log", name, LOGS)
    try:
        return TensorBoardLog(folder) if name == "tensorboard" else WandbLog(folder, run, settings)
    except ImportError as error:
        raise MissingLibraryError(f"--log {name} needs a library: pip install 'flowlab[{name}]' ({error})") from error


class TensorBoardLog:
    """Event files in ``tensorboard/``."""

    def __init__(self, folder: Path) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer: Any = SummaryWriter(str(folder / "tensorboard"))

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """See :class:`Log`."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        """See :class:`Log`."""
        self._writer.close()


class WandbLog:
    """A run of project ``flowlab``, whose id is kept in ``wandb-id.txt``."""

    def __init__(self, folder: Path, run: str, settings: Mapping[str, Any]) -> None:
        import wandb

        kept = folder / "wandb-id.txt"
        known = kept.read_text() if kept.exists() else None
        self._run: Any = wandb.init(
            project="flowlab", name=run, dir=str(folder), config=dict(settings), id=known, resume="allow"
        )
        kept.write_text(self._run.id)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """See :class:`Log`."""
        self._run.log(dict(values), step=step)

    def close(self) -> None:
        """See :class:`Log`."""
        self._run.finish()
