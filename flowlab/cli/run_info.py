"""``flowlab info`` of a training run, or of a policy that was pulled from the Hub."""

from pathlib import Path

from flowlab.cli.console import echo, print_json


def print_run(folder: Path, as_json: bool) -> None:
    """What the policy is, and what it learned from."""
    from flowlab.data.mixture import dataset_shares
    from flowlab.policies.overview import run_overview

    run = run_overview(folder)
    trained, shares = run.trained, dataset_shares(run.trained.mixture, run.trained.dataset)
    about = {
        "run": str(folder),
        "policy": trained.policy.settings.policy,
        "step": run.step,
        "steps": run.steps,
        "tasks": ", ".join(trained.policy.tasks),
        "dataset": trained.dataset,
        "fingerprint": trained.fingerprint,
        "demonstrations": run.demonstrations,
        "held_out": run.held_out,
        "license": trained.license,
        "hub": trained.hub,
        "flowlab": trained.versions.get("flowlab", ""),
    }
    if as_json:
        mixture = [{"dataset": s.name, "share": s.share, **s.about.model_dump(mode="json")} for s in shares]
        print_json({**about, "mixture": mixture, "settings": trained.policy.settings.model_dump(mode="json")})
        return
    for name, value in about.items():
        echo(f"{name.replace('_', ' '):<14} {'not known' if value in (None, '') else value}")
    for one in shares:
        echo(f"{'learned from':<14} {one}; weight {one.about.weight:g}, content {one.about.fingerprint}")
