"""Datasets and policies, pushed to the Hub: first what would go there, then just that."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from flowlab.errors import DataError, UsageError
from flowlab.files import told_when_unwritable
from flowlab.hub.connection import HubConnection
from flowlab.hub.local_paths import told_names
from flowlab.hub.names import HubName, Kind
from flowlab.hub.published_dataset import Staged, stage_dataset
from flowlab.hub.repo_layout import check_counts, matches, our_patterns
from flowlab.policies.trained import CHECKPOINTS, POLICY
from flowlab.storage.dataset import Dataset
from flowlab.storage.manifest import MANIFEST
from flowlab.text import shown

_LICENSE = re.compile(r"[a-z0-9][a-z0-9.+-]{0,63}")


@dataclass(frozen=True, slots=True)
class PlannedPush:
    """What would go to the Hub, in a folder of its own: nothing else goes there."""

    kind: Kind
    name: HubName
    folder: Path
    sizes: Mapping[str, int]
    """Of all files that go there [bytes]."""
    staged: Staged
    """What was done for that."""
    told: tuple[str, ...]
    """Names of the user or the machine that stand in it still."""
    left_out: tuple[str, ...]
    """What lies beside it and stays here."""

    @property
    def total(self) -> int:
        """All its bytes."""
        return sum(self.sizes.values())


def kind_of(path: Path) -> Kind:
    """What a folder or file holds that can be pushed, told by its content. Raises :class:`DataError`."""
    if (path / MANIFEST).is_file():
        return "dataset"
    if (path / POLICY).is_file() or path.suffix == ".safetensors":
        return "policy"
    raise DataError(
        f"{path}: holds nothing to push, expected a dataset ({MANIFEST}), or a run of 'flowlab train' ({POLICY}) or "
        "one of its checkpoints"
    )


@contextmanager
def planned_push(path: Path, repo: str, license_name: str | None = None) -> Iterator[PlannedPush]:
    """What of a dataset, a run or a checkpoint goes to the Hub; the network is not asked.

    Args:
        path: What is to be pushed; it stays as it is.
        repo: ``user/name``.
        license_name: What the Hub calls its license; None leaves it as it is known, or not said.

    Raises:
        DataError: It is not sound, or too much for a repository.
        UsageError: The name or the license is none.
    """
    name = HubName.parse(repo)
    if name.revision is not None:
        raise UsageError(f"{shown(repo)}: is pushed as the newest revision; leave out '@{name.revision}'")
    if license_name is not None and not _LICENSE.fullmatch(license_name):
        raise UsageError(
            f"--license {shown(license_name)}: is no license as the Hub names them, such as cc-by-4.0, mit or other"
        )
    kind = kind_of(path)
    with TemporaryDirectory(prefix="flowlab-push-") as temporary:
        folder = Path(temporary)
        with told_when_unwritable(folder, "make room"):
            if kind == "dataset":
                staged = stage_dataset(Dataset(path), folder, name, license_name)
            else:
                from flowlab.hub.published_policy import stage_policy  # with PyTorch

                staged = stage_policy(path, folder, name, license_name)
        sizes = {str(f.relative_to(folder)): f.stat().st_size for f in sorted(folder.rglob("*")) if f.is_file()}
        check_counts(sizes, str(path))
        yield PlannedPush(kind, name, folder, sizes, staged, _told_in(folder, sizes), _left_out(path, sizes))


def push(plan: PlannedPush, hub: HubConnection, *, private: bool, replaced: tuple[str, ...] = ()) -> HubName:
    """Upload what was planned; the name of the repository, at the commit that has it.

    Args:
        plan: What goes there.
        hub: The way there.
        private: Whether a repository that is made for it is.
        replaced: Files of :func:`replaced_files`, which are deleted there.

    Raises:
        HubError: The Hub cannot be reached, or refuses it; the same call goes on where it ended.
    """
    hub.create(plan.name, plan.kind, private=private)
    return plan.name.at(hub.upload(plan.name, plan.kind, plan.folder, replaced))


def replaced_files(plan: PlannedPush, there: Mapping[str, int]) -> tuple[str, ...]:
    """What an earlier push has put into the repository, and this one has not; other people's files stay."""
    return tuple(f for f in sorted(there) if matches(f, our_patterns(plan.kind)) and f not in plan.sizes)


def _told_in(folder: Path, sizes: Mapping[str, int]) -> tuple[str, ...]:
    """Names of the user or the machine in the texts of a folder."""
    texts = (name for name in sizes if Path(name).suffix in (".json", ".jsonl", ".md"))
    found = {name: None for text in texts for name in told_names((folder / text).read_text())}
    return tuple(found)


def _left_out(path: Path, sizes: Mapping[str, int]) -> tuple[str, ...]:
    """Files and folders beside what is pushed that stay here."""
    going = {name.partition("/")[0] for name in sizes} | {POLICY, CHECKPOINTS}  # which go by other names
    return tuple(sorted(p.name for p in path.iterdir() if p.name not in going)) if path.is_dir() else ()
