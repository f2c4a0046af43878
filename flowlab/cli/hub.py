"""``flowlab hub push`` and ``flowlab hub pull``."""

import sys
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from flowlab.cli.console import echo, json_option, print_json, quiet_option, say
from flowlab.cli.heartbeat import is_quiet
from flowlab.cli.paths import PATH
from flowlab.errors import UsageError
from flowlab.text import counted

if TYPE_CHECKING:
    from flowlab.hub.connection import HubConnection, RepoState
    from flowlab.hub.pushing import PlannedPush

_MOST_LINES = 20
"""Files of a folder that are listed one by one."""


@click.group()
def hub() -> None:
    """Share datasets and policies on the Hugging Face Hub.

    Needs pip install 'flowlab[hub]', and to push, or for what is private, 'hf auth login' or HF_TOKEN.
    """


@hub.command()
@click.argument("path", type=PATH)
@click.argument("repo", metavar="USER/NAME")
@click.option("--license", "license_name", metavar="NAME", help="As the Hub names it: cc-by-4.0, mit, other.")
@click.option("--private", is_flag=True, help="Make the repository a private one, if it is not there yet.")
@click.option("--dry-run", is_flag=True, help="List what would be uploaded, every file; the Hub is not asked.")
@click.option("--yes", is_flag=True, help="Do not ask before it is uploaded.")
@quiet_option
@json_option
def push(
    path: Path, repo: str, license_name: str | None, private: bool, dry_run: bool, yes: bool, as_json: bool
) -> None:
    """Upload the dataset, the run of a policy, or its checkpoint at PATH.

    \b
      flowlab hub push data/pour anna/pour --license cc-by-4.0 --dry-run
      flowlab hub push runs/pour-fdp anna/pour-fdp --private

    What is uploaded is listed first, with sizes, and nothing else is. Local paths are cut to their last names; a
    dataset that is not sound is refused.
    """
    from flowlab.hub.connection import HubConnection
    from flowlab.hub.pushing import planned_push, push, replaced_files

    with planned_push(path, repo, license_name) as plan:
        if dry_run:
            _tell_plan(path, plan, "would be uploaded; nothing was", every=True, as_json=as_json)
            return
        connection = HubConnection(quiet=is_quiet() or not sys.stderr.isatty())
        there = connection.find(plan.name, plan.kind)
        replaced = replaced_files(plan, there.sizes) if there else ()
        if not as_json:
            _tell_plan(path, plan, "to upload", every=False, as_json=False)
            _list({name: there.sizes[name] for name in replaced} if there else {}, "deleted there: ", every=False)
        if not yes:
            _ask(plan, connection, there, private)
        done = push(plan, connection, private=private, replaced=replaced)
        url = connection.url(done, plan.kind)
        if as_json:
            print_json({**_facts(plan), "deleted": len(replaced), "revision": done.revision, "url": url})
        else:
            echo(f"{path}: {counted(len(plan.sizes), 'file')} at {url}")


@hub.command()
@click.argument("repo", metavar="USER/NAME[@REVISION]")
@click.option("--out", type=PATH, help="Folder to make  [NAME].")
@click.option("--kind", type=click.Choice(["dataset", "policy"]), help="[what there is of this name].")
@quiet_option
@json_option
def pull(repo: str, out: Path | None, kind: str | None, as_json: bool) -> None:
    """Download a dataset or a policy.

    \b
      flowlab hub pull anna/pour --out data/pour
      flowlab hub pull anna/pour-fdp@1f3c2aa --out runs/pour-fdp

    REVISION is a commit, a branch or a tag; the commit that was pulled stands in what was made. Only the files that
    flowlab writes are fetched, none of them is run, and what is unsound does not stay. Ended early, the same command
    goes on.
    """
    from flowlab.hub.connection import HubConnection
    from flowlab.hub.names import HubName
    from flowlab.hub.pulling import pull

    name = HubName.parse(repo)
    place = out or Path(name.repo.partition("/")[2])
    connection = HubConnection(quiet=is_quiet() or not sys.stderr.isatty())
    done = pull(name, place, connection, kind, say)  # type: ignore[arg-type]
    if as_json:
        print_json(
            {"kind": done.kind, "repo": done.name.repo, "revision": done.name.revision, "folder": str(done.folder),
             "files": done.files, "bytes": done.total}
        )  # fmt: skip
    else:
        echo(f"{done.folder}: {'is' if done.total else 'was already'} {done.kind} {done.name}")


def _ask(plan: "PlannedPush", connection: "HubConnection", there: "RepoState | None", private: bool) -> None:
    """Have the user agree."""
    if not sys.stdin.isatty():
        raise UsageError("nobody is here to agree to the upload; look at it with --dry-run, then give --yes")
    seen = "private" if (there.private if there else private) else "public"
    new = "" if there else "new "
    click.confirm(f"upload to the {new}{seen} {connection.url(plan.name, plan.kind)}?", abort=True, err=True)


def _facts(plan: "PlannedPush") -> dict[str, object]:
    """What is told of a push as JSON."""
    return {
        "kind": plan.kind, "repo": plan.name.repo, "files": dict(plan.sizes), "bytes": plan.total,
        "license": plan.staged.license or None, "fingerprint": plan.staged.fingerprint,
        "paths_cut": list(plan.staged.places), "shards_changed": list(plan.staged.shards), "left_out": plan.left_out,
    }  # fmt: skip


def _tell_plan(path: Path, plan: "PlannedPush", what: str, *, every: bool, as_json: bool) -> None:
    """List what is uploaded, and all that there is to know of it."""
    if as_json:
        print_json(_facts(plan))
        return
    _list(plan.sizes, "", every=every)
    echo(f"{path}: {plan.kind} {plan.name}, {counted(len(plan.sizes), 'file')}, {_size(plan.total)} {what}")
    echo(f"license: {plan.staged.license or 'not stated, so that nobody may use it; --license says it'}")
    if plan.staged.places:
        echo(f"local paths are cut to their last names in: {', '.join(plan.staged.places)}")
    if plan.staged.shards:
        echo(
            f"written anew without them: {', '.join(plan.staged.shards)}; the fingerprint there is "
            f"{plan.staged.fingerprint}"
        )
    if plan.told:
        echo(f"names of you or this machine stand in the texts: {', '.join(plan.told)}; look whether that is meant")
    if plan.left_out:
        echo(f"stays here: {', '.join(plan.left_out)}")


def _list(sizes: Mapping[str, int], before: str, *, every: bool) -> None:
    """Files with their sizes; of a folder with many, their number."""
    folders: dict[str, dict[str, int]] = defaultdict(dict)
    for name, size in sizes.items():
        folders[name.rpartition("/")[0]][name] = size
    for folder, files in folders.items():
        if every or len(files) <= _MOST_LINES:
            for name, size in files.items():
                echo(f"{before}{name}  {_size(size)}")
        else:
            whole = _size(sum(files.values()))
            echo(f"{before}{folder}/  {counted(len(files), 'file')}, {whole}; --dry-run lists them all")


def _size(size: int) -> str:
    """Bytes as people say them."""
    return f"{size:,} B" if size < 10_000 else f"{size / 1e3:,.1f} kB" if size < 1e7 else f"{size / 1e6:,.1f} MB"
