"""Kill every command that writes, anywhere, and see that the same command ends with the same bytes.

    python -m tests.campaigns.kill --seed 0 --count 2000

Half of the trials die at a file operation (before it, or with half of a write done), as many at every one of them in
turn as there are trials; half at a random moment. One trial in twenty of extraction, tracking, evaluation and bench
runs on real worker processes. Afterwards `validate` must find nothing but what is told, and the same command (or what
its sentence says) must end well, with the results of an undisturbed run and nothing left behind.
"""

import random
from dataclasses import dataclass
from pathlib import Path

from tests.campaigns import compare, faults
from tests.campaigns.campaign import Campaign, options
from tests.campaigns.engine import NAME as ENGINE
from tests.campaigns.sandbox import HUNG, call, warm_up
from tests.campaigns.scenes import SCENES, Scene, Workplace

OUTCOMES = ("ok", "undisturbed", "lost", "silent", "dead end", "other bytes", "leftovers", "traceback")
_REAL_WORKERS = 0.05


@dataclass(frozen=True)
class Undisturbed:
    """A scene's command when nothing happens."""

    state: dict[str, str]
    operations: int
    seconds: float


@options(count=2000)
def main(seed: int, count: int, budget: float, only: tuple[str, ...], keep: Path) -> None:
    faults.begin_with_faults()
    warm_up()
    campaign = Campaign("kill", OUTCOMES, ("ok", "undisturbed"), keep)
    scenes = [SCENES[name] for name in only or SCENES]
    place = Workplace(campaign.folder)
    known: dict[str, Undisturbed] = {}
    for number in campaign.trials(seed, count, budget):
        scene = scenes[number % len(scenes)]
        if scene.name not in known:
            known[scene.name] = undisturbed(scene, place)
        chance = random.Random(number)
        row, outcome, about = _trial(scene, place, known[scene.name], chance)
        campaign.add(row, outcome, f"seed {number}: {about}", place.folder / "trial")
    campaign.finish()


def undisturbed(scene: Scene, place: Workplace) -> Undisturbed:
    folder = place.trial(scene.needs)
    ended = call(scene.command, folder, before=lambda: faults.arm(folder, faults.COUNT))
    if ended.code:
        raise RuntimeError(f"{scene.name}: {ended.err[-2000:]}")
    return Undisturbed(compare.state(folder, scene.makes), ended.operations, ended.seconds)


def _trial(scene: Scene, place: Workplace, known: Undisturbed, chance: random.Random) -> tuple[str, str, str]:
    folder = place.trial(scene.needs)
    by_operation = chance.random() < 0.5
    if by_operation:
        how, nth = chance.choice((faults.KILL, faults.TEAR)), chance.randint(1, known.operations)
        row, about = f"{scene.name}, operation", f"{'torn' if how == faults.TEAR else 'killed'} at operation {nth}"
        killed = call(scene.command, folder, before=lambda: faults.arm(folder, how, nth))
    else:
        moment = chance.uniform(0, known.seconds)
        real = ENGINE in scene.command and chance.random() < _REAL_WORKERS
        command = tuple("local" if word == ENGINE else word for word in scene.command) if real else scene.command
        row, about = f"{scene.name}, moment", f"killed after {moment:.3f} s{' with workers' if real else ''}"
        killed = call(command, folder, kill_after=moment + (4 if real else 0))
    if killed.code >= 0:
        if killed.code and not by_operation:
            return row, "dead end", f"{about}: ended by itself: {killed.last_line}"
        return row, "undisturbed", about
    return row, *_judge(scene, folder, known, about)


def _judge(scene: Scene, folder: Path, known: Undisturbed, about: str) -> tuple[str, str]:
    """What can be said after a kill."""
    at_kill = compare.state(folder, scene.makes)
    sound = True
    for made in scene.checks:
        if (folder / made).exists():
            checked = call(("validate", made), folder)
            if checked.traceback or checked.code == HUNG:
                return "traceback", f"{about}: validate: {checked.err[-2000:]}"
            sound &= checked.code == 0
    again = call(scene.command, folder)
    if again.code and scene.resumes and not again.traceback and "--resume" in again.err:
        again = call(scene.resumes, folder)
    if again.code and not (scene.once and again.code == 3 and "exists already" in again.err):
        kind = "traceback" if again.traceback else "dead end"
        return kind, f"{about}: the same command: {again.code} {again.err[-2000:]}"
    final = compare.state(folder, scene.makes)
    whole = {path for path, digest in at_kill.items() if known.state.get(path) == digest}
    if missing := [path for path in whole if path not in final]:
        return "lost", f"{about}: {missing[:5]}"
    if changed := list(compare.differences(known.state, _without_leftovers(final))):
        return ("silent" if sound else "other bytes"), f"{about}: {changed[:5]}"
    if stayed := compare.leftovers(folder):
        return "leftovers", f"{about}: {stayed[:5]}"
    return "ok", about


def _without_leftovers(state: dict[str, str]) -> dict[str, str]:
    return {path: digest for path, digest in state.items() if ".tmp-" not in path}


if __name__ == "__main__":
    main()
