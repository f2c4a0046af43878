"""What is known of an evaluated policy: how it was trained, and how every episode went."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from pydantic import ConfigDict, Field, NonNegativeInt, model_validator

from flowlab.config import Settings, later
from flowlab.evaluation.trials import Trial
from flowlab.text import shown


class RolloutFlowError(Settings):
    """Predicted flow against where the query points really went while the actions were executed.

    Of an episode, over its plans; a point is where it truly was when the plan was made. ``zero`` predicts that nothing
    moves. A point moves if it gets farther than :data:`~flowlab.geometry.moving.MOVING_IN_PLAN_M` while the executed
    part of a plan lasts.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    pairs: int
    """Moving points times steps."""
    ade_mm: float
    """Mean distance over these."""
    zero_ade_mm: float
    ends: int
    """Moving points, each counted once a plan."""
    fde_mm: float
    """Mean distance at the last executed step."""
    zero_fde_mm: float
    apd: float
    """TAPVid-3D's share within its limits, of the moving points; all count as visible."""
    zero_apd: float
    average_jaccard: float
    """TAPVid-3D's, likewise."""
    zero_average_jaccard: float
    still_pairs: int
    """Points that do not move, times steps."""
    still_mm: float
    """Mean distance over these."""


class EpisodeResult(Settings):
    """How one trial went: a line of ``episodes.jsonl``."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    task: str
    seed: int = Field(ge=-1)
    """Of the evaluation; -1 tries the scenes that demonstrations may have."""
    episode: NonNegativeInt
    scene_seed: NonNegativeInt
    success: bool
    """Whether the task counted as solved after any step."""
    success_dp3: bool
    """Whether it did after one of the last two steps of some plan: all that DP3's runner looks at."""
    steps: NonNegativeInt
    """Until it first did, or all."""
    note: str = ""
    """Why the episode was aborted, if it was; it counts as failed."""
    flow: RolloutFlowError | None = None
    """None for policies that predict none, and where nothing moved."""

    @property
    def trial(self) -> Trial:
        """What was tried."""
        return Trial(self.task, self.seed, self.episode)

    @property
    def ending(self) -> str:
        """In words, when the task was solved, or that it was not."""
        return f"solved at step {self.steps}" if self.success else f"not solved in {self.steps} steps"


class CheckpointEvaluation(Settings):
    """The episodes of one checkpoint."""

    step: int
    """Training steps its weights have seen."""
    n_action_steps: int
    """Steps of every plan that were executed."""
    cpu_s: float | None = None
    """CPU time of its episodes where one process tried them [s]; if it was ended early, that of those it tried after
    it went on, by their share of all."""
    outcomes: tuple[EpisodeResult, ...]


class TrainingRecord(Settings):
    """How a policy came about."""

    policy: str
    """Name of its kind: fdp, dp3, mba, or one that was added."""
    settings: Mapping[str, Any]
    """All settings of the run."""
    steps: int
    cpu_s: float
    """CPU time of training, validation included [s]."""
    weights: int
    """Numbers that were learned."""
    device: str
    """cpu or cuda."""
    precision: str
    demonstrations: int
    held_out: Mapping[str, float]
    """Errors on held-out demonstrations at the end, as in ``metrics.jsonl``."""
    versions: Mapping[str, str]
    processor: str

    @model_validator(mode="after")
    def _says_its_action_steps(self) -> "TrainingRecord":
        if type(steps := self.settings.get("n_action_steps")) is not int:
            raise ValueError(f"settings: n_action_steps is {shown(steps)}, expected a number of steps")
        return self

    @property
    def n_action_steps(self) -> int:
        """Steps of every plan that the policy was trained to execute."""
        steps: int = self.settings["n_action_steps"]
        return steps


class ExecutionChoice(Settings):
    """How many layouts a policy solves with so many steps of every plan executed, none of which is reported."""

    solved: Mapping[int, int]
    """By steps executed."""
    of: int

    @property
    def best(self) -> int:
        """The number that solves most; of equal ones the largest, which takes the fewest plans."""
        return max(self.solved, key=lambda steps: (self.solved[steps], steps))

    def __str__(self) -> str:
        each = ", ".join(f"{n} by {steps}" for steps, n in sorted(self.solved.items(), reverse=True))
        return f"executes {self.best} steps of every plan: of {self.of} other layouts solved are {each}"


class PolicyResult(Settings):
    """A policy, its training and its evaluations."""

    name: str
    """Unique within a report, such as ``push-fdp-m50``."""
    label: str
    """What the policy is called in tables, the same for every task: ``fdp``, ``dp3``, ``fdp-m50``."""
    tasks: tuple[str, ...]
    training: TrainingRecord
    evaluations: tuple[CheckpointEvaluation, ...]
    """In order of steps; the last is of the newest weights and is the one that counts."""
    execution: Annotated[ExecutionChoice | None, later(None)] = None
    """How it was chosen how many steps of a plan are executed; None where nothing was chosen."""

    @property
    def final(self) -> Sequence[EpisodeResult]:
        """The episodes of the newest weights, executing what the policy was trained to execute."""
        newest = [e for e in self.evaluations if e.step == self.evaluations[-1].step]
        usual = [e for e in newest if e.n_action_steps == self.training.n_action_steps]
        return (usual or newest)[-1].outcomes

    @property
    def success_rate(self) -> float:
        """The share of these that solved their task, from 0 to 1."""
        return sum(o.success for o in self.final) / len(self.final)
