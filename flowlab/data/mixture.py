"""Several datasets trained on together, each with a share of the windows that its weight decides."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import Field

from flowlab.arguments import check_numbers
from flowlab.config import Settings, later
from flowlab.data.replay_buffer import ReplayBuffer
from flowlab.data.source import SourcePart
from flowlab.data.training_settings import TrainSettings
from flowlab.data.window_sampler import MixedSampler, WindowSampler, index_windows, shares
from flowlab.errors import DataError, UsageError
from flowlab.text import counted

Weight = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0, lt=1 << 62)]
"""Of what a file says that there is."""


class MixedDataset(Settings):
    """What a policy has seen of one of several datasets."""

    fingerprint: str
    """Of its content."""
    weight: Weight
    """Relative to those of the others; what part of all windows it means, :func:`mixture_shares` tells."""
    demonstrations: Count
    """So many of it were trained on."""
    held_out: Count
    hub: Annotated[str, later("")] = ""
    """Where on the Hub it was pulled from, ``user/name@commit``; empty where it was not."""


@dataclass(frozen=True, slots=True)
class DatasetShare:
    """The same for people: with the name of the dataset, and its share of all windows."""

    name: str
    share: float
    about: MixedDataset

    def __str__(self) -> str:
        held = f" ({self.about.held_out} held out)" if self.about.held_out else ""
        taught = counted(self.about.demonstrations, "demonstration")
        return f"{self.name}: {self.share:.4g} of the windows, from {taught}{held}"


def check_weights(value: Any, datasets: int) -> tuple[float, ...]:
    """Weights as they were given, one for each dataset; empty where there are none.

    Raises:
        UsageError: They are no numbers above 0, or not as many as there are datasets.
    """
    if value is None:
        return ()
    weights = check_numbers(value, "weights", "one number for each dataset, as in 0.7,0.3")
    for k, weight in enumerate(weights):
        if not 0 < weight < math.inf:
            advice = "; leave out a dataset that is not to be trained on" if weight == 0 else ""
            raise UsageError(f"weights: number {k + 1} is {weight:g}, expected a finite number above 0{advice}")
    if datasets == 1:
        raise UsageError("weights: there is one dataset, and weights are its share beside others; leave them out")
    if len(weights) != datasets:
        raise UsageError(
            f"weights: there are {len(weights)} for {datasets} datasets; give one for each, in the order of the "
            f"datasets, as in {','.join(f'{1 / datasets:.2g}' for _ in range(datasets))}"
        )
    return weights


def describe_mixture(
    parts: Sequence[SourcePart],
    buffer: ReplayBuffer,
    train: Sequence[int],
    held_out: Sequence[int],
    weights: Sequence[float],
) -> tuple[MixedDataset, ...]:
    """What is trained on of each dataset; empty where there are no weights.

    Raises:
        DataError: Of one that has a weight nothing is left to train on.
    """
    if not weights:
        return ()
    taught, held = ([buffer.episodes[k].origin for k in demos] for demos in (train, held_out))
    for k, part in enumerate(parts):
        if k not in taught:
            there = sum(e.origin == k for e in buffer.episodes)
            raise DataError(
                f"{part.path}: its weight is {weights[k]:g}, and none of its demonstrations ({there}) is trained on "
                f"({held.count(k)} held out); leave it out, or choose others by data.held_out, data.demonstrations or "
                "--overfit"
            )
    return tuple(
        MixedDataset(
            fingerprint=part.fingerprint,
            weight=weights[k],
            demonstrations=taught.count(k),
            held_out=held.count(k),
            hub=part.hub,
        )
        for k, part in enumerate(parts)
    )


def without_names(mixture: Sequence[MixedDataset]) -> list[MixedDataset]:
    """What counts of a mixture: the same content may be pulled from elsewhere, or not from the Hub."""
    return [one.model_copy(update={"hub": ""}) for one in mixture]


def check_drawn(parts: Sequence[SourcePart], weights: Sequence[float], settings: TrainSettings, steps: int) -> None:
    """Refuse weights of which one is so small that nothing is drawn for it. Raises :class:`UsageError`."""
    runs = steps * (settings.batch.windows // settings.batch.segment)
    for part, share in zip(parts, shares(weights).tolist(), strict=True) if weights else ():
        if share * runs < 1:
            raise UsageError(
                f"weights: {part.path} has {share:.3g} of the windows, less than one of the {runs:,} runs of "
                f"{settings.batch.segment} windows in {steps:,} steps; give it more, train longer, or leave it out"
            )


def dataset_shares(mixture: Sequence[MixedDataset], datasets: str) -> list[DatasetShare]:
    """The shares that the weights of a mixture mean.

    Args:
        mixture: Of a policy.
        datasets: The paths of its datasets, as the policy tells them: with commas between.

    Returns:
        One for each dataset; all shares add up to 1.
    """
    if not mixture:
        return []
    places = datasets.split(", ")
    if len(places) != len(mixture):  # one has a comma in its name
        places = [f"dataset {k + 1}" for k in range(len(mixture))]
    names = [f"hub:{one.hub}" if one.hub else place for one, place in zip(mixture, places, strict=True)]
    found = shares([one.weight for one in mixture]).tolist()
    return [DatasetShare(*one) for one in zip(names, found, mixture, strict=True)]


def make_sampler(
    buffer: ReplayBuffer, train: Sequence[int], weights: Sequence[float], settings: TrainSettings
) -> WindowSampler | MixedSampler:
    """What draws the windows of some demonstrations: all of them alike, or each dataset as its weight says."""
    batch, seed = settings.batch, settings.run.seed
    if not weights:
        return WindowSampler(index_windows(buffer, train, settings.n_action_steps), batch.windows, batch.segment, seed)
    of_each = [[k for k in train if buffer.episodes[k].origin == d] for d in range(len(weights))]
    windows = [index_windows(buffer, mine, settings.n_action_steps) for mine in of_each]
    return MixedSampler(windows, weights, batch.windows, batch.segment, seed)
