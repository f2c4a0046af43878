"""Trained policies drive MetaWorld's hand through a camera that errs, as they would drive a robot."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rehearsal_films import FIRST_TRIAL, MAX_STEPS, FilmSettings, Studio

from flowlab import Policy
from flowlab.errors import FlowlabError


@dataclass(frozen=True, slots=True)
class ScoredTrial:
    """One try of one policy."""

    trial: str
    success: bool
    """Whether MetaWorld counted the task as solved at some control step."""
    steps: int
    """Control steps until then, or until it was given up."""
    note: str = ""
    """Why it could not go on."""


def drive(run: Path, task: str, settings: FilmSettings, trials: int) -> list[dict[str, Any]]:
    """Let a policy try a task, on the layouts and with the errors of the camera that every policy meets.

    Args:
        run: What ``flowlab train`` made.
        task: What to try.
        settings: The camera, and what actions mean.
        trials: How many.

    Returns:
        How each went, as JSON values.
    """
    policy, studio = Policy.load(run, task=task), settings.stage(task, color=False)
    return [asdict(_try(policy, studio, k)) for k in range(trials)]


def _try(policy: Policy, studio: Studio, k: int) -> ScoredTrial:
    """One trial, to its success or to its end."""
    policy.reset(seed=k)
    live, camera, note = studio.begin(FIRST_TRIAL + k), studio.sensor(FIRST_TRIAL + k), ""
    try:
        while len(live.success) < MAX_STEPS and not any(live.success) and not live.unstable:
            frame = camera.look(live.frame()) if policy.wants_frame else None
            for step in studio.arm.steps(policy.act(frame, studio.arm.state)):
                live.step(step)
    except FlowlabError as error:
        note = str(error)
    note = "the physics became unstable" if live.unstable else note
    solved = any(live.success) and not note
    return ScoredTrial(f"{k + 1:02d}", solved, live.success.index(True) + 1 if solved else len(live.success), note)
