"""How a training run goes (``run.json``), read without PyTorch."""

from pathlib import Path
from typing import Annotated

from pydantic import model_validator

from flowlab.config import Settings, later
from flowlab.data.mixture import Count, Weight
from flowlab.errors import DataError
from flowlab.policies.trained import FREE, POLICY, RESUME, RUN, checkpoint_files, validated


class RunConfig(Settings):
    """``run.json``: how a run goes; written when it begins, it stays the same until it ends."""

    dataset: Path
    more_datasets: tuple[Path, ...] = ()
    """Where there are several, the others."""
    steps: Count
    train: tuple[Count, ...]
    """Episodes trained on, by their position in the :class:`~flowlab.data.replay_buffer.ReplayBuffer`."""
    held_out: tuple[Count, ...]
    """Episodes to validate on."""
    inferred: tuple[Count, ...] = ()
    """Those of all whose actions were inferred."""
    threads: int
    device: str
    precision: str
    logs: tuple[str, ...]
    began_from: str | None
    """Checkpoint that the first weights are from."""
    overfit: int | None = None
    """How many demonstrations are trained on and validated on, where they are the same."""
    weights: Annotated[tuple[Weight, ...], later(())] = ()
    """Of the datasets, in their order; empty where all windows are drawn alike."""

    @model_validator(mode="after")
    def _one_for_each(self) -> "RunConfig":
        if self.weights and len(self.weights) != len(self.datasets):
            raise ValueError(f"weights: there are {len(self.weights)} for {len(self.datasets)} datasets")
        return self

    @property
    def datasets(self) -> tuple[Path, ...]:
        """All that it is trained on."""
        return self.dataset, *self.more_datasets


def read_run_config(folder: Path) -> RunConfig:
    """``run.json`` of a run."""
    path = folder / RUN
    if not path.exists():
        raise DataError(f"{folder}: no run to resume (it has no {RUN}); start one with 'flowlab train DATASET --out'")
    return validated(RunConfig, path, FREE)


def check_positions(folder: Path, run: RunConfig, episodes: int) -> None:
    """Refuse a run that tells of more demonstrations than there are. Raises :class:`DataError`."""
    if (last := max((*run.train, *run.held_out), default=-1)) >= episodes:
        raise DataError(
            f"{folder / RUN}: tells of demonstration {last}, counted from 0, and there are {episodes}; restore it"
        )


def has_begun(folder: Path) -> bool:
    """Whether a folder holds a run that can go on, or has come to its end; not what a kill left of a beginning."""
    kept = (folder / RESUME).exists() or any(checkpoint_files(folder))
    return kept and (folder / POLICY).exists()
