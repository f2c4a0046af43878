"""Who tries the tasks: policies that look through a camera that errs, MetaWorld's expert, and blind repetition."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from rehearsal_films import FIRST_TRIAL, MAX_STEPS, FilmSettings, Studio

from flowlab import Policy
from flowlab.errors import FlowlabError
from flowlab.sim.recorder import EpisodeRecorder


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


Attempt = Callable[[Studio, int], tuple[EpisodeRecorder, str]]
"""Tries the layout of a number; what happened, and why it could not go on."""


def try_policy(run: Path, task: str, settings: FilmSettings, trials: int) -> list[dict[str, Any]]:
    """Let a policy try a task, on the layouts and with the errors of the camera that every policy meets.

    Args:
        run: What ``flowlab train`` made.
        task: What to try.
        settings: The camera, and what actions mean.
        trials: How many.

    Returns:
        How each went, as JSON values.
    """
    policy = Policy.load(run, task=task)
    return _tried(settings.studio(task, color=False), trials, lambda studio, number: _drive(policy, studio, number))


def try_expert(task: str, settings: FilmSettings, trials: int) -> list[dict[str, Any]]:
    """The same by MetaWorld's expert, who is told where everything is."""
    return _tried(settings.studio(task, color=False), trials, lambda studio, number: (studio.expert(number)[0], ""))


def try_repetition(task: str, settings: FilmSettings, trials: int) -> list[dict[str, Any]]:
    """The same by the actions of the first demonstration, wherever the object is."""
    studio = settings.studio(task, color=False)
    shown = next(r for number in studio.layouts(0) if (r := studio.demonstrate(number)) is not None)
    return _tried(studio, trials, lambda studio, number: (studio.repeat(number, shown.action), ""))


def _tried(studio: Studio, trials: int, attempt: Attempt) -> list[dict[str, Any]]:
    numbers = islice(studio.layouts(FIRST_TRIAL), trials)
    return [asdict(_scored(f"{k:02d}", *attempt(studio, number))) for k, number in enumerate(numbers, 1)]


def _scored(trial: str, live: EpisodeRecorder, note: str) -> ScoredTrial:
    note = "the physics became unstable" if live.unstable else note
    solved = any(live.success) and not note
    return ScoredTrial(trial, solved, live.success.index(True) + 1 if solved else len(live.success), note)


def _drive(policy: Policy, studio: Studio, number: int) -> tuple[EpisodeRecorder, str]:
    """One trial, to its success or to its end."""
    policy.reset(seed=number)
    live, camera = studio.begin(number), studio.sensor(number)
    try:
        while len(live.success) < MAX_STEPS and not any(live.success) and not live.unstable:
            frame = camera.look(live.frame()) if policy.wants_frame else None
            for step in studio.arm.steps(policy.act(frame, studio.arm.state)):
                live.step(step)
    except FlowlabError as error:
        return live, str(error)
    return live, ""
