"""``flowlab tasks``."""

import click

from flowlab.cli.console import echo, print_json, print_table
from flowlab.sim.tasks import GROUPS, TASKS, select_tasks


@click.command()
@click.option("--group", type=click.Choice(list(GROUPS)), default="all", show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def tasks(group: str, as_json: bool) -> None:
    """List MetaWorld's tasks with their difficulty and scripted expert."""
    chosen = [TASKS[name] for name in select_tasks([], [group])]
    if as_json:
        print_json([{"task": t.name, "difficulty": t.difficulty, "expert": t.expert} for t in chosen])
        return
    print_table(["task", "difficulty", "expert"], [[t.name, t.difficulty, t.expert] for t in chosen])
    counts = ", ".join(f"{len(names)} {group}" for group, names in GROUPS.items() if group != "all")
    echo(f"groups for --group: {counts}, {len(TASKS)} all")
