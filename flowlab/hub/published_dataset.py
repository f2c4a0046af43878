"""A dataset as it goes to the Hub, and as it comes from there."""

import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flowlab.checksums import sha256_of
from flowlab.errors import DataError
from flowlab.files import write_atomically
from flowlab.hub.cards import dataset_page
from flowlab.hub.local_paths import without_local_paths
from flowlab.hub.names import HubName
from flowlab.hub.repo_layout import BOOKS, CARD, PICTURE, matches
from flowlab.storage.dataset import Dataset, summaries, summarize
from flowlab.storage.manifest import MANIFEST, Manifest
from flowlab.storage.receipts import Receipt, keep_receipt
from flowlab.storage.shard import Shard, episode_digest, write_shard
from flowlab.storage.validation import validate_content


@dataclass(frozen=True, slots=True)
class Staged:
    """What was done to what goes to the Hub."""

    license: str
    """Empty where nobody has said."""
    places: tuple[str, ...]
    """Where a local path was cut to its last name."""
    shards: tuple[str, ...] = ()
    """Shards that are others for that, so that the dataset has another fingerprint."""
    fingerprint: str = ""
    """Of the dataset that goes there."""


def stage_dataset(source: Dataset, folder: Path, name: HubName, license_name: str | None) -> Staged:
    """Fill an empty folder with all of a dataset that goes to the Hub: its shards as links, if they can go as they are.

    Raises:
        DataError: It is not sound, of an earlier flowlab, or holds nothing.
    """
    if not len(source):
        raise DataError(f"{source.path}: holds no episodes; there is nothing to share yet")
    manifest, places = _cleaned_manifest(source.manifest, license_name)
    for part in ("shards", "receipts"):
        (folder / part).mkdir()
    manifest.write(folder)
    shards: list[str] = []
    for receipt in source.receipts:
        values, found = without_local_paths(json.loads(receipt.model_dump_json()), "receipts")
        receipt = Receipt.model_validate(values)
        for shard, update in _stage_shards(source.path, receipt, folder, manifest.settings_digest, places):
            receipt = receipt.model_copy(update=update)
            shards += [shard] if update else []
        keep_receipt(folder, receipt)
        places |= dict.fromkeys(found)
    check_sound(folder, source.path)
    _write_pages(folder, name)
    return Staged(manifest.provenance.license, tuple(places), tuple(shards), Dataset(folder).fingerprint)


def _cleaned_manifest(manifest: Manifest, license_name: str | None) -> tuple[Manifest, dict[str, None]]:
    """A manifest that says nothing of the machine; its shards call the settings what they did."""
    values, places = without_local_paths(json.loads(manifest.model_dump_json()))
    cleaned = Manifest.model_validate(values)
    about = cleaned.provenance.model_copy(update={"license": license_name} if license_name else {})
    update: dict[str, Any] = {"provenance": about}
    if cleaned.settings_digest != manifest.settings_digest:
        update["first_settings_digest"] = manifest.settings_digest
    return cleaned.model_copy(update=update), dict.fromkeys(places)


def _stage_shards(
    source: Path, receipt: Receipt, folder: Path, digest: str, places: dict[str, None]
) -> list[tuple[str, dict[str, Any]]]:
    """Put the shards of a unit into a folder; for each its path, and what its receipt says otherwise then."""
    staged = []
    for there, path, checksum in (
        (bool(receipt.accepted), receipt.shard, "shard_sha256"),
        (receipt.keeps_rejects, receipt.rejects_shard, "rejects_sha256"),
    ):
        if not there:
            continue
        if not getattr(receipt, checksum):
            raise DataError(
                f"{source / path}: is a folder, as flowlab wrote shards before; make the dataset anew with 'flowlab "
                f"subset {source} --tasks ... --out NEW', which writes zips, and push that"
            )
        place = folder / path
        place.parent.mkdir(exist_ok=True)
        staged.append((path, _stage_shard(source / path, place, digest, checksum, places)))
    return staged


def _stage_shard(path: Path, place: Path, digest: str, checksum: str, places: dict[str, None]) -> dict[str, Any]:
    """Link to a shard, or write it anew without local paths; what its receipt says otherwise then."""
    shard = Shard(path)
    cleaned = [without_local_paths(shard.about(k), "shards.extras") for k in range(len(shard))]
    found = {where for _, wheres in cleaned for where in wheres}
    if not found:
        place.symlink_to(path.resolve())
        return {}
    places |= dict.fromkeys(sorted(found))
    episodes = [replace(e, extras=extras) for e, (extras, _) in zip(shard.episodes(), cleaned, strict=True)]
    write_shard(place, episodes, digest)
    changed: dict[str, Any] = {checksum: sha256_of(place)}
    return changed | ({"digests": tuple(map(episode_digest, episodes))} if checksum == "shard_sha256" else {})


def _write_pages(folder: Path, name: HubName) -> None:
    """Write what follows from a dataset, and what people see of it."""
    from flowlab.viz.still import draw_still

    dataset = Dataset(folder)
    for file, text in summaries(dataset).items():
        page = dataset_page(name, dataset, text, picture=True) if file == CARD else text
        write_atomically(folder / file, page)
    first = dataset[0]
    draw_still(first, folder / PICTURE, title=f"{name.repo}: {first.task} {first.seed}")


def check_sound(folder: Path, named: Path | str) -> None:
    """Refuse a dataset of which anything is wrong but that it is not complete.

    Raises:
        DataError: Says what, with ``named`` for the folder.
    """
    findings = [str(finding).replace(str(folder), str(named)) for finding in validate_content(Dataset(folder))]
    if findings:
        more = f" (and {len(findings) - 1} more findings)" if len(findings) > 1 else ""
        raise DataError(f"{findings[0]}{more}")


def check_counted(folder: Path, files: Iterable[str], where: str) -> None:
    """Refuse a repository that lacks a shard which the receipts of a folder count, or has others.

    Raises:
        DataError: Says which.
    """
    counted = {shard for receipt in Dataset(folder).receipts for shard in receipt.shards}
    listed = {file for file in files if not matches(file, BOOKS)}
    if counted != listed:
        lacking, odd = sorted(counted - listed), sorted(listed - counted)
        what = f"lacks {lacking[0]}, which a receipt counts" if lacking else f"has {odd[0]}, which no receipt counts"
        raise DataError(
            f"{where}: {what}; it may be on its way still: try again later, or ask its owner to push it again"
        )


def finish_dataset(folder: Path, where: HubName) -> None:
    """Have a dataset that was pulled say where from, and write what follows from its receipts."""
    manifest = Manifest.read(folder)
    about = manifest.provenance.model_copy(update={"hub": str(where)})
    manifest.model_copy(update={"provenance": about}).write(folder)
    summarize(folder)


def pulled_from(folder: Path) -> str:
    """Where a dataset was pulled from; empty where it was not, or is none."""
    try:
        return Manifest.read(folder).provenance.hub if (folder / MANIFEST).is_file() else ""
    except DataError:
        return ""
