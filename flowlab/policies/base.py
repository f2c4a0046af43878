"""The family of policies: what every policy is built from, is asked, and answers."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from flowlab.data.batches import Batch, ObservationBatch
from flowlab.data.needs import Needs
from flowlab.data.replay_buffer import ReplayBuffer
from flowlab.data.training_settings import TrainSettings
from flowlab.errors import DataError
from flowlab.nets.diffusion import NoiseSampler
from flowlab.policies.spec import PolicySpec as PolicySpec
from flowlab.registry import POLICIES

Generators = torch.Generator | Sequence[torch.Generator] | None
"""Where the noise of plans comes from: a CPU generator for all windows, or one for each; None is torch's own."""


@dataclass(frozen=True, slots=True)
class Losses:
    """Of one training step."""

    total: Tensor
    """What is minimized: a number."""
    parts: Mapping[str, Tensor]
    """What it is made of, each a number, by name: ``action``, ``motion``."""


@dataclass(frozen=True, slots=True)
class ActionPlan:
    """What a policy decides on, in the dataset's units."""

    action: Float[Tensor, "W T A"]
    """The first to execute is that of index ``n_obs_steps - 1``."""
    flow: Float[Tensor, "W T M 3"] | None = None
    """Predicted displacement of every query point during each action [m]; None where none is predicted."""
    object_pose: Float[Tensor, "W T 9"] | None = None
    """Predicted position [m] and 6D rotation of the object; None where none is predicted."""


class PolicyNetwork(nn.Module, ABC):
    """A policy: settings of its own, a network with a loss, and plans.

    A subclass is offered under an entry point of group ``flowlab.policies``, or named by its import path. It says by
    its settings which arrays it needs (:attr:`needs`), and gets these in every batch, and nothing else.
    """

    title: ClassVar[str]
    """What people call it."""
    settings_class: ClassVar[type[TrainSettings]]
    """Its settings. Every one of them has a default; ``needs`` among them says which arrays it needs."""

    def __init__(self, spec: PolicySpec) -> None:
        super().__init__()
        self.spec = spec

    @property
    def needs(self) -> Needs:
        """The arrays that it is trained on and must be shown."""
        return self.spec.settings.needs

    @classmethod
    def check_dataset(cls, path: Path, buffer: ReplayBuffer, settings: TrainSettings) -> None:
        """Refuse a dataset that cannot be trained on.

        Args:
            path: Of the dataset, for the message.
            buffer: Its demonstrations, with the pictures that the settings need, if it has them.
            settings: What is to be trained.

        Raises:
            DataError: It lacks something; the message says what, and what to do.
        """
        if missing := settings.needs.missing_from(buffer):
            raise DataError(
                f"{path}: has no {missing}, which {settings.policy} is trained on; make the dataset with them, or "
                "train --policy dp3, which needs point clouds only"
            )

    def forward(self, batch: Batch, noise: NoiseSampler, windows: int) -> Losses:
        """See :meth:`compute_loss`, which this calls, so that several processes can share a batch."""
        return self.compute_loss(batch, noise, windows)

    @abstractmethod
    def compute_loss(self, batch: Batch, noise: NoiseSampler, windows: int) -> Losses:
        """The losses of a batch.

        Args:
            batch: Windows of demonstrations, in the dataset's units; its weights have a mean of 1 over all windows.
            noise: The random numbers of this step; draw from nothing else, so that a resumed run goes on as it would
                have.
            windows: How many windows all processes have together; ``batch`` may be one's part of them.
        """

    @abstractmethod
    def plan(self, context: ObservationBatch, generators: Generators = None) -> ActionPlan:
        """Decide on actions for every window of a context, without gradients.

        Args:
            context: What is seen, with what the policy needs, on the device of its weights.
            generators: Where noise comes from; the plan is a function of their states.
        """

    def parameter_groups(self) -> dict[str, list[nn.Module]]:
        """Modules that have an optimizer of their own, by name: together all that has weights, each once."""
        return {"policy": [self]}


def make_policy(spec: PolicySpec) -> PolicyNetwork:
    """The network that a spec describes, with random weights.

    Raises:
        UsageError: There is no such policy here.
    """
    policy: PolicyNetwork = POLICIES.load(spec.settings.policy)(spec)
    return policy
