"""Datasets and policies of strangers, pulled from the Hub: only what they must have, and used only when it is sound."""

import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from flowlab.errors import DataError, UsageError
from flowlab.files import check_inside, locked, new_folder, told_when_unwritable
from flowlab.hub.connection import HubConnection, HubError, RepoState, not_found
from flowlab.hub.names import PREFIX, HubName, Kind
from flowlab.hub.published_dataset import check_counted, check_sound, finish_dataset, pulled_from
from flowlab.hub.published_policy import finish_policy, policy_pulled_from
from flowlab.hub.repo_layout import BOOKS, FETCHED, SHARDS, matches, wanted_files
from flowlab.text import counted
from flowlab.user_cache import user_cache

_HELD_BY_THE_LIBRARY = ".cache"
"""Where ``huggingface_hub`` keeps what it has fetched of each file."""
_SPARE_BYTES = 64 << 20


@dataclass(frozen=True, slots=True)
class Pulled:
    """What was pulled, and where it is now."""

    kind: Kind
    name: HubName
    """With the commit."""
    folder: Path
    files: int
    total: int
    """Bytes that were fetched; 0 where it was here already."""


def pull(
    name: HubName,
    out: Path,
    hub: HubConnection,
    kind: Kind | None = None,
    report: Callable[[str], None] = lambda text: None,
) -> Pulled:
    """Have a dataset or a policy of the Hub in a folder, which is there whole or not at all.

    Args:
        name: Which, and at what revision; the newest where it has none.
        out: Where; one that holds just this already stays as it is.
        hub: The way there.
        kind: What it is; None finds out.
        report: Is told what is about to be fetched.

    Returns:
        What is there now.

    Raises:
        DataError: It is unsound, or something else is at ``out``.
        UsageError: There is none, or both a dataset and a policy are called so.
        HubError: The Hub cannot be reached; the same call goes on where this one ended.
    """
    found, state = _found(name, hub, kind)
    pinned = name.at(state.commit)
    wanted = wanted_files(state.sizes, found, hub.url(name, found))
    if _is_there(out, pinned, found):
        return Pulled(found, pinned, out, len(wanted), 0)
    report(f"pulling {found} {pinned}: {counted(len(wanted), 'file')}, {sum(wanted.values()) / 1e6:,.1f} MB")
    with _staging(out, pinned, found) as folder:
        if folder is not None:
            _check_room(folder, sum(wanted.values()))
            _Fetch(pinned, found, wanted, hub, folder).into(out)
    return Pulled(found, pinned, out, len(wanted), sum(wanted.values()))


def _found(name: HubName, hub: HubConnection, kind: Kind | None) -> tuple[Kind, RepoState]:
    """What is called so, and as what. Raises :class:`UsageError` where there is none, or both."""
    kinds = get_args(Kind) if kind is None else (kind,)
    found = {k: state for k in kinds if (state := hub.find(name, k)) is not None}
    if len(found) > 1:
        raise UsageError(
            f"{name.repo}: there are a dataset and a policy called so; say --kind dataset or --kind policy"
        )
    if not found:
        raise not_found(f"{' or '.join(kinds)} '{name.repo}'")
    return next(iter(found.items()))


def _is_there(out: Path, pinned: HubName, kind: Kind) -> bool:
    """Whether a folder holds just this. Raises :class:`DataError` where something else is there."""
    if not os.path.lexists(out):
        return False
    if (pulled_from if kind == "dataset" else policy_pulled_from)(out) == str(pinned):
        return True
    raise DataError(f"{out}: is there already, and nothing is written over; choose another --out, or delete it")


@contextmanager
def _staging(out: Path, pinned: HubName, kind: Kind) -> Iterator[Path | None]:
    """A folder beside ``out`` that keeps what was fetched when that ends early; None where another process was quicker.

    Where the content is unsound it is deleted, so that nobody comes upon it.
    """
    folder = out.with_name(f".pull-{(pinned.revision or '')[:12]}+{out.name}")
    with told_when_unwritable(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        if folder.is_symlink():
            raise DataError(f"{folder}: is a link, and nothing is written through one; delete it")
        folder.mkdir(exist_ok=True)
        with locked(folder):
            try:
                yield None if _is_there(out, pinned, kind) else folder
            except (HubError, UsageError, KeyboardInterrupt):
                raise
            except BaseException:
                shutil.rmtree(folder, ignore_errors=True)
                raise
            shutil.rmtree(folder, ignore_errors=True)


def _check_room(folder: Path, total: int) -> None:
    """Refuse what does not fit on the disk, before anything is fetched."""
    held = sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())
    if (free := shutil.disk_usage(folder).free) < total - held + _SPARE_BYTES:
        raise HubError(
            f"{folder.parent}: has {free / 1e9:.1f} GB free, and {total / 1e9:.1f} GB are to be pulled; make room, or "
            "choose another --out"
        )


@dataclass(frozen=True, slots=True)
class _Fetch:
    """One repository on its way here."""

    name: HubName
    kind: Kind
    wanted: Mapping[str, int]
    hub: HubConnection
    folder: Path

    def into(self, out: Path) -> None:
        """Fetch it, and make it a folder of the local kind. Raises :class:`DataError` where it is not sound."""
        if self.kind == "policy":
            self._fetch(tuple(FETCHED["policy"]))
            with new_folder(out) as new, self._told_by_its_place(new), self._told_by_its_place(self.folder):
                finish_policy(self.folder, new, self.name)
            return
        self._fetch(BOOKS)
        with self._told_by_its_place(self.folder):
            check_counted(self.folder, self.wanted, self.hub.url(self.name, self.kind))
        self._fetch(SHARDS)
        with self._told_by_its_place(self.folder):
            check_sound(self.folder, self.folder)
        with new_folder(out) as new, self._told_by_its_place(new):
            for file in self.folder.iterdir():
                if file.name != _HELD_BY_THE_LIBRARY:
                    file.rename(new / file.name)
            finish_dataset(new, self.name)

    @contextmanager
    def _told_by_its_place(self, folder: Path) -> Iterator[None]:
        """Tell what is wrong in a folder, which will be deleted, by where it is on the Hub, and who can help."""
        try:
            yield
        except DataError as error:
            if str(folder) not in str(error):
                raise
            what = str(error).replace(str(folder), self.hub.url(self.name, self.kind)).partition("; ")[0]
            raise DataError(f"{what}; ask its owner to push it again, nothing is kept here") from error

    def _fetch(self, patterns: Sequence[str]) -> None:
        """Fetch some of the files, and nothing else: regular ones, as large as was said.

        Raises:
            DataError: Something else is there then.
        """
        self.hub.download(self.name, self.kind, patterns, self.folder)
        found = {}
        for file in _files_below(self.folder):
            name = file.relative_to(self.folder).as_posix()
            check_inside(self.folder, file)
            if file.is_symlink() or not file.is_file() or name not in self.wanted:
                raise DataError(f"{self.name}: {name} came along, and is no file of a {self.kind}; nothing is kept")
            found[name] = file.stat().st_size
        wanted = {name: size for name, size in self.wanted.items() if matches(name, patterns)}
        if wrong := [name for name, size in wanted.items() if found.get(name) != size]:
            raise DataError(
                f"{self.name}: {wrong[0]} came with {found.get(wrong[0], 0):,} bytes instead of "
                f"{wanted[wrong[0]]:,}; give the same command again"
            )


def _files_below(folder: Path) -> Iterator[Path]:
    """All that lies below a folder and is no folder itself, but for what the library keeps."""
    for parent, folders, names in os.walk(folder):
        if Path(parent) == folder and _HELD_BY_THE_LIBRARY in folders:
            folders.remove(_HELD_BY_THE_LIBRARY)
        links = [name for name in folders if Path(parent, name).is_symlink()]
        yield from (Path(parent, name) for name in [*names, *links])


def is_on_hub(source: Any) -> bool:
    """Whether what is to be trained on is named as a dataset on the Hub."""
    return isinstance(source, str | Path) and str(source).startswith(PREFIX)


def local_sources(data: Any, report: Callable[[str], None]) -> Any:
    """What is to be trained on, with the datasets on the Hub pulled into the user's cache.

    A commit that is there already is used without asking the Hub.

    Args:
        data: A source, or a list of them; those that begin with ``hub:`` are on the Hub.
        report: Is told what is about to be fetched.

    Returns:
        The same, with a path in place of each of these.
    """
    if isinstance(data, list | tuple):
        return [local_sources(source, report) for source in data]
    return _in_cache(HubName.parse(str(data)), report) if is_on_hub(data) else data


def _in_cache(name: HubName, report: Callable[[str], None]) -> Path:
    """A dataset of the Hub in the user's cache."""
    place = user_cache() / "hub" / "datasets" / name.folder
    if name.is_pinned and pulled_from(place / str(name.revision)) == str(name):
        return place / str(name.revision)
    hub = HubConnection()
    try:
        found, state = _found(name, hub, "dataset")
    except HubError as error:
        here = sorted(p.name for p in place.glob("[!.]*")) if place.is_dir() else []
        advice = f"; without the Hub there is {PREFIX}{name.repo}@{here[-1]}" if here else ""
        raise HubError(f"{error}{advice}") from error
    return pull(name.at(state.commit), place / state.commit, hub, found, report).folder
