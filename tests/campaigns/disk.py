"""Have the disk fail under every command that writes: full, read-only, broken or forbidden, at every operation.

    python -m tests.campaigns.disk --seed 0 --count 500

An operation fails once, or it and all after it. One trial in ten uses a real full disk (a tmpfs of a random size),
where this machine lets one be mounted. The command must end with one sentence and exit code 1 to 4, or do its work
whole; nothing half-written may stand under its final name; with the fault gone the same command must end with the
results of an undisturbed run.
"""

import random
import subprocess
from pathlib import Path

from tests.campaigns import compare, faults
from tests.campaigns.campaign import Campaign, options
from tests.campaigns.kill import Undisturbed, undisturbed
from tests.campaigns.sandbox import HUNG, Ended, call, warm_up
from tests.campaigns.scenes import SCENES, Scene, Workplace

OUTCOMES = ("told", "tolerated", "traceback", "no sentence", "half-written", "dead end", "other bytes", "leftovers",
            "hung")  # fmt: skip
_REAL_DISKS = 0.1


@options(count=500)
def main(seed: int, count: int, budget: float, only: tuple[str, ...], keep: Path) -> None:
    faults.begin_with_faults()
    warm_up()
    campaign = Campaign("disk", OUTCOMES, ("told", "tolerated"), keep)
    scenes = [SCENES[name] for name in only or SCENES]
    place = Workplace(campaign.folder)
    known: dict[str, Undisturbed] = {}
    for number in campaign.trials(seed, count, budget):
        scene, chance = scenes[number % len(scenes)], random.Random(number)
        if scene.name not in known:
            known[scene.name] = undisturbed(scene, place)
        folder = place.trial(scene.needs)
        if chance.random() < _REAL_DISKS and _can_mount(place.folder):
            fault, ended = _on_full_disk(scene, place, folder, chance)
        else:
            fault, ended = _with_fault(scene, folder, known[scene.name], chance)
        outcome, about = _judge(scene, folder, known[scene.name], ended)
        campaign.add(f"{scene.name}, {fault.split()[0]}", outcome, f"seed {number}: {fault}: {about}", folder)
    campaign.finish()


def _with_fault(scene: Scene, folder: Path, known: Undisturbed, chance: random.Random) -> tuple[str, Ended]:
    name = chance.choice(sorted(faults.ERRORS))
    how, nth = chance.choice((faults.FAIL_ONCE, faults.FAIL_ON)), chance.randint(1, known.operations)
    ended = call(scene.command, folder, before=lambda: faults.arm(folder, how, nth, faults.ERRORS[name]))
    return f"{name} {'once' if how == faults.FAIL_ONCE else 'from'} operation {nth}", ended


def _can_mount(folder: Path) -> bool:
    trial = folder / "mounts"
    trial.mkdir(exist_ok=True)
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", trial], capture_output=True).returncode:
        return False
    return subprocess.run(["umount", trial], capture_output=True).returncode == 0


def _on_full_disk(scene: Scene, place: Workplace, folder: Path, chance: random.Random) -> tuple[str, Ended]:
    """The command with the trial's folder on a disk that fills up; what it left there is copied back."""
    used = sum(p.stat().st_size // 4096 * 4 + 8 for p in folder.rglob("*"))
    kilobytes = used + chance.choice((8, 32, 128, 512))
    disk = place.folder / "disk"
    folder.rename(disk)
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", folder], check=True)
    try:
        subprocess.run(["cp", "-a", f"{disk}/.", folder], check=False, capture_output=True)
        ended = call(scene.command, folder)
        subprocess.run(["rm", "-rf", disk], check=True)
        subprocess.run(["cp", "-a", folder, disk], check=True)
    finally:
        subprocess.run(["umount", folder], check=True)
    folder.rmdir()
    disk.rename(folder)
    return f"tmpfs of {kilobytes} kB", ended


def _judge(scene: Scene, folder: Path, known: Undisturbed, ended: Ended) -> tuple[str, str]:
    if ended.code == HUNG:
        return "hung", ""
    if ended.traceback:
        return "traceback", ended.err[-2500:]
    if ended.code and not (1 <= ended.code <= 4 and ended.err.strip()):
        return "no sentence", f"exit code {ended.code}: {ended.err[-500:]}"
    if ended.code == 0 and (changed := list(compare.differences(known.state, _final(scene, folder)))):
        return "other bytes", f"exit code 0, but {changed[:5]}"
    for made in scene.checks:
        if ended.code and (folder / made).exists() and (found := call(("validate", made), folder)).traceback:
            return "half-written", f"validate: {found.err[-1500:]}"
    again = call(scene.command, folder)
    if again.code and scene.resumes and "--resume" in again.err:
        again = call(scene.resumes, folder)
    if again.code and not (scene.once and again.code == 3 and "exists already" in again.err):
        return "dead end", f"{ended.last_line} | then: {again.code} {again.err[-2000:]}"
    if changed := list(compare.differences(known.state, _final(scene, folder))):
        return "other bytes", f"{ended.last_line} | {changed[:5]}"
    if stayed := compare.leftovers(folder):
        return "leftovers", f"{ended.last_line} | {stayed[:5]}"
    return ("told", ended.last_line) if ended.code else ("tolerated", "")


def _final(scene: Scene, folder: Path) -> dict[str, str]:
    return {path: digest for path, digest in compare.state(folder, scene.makes).items() if ".tmp-" not in path}


if __name__ == "__main__":
    main()
