"""The training loop."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from flowlab.data.batch_builder import BatchBuilder
from flowlab.data.batches import Batch
from flowlab.data.mixture import make_sampler
from flowlab.data.replay_buffer import ReplayBuffer
from flowlab.data.window_sampler import index_windows
from flowlab.errors import DataError, FlowlabError
from flowlab.nets.diffusion import NoiseSampler
from flowlab.policies.base import PolicyNetwork
from flowlab.policies.checkpoint import save_weights
from flowlab.policies.run_config import RunConfig
from flowlab.policies.run_folder import Groups, lines_behind, save_resume, start_folder
from flowlab.policies.trained import TrainedPolicy, writing_run
from flowlab.training.distributed import ProcessGroup
from flowlab.training.ema import EMA
from flowlab.training.metrics import MetricsFile, RunningMeans
from flowlab.training.optimizer import Optimizers
from flowlab.training.validation import validate

_STEPS_PER_LINE = 50
"""Training steps behind one line of metrics."""
_SECONDS_BETWEEN_SAVES = 300.0
"""At least so often, what resuming needs is saved."""


@dataclass(frozen=True, slots=True)
class TrainingProgress:
    """How far a run is."""

    step: int
    steps: int
    samples_per_s: float
    loss: float
    validation: dict[str, float] | None
    """The newest errors on held-out demonstrations."""


class DivergedError(FlowlabError):
    """The loss is no longer a number."""


class Trainer:
    """Trains one policy on the demonstrations of one dataset, in one or several processes."""

    def __init__(
        self, folder: Path, run: RunConfig, policy: PolicyNetwork, buffer: ReplayBuffer, processes: ProcessGroup
    ) -> None:
        settings = policy.spec.settings
        self.folder, self.run, self.policy, self.processes = folder, run, policy.to(processes.device), processes
        self.settings = settings
        self.average = EMA(policy, settings.optimizer)
        self.optimizers = Optimizers(policy, settings.optimizer, run.steps)
        self._network = processes.wrap(policy)
        self._builder = BatchBuilder(buffer, policy.spec.channels, settings, policy.spec.tasks)
        self._sampler = make_sampler(buffer, list(run.train), run.weights, settings)
        self._held_out = index_windows(buffer, list(run.held_out), settings.n_action_steps) if run.held_out else None
        self._means = RunningMeans()
        self.step = 0
        self.lines = 0
        """Of metrics, so far."""

    def train_step(self) -> dict[str, float]:
        """One step: what :meth:`gather` gives and :meth:`learn` makes of it."""
        return self.learn(*self.gather())

    def gather(self) -> tuple[Batch, NoiseSampler]:
        """This process's part of the step's windows, on its device, and where the step's noise comes from."""
        seed = np.random.SeedSequence([self.settings.run.seed, self.step])
        batch = self._builder.build(self._sampler.windows(self.step), np.random.default_rng(seed))
        part = self.processes.part(len(batch.observed))
        generator = torch.Generator().manual_seed(int(seed.generate_state(1, np.uint64)[0] >> np.uint64(1)))
        return batch.part(part).to(self.processes.device), NoiseSampler(generator, self.processes.device, part)

    def learn(self, batch: Batch, noise: NoiseSampler) -> dict[str, float]:
        """Change the weights by this process's part of a batch: the losses, averaged over all processes.

        Raises :class:`DivergedError`, before the weights change, where they are not finite.
        """
        with self.processes.autocast():
            losses = self._network(batch, noise, len(batch.observed) * self.processes.count)
        values = {"loss": losses.total} | {f"{name}_loss": loss for name, loss in losses.parts.items()}
        numbers = self.processes.mean({k: v.detach() for k, v in values.items()})
        if not all(np.isfinite(v) for v in numbers.values()):
            raise self._diverged(f"the loss is {numbers['loss']}")
        losses.total.backward()
        self.optimizers.update(self.step)
        self.average.update(self.policy, self.step)
        self.step += 1
        return numbers

    def fit(
        self,
        metrics: MetricsFile | None,
        report: Callable[[TrainingProgress], None],
        should_stop: Callable[[], bool] = lambda: False,
    ) -> bool:
        """Train to the end of the run; False where ``should_stop`` ended it earlier, to be resumed."""
        validations = _evenly(self.run.steps, self.settings.run.validations) if self._held_out is not None else set()
        checkpoints = _evenly(self.run.steps, self.settings.run.checkpoints)
        last = None
        began, last_save, done_before = time.monotonic(), time.monotonic(), self.step
        while self.step < self.run.steps:
            self._means.add(self.train_step())
            at_line = self.step % _STEPS_PER_LINE == 0 or self.step == self.run.steps
            if at_line:
                rate = (self.step - done_before) * self.settings.batch.windows / (time.monotonic() - began)
                averages = self._means.pop_means()
                learning_rate = self.optimizers.learning_rate(self.step - 1)
                self._log(metrics, "train", averages | {"lr": learning_rate, "samples_per_s": rate})
            if self.step in validations:
                last = self.validate()
                self._log(metrics, "validation", last)
            if at_line:
                report(TrainingProgress(self.step, self.run.steps, rate, averages["loss"], last))
            stop = self.processes.any(should_stop())
            if self.step in checkpoints:
                self.save(self.step)
            if stop or self.processes.any(at_line and time.monotonic() - last_save > _SECONDS_BETWEEN_SAVES):
                self.save()
                last_save = time.monotonic()
            if stop and self.step < self.run.steps:
                return False
        return True

    def validate(self) -> dict[str, float]:
        """Errors of the averaged weights on held-out demonstrations."""
        assert self._held_out is not None
        return validate(self.average.policy, self._builder, self._held_out, self.processes.device)

    def _log(self, metrics: MetricsFile | None, kind: str, values: dict[str, float]) -> None:
        self.lines += 1
        if metrics is not None:
            with writing_run(self.folder):
                metrics.write(kind, self.step, values)

    def save(self, checkpoint: int | None = None) -> None:
        """Save what resuming needs, and the weights as a checkpoint.

        Raises :class:`DivergedError` where weights are not finite, before anything is written.
        """
        self._check_finite()
        if not self.processes.is_first:
            return
        if checkpoint is not None:
            save_weights(self.folder, self.average.policy, checkpoint)
        save_resume(self.folder, self.step, self.state())

    def begin(self, trained: TrainedPolicy) -> None:
        """Make the folder of a new run, from which it can be resumed. Raises :class:`UsageError` where there is one."""
        self._check_finite()
        if self.processes.is_first:
            start_folder(self.folder, trained, self.run, self.state())
        self.processes.wait()

    def state(self) -> Groups:
        """Everything that goes on changing, for :meth:`load_state`."""
        return {
            "policy": self.policy.state_dict(),
            "average": self.average.policy.state_dict(),
            "optimizer": self.optimizers.state(),
            "metrics": {"lines": torch.tensor(self.lines, dtype=torch.float64)},
            "means": {k: torch.tensor(v, dtype=torch.float64) for k, v in self._means.state().items()},
        }

    def load_state(self, step: int, groups: Groups) -> None:
        """Go on from what :func:`~flowlab.policies.run_folder.read_resume` gives."""
        try:
            self.policy.load_state_dict(groups["policy"])
            self.average.policy.load_state_dict(groups["average"])
            if step:
                self.optimizers.load_state(groups["optimizer"])
        except (KeyError, RuntimeError) as error:
            raise DataError(f"{self.folder}: its resume file does not fit its policy.json; start anew") from error
        self.lines = lines_behind(groups)
        self._means.load_state({name: float(value) for name, value in groups.get("means", {}).items()})
        self.step = step

    def _check_finite(self) -> None:
        if not all(bool(p.isfinite().all()) for p in self.policy.parameters()):
            raise self._diverged("a weight is no longer finite")

    def _diverged(self, what: str) -> DivergedError:
        return DivergedError(
            f"{self.folder}: {what} at step {self.step}; the last checkpoint is whole. Lower optimizer.learning_rate "
            "and start anew, or look at the data with 'flowlab validate'"
        )


def _evenly(steps: int, times: int) -> set[int]:
    """The steps after which something happens so many times, the last time at the end."""
    return {round(steps * k / times) for k in range(1, times + 1)}
