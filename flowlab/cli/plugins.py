"""``flowlab plugins``."""

from dataclasses import asdict

import click

from flowlab.cli.console import echo, json_option, print_json
from flowlab.cli.values import names_argument
from flowlab.registry import REGISTRIES, registry_of


@click.command()
@names_argument("families", known=lambda: [r.family for r in REGISTRIES], metavar="[FAMILY]...")
@click.option("--check", is_flag=True, help="Import flowlab's own, too, which takes some seconds.")
@json_option
def plugins(families: tuple[str, ...], check: bool, as_json: bool) -> None:
    """List what can be named: its family, name and import path, and which package offers it.

    \b
      flowlab plugins
      flowlab plugins trackers readers --json

    What other packages offer is imported, and what is wrong with it said. Families: trackers, readers, stages,
    policies, exporters, engines, loggers.
    """
    rows = []
    for registry in [registry_of(name) for name in families] or REGISTRIES:
        for plugin in registry.offers():
            own = plugin.package.startswith("flowlab ")
            rows.append(asdict(plugin) | {"problem": "" if own and not check else registry.problem(plugin)})
    if as_json:
        print_json(rows)
        return
    width = max((len(row["name"]) for row in rows), default=0)
    for k, row in enumerate(rows):
        if k == 0 or row["family"] != rows[k - 1]["family"]:
            echo(f"{row['family']}:")
        echo(f"  {row['name']:<{width}}  {row['place']}  ({row['package']})")
    for problem in dict.fromkeys(row["problem"] for row in rows if row["problem"]):
        echo(problem)
