"""Which files a repository of flowlab's consists of: what is uploaded, and all that is fetched of strangers' ones."""

from collections import Counter
from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase

from flowlab.errors import DataError
from flowlab.hub.names import Kind
from flowlab.limits import MAX_ARRAY_BYTES, MAX_LOADED_BYTES, MAX_TEXT_BYTES, MAX_WEIGHTS_BYTES
from flowlab.storage.manifest import MANIFEST
from flowlab.storage.shard_files import SUFFIX
from flowlab.text import is_plain_name, shown

CONFIG, WEIGHTS, CARD, PICTURE = "config.json", "model.safetensors", "README.md", "picture.png"
"""Of a policy, what ``policy.json`` and its checkpoint are called on the Hub; the card; the picture in it."""
BOOKS = (MANIFEST, "receipts/*.json")
"""What a dataset says of itself."""
SHARDS = (f"shards/*{SUFFIX}", f"rejects/*{SUFFIX}")
"""Its episodes."""
FETCHED: Mapping[Kind, Mapping[str, int]] = {
    "dataset": {**dict.fromkeys(BOOKS, MAX_TEXT_BYTES), **dict.fromkeys(SHARDS, MAX_ARRAY_BYTES)},
    "policy": {CONFIG: MAX_TEXT_BYTES, WEIGHTS: MAX_WEIGHTS_BYTES},
}
"""By pattern, the files that are fetched, and the most bytes of each."""
_WRITTEN: Mapping[Kind, tuple[str, ...]] = {
    "dataset": ("stats.json", "rejects.jsonl", CARD, PICTURE),
    "policy": (CARD, PICTURE),
}
"""What is uploaded beside these for people, and follows from them."""
MOST_FILES, MOST_ENTRIES = 100_000, 10_000
"""Of a repository, and of one of its folders: more the Hub does not take well."""


def our_patterns(kind: Kind) -> tuple[str, ...]:
    """Patterns of all files that flowlab uploads, and replaces."""
    return (*FETCHED[kind], *_WRITTEN[kind])


def matches(name: str, patterns: Iterable[str]) -> bool:
    """Whether a file is one of some patterns."""
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def wanted_files(sizes: Mapping[str, int], kind: Kind, where: str) -> dict[str, int]:
    """Those of a repository's files that are fetched, with their sizes [bytes].

    Args:
        sizes: All of its files, as the Hub lists them.
        kind: What the repository should hold.
        where: The repository, for errors.

    Returns:
        Files with plain names, none larger than such a file can be.

    Raises:
        DataError: It holds no such thing, or files that none of ours would have.
    """
    marks = (MANIFEST,) if kind == "dataset" else (CONFIG, WEIGHTS)
    if missing := [name for name in marks if name not in sizes]:
        raise DataError(f"{where}: holds no flowlab {kind} (it has no {missing[0]})")
    wanted = {}
    for name, size in sizes.items():
        limit = next((most for pattern, most in FETCHED[kind].items() if fnmatchcase(name, pattern)), None)
        if limit is None:
            continue
        if not is_plain_name(name.partition("/")[2] or name):
            raise DataError(f"{where}: has a file called {shown(name)}, and a {kind} has none; nothing was fetched")
        if not 0 <= size <= limit:
            raise DataError(f"{where}: {name} has {size:,} bytes, expected at most {limit:,}; nothing was fetched")
        wanted[name] = size
    check_counts(wanted, where)
    if sum(size for name, size in wanted.items() if matches(name, BOOKS)) > MAX_LOADED_BYTES:
        raise DataError(f"{where}: its receipts have more than {MAX_LOADED_BYTES:,} bytes; nothing was fetched")
    return wanted


def check_counts(names: Iterable[str], where: str) -> None:
    """Refuse more files than a repository, or a folder of it, can have. Raises :class:`DataError`."""
    folders = Counter(name.rpartition("/")[0] for name in names)
    advice = "give units more episodes, or split it with 'flowlab subset' and use several repositories"
    if (total := folders.total()) > MOST_FILES:
        raise DataError(f"{where}: has {total:,} files, and a repository takes {MOST_FILES:,}; {advice}")
    for folder, entries in folders.items():
        if entries > MOST_ENTRIES:
            raise DataError(
                f"{where}: has {entries:,} files in {folder or 'its root'}, and a folder on the Hub takes "
                f"{MOST_ENTRIES:,}; {advice}"
            )
