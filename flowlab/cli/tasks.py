"""``flowlab tasks``."""

import click

from flowlab.cli.console import echo, json_option, print_json, print_table
from flowlab.cli.values import groups as group_names
from flowlab.cli.values import names_option
from flowlab.sim.tasks import GROUPS, TASKS, select_tasks


@click.command()
@names_option("--group", "groups", known=group_names, default=["all"], help="Of this difficulty  [all].")
@json_option
def tasks(groups: tuple[str, ...], as_json: bool) -> None:
    """List MetaWorld's tasks with their difficulty and scripted expert."""
    chosen = [TASKS[name] for name in select_tasks([], groups)]
    if as_json:
        print_json([{"task": t.name, "difficulty": t.difficulty, "expert": t.expert} for t in chosen])
        return
    print_table(["task", "difficulty", "expert"], [[t.name, t.difficulty, t.expert] for t in chosen])
    counts = ", ".join(f"{len(names)} {group}" for group, names in GROUPS.items() if group != "all")
    echo(f"groups for --group: {counts}, {len(TASKS)} all")
