"""Units that are damaged are forgotten, so that the command that made them makes them again."""

from pathlib import Path

from flowlab.errors import DataError
from flowlab.storage.dataset import Dataset
from flowlab.storage.receipts import read_receipt, receipt_files
from flowlab.storage.validation import check_unit, lost_shards


def forget_damaged(folder: Path, *, thorough: bool = False) -> list[str]:
    """Remove receipts that are damaged, and those whose shard is gone: from then on their units are still to be made.

    Args:
        folder: Of the dataset.
        thorough: Also those whose shard is not what they say, for which all shards are read.

    Returns:
        What was wrong with each, in a sentence.
    """
    told = []
    for path in receipt_files(folder):
        problem = _problem(folder, path)
        if problem:
            path.unlink(missing_ok=True)
            told.append(problem)
    if thorough:
        dataset = Dataset(folder)
        for receipt in dataset.receipts:
            finding = next(check_unit(dataset, receipt, contents=False), None)
            if finding is not None:
                (folder / "receipts" / f"{receipt.unit}.json").unlink(missing_ok=True)
                told.append(str(finding).partition(";")[0])
    return told


def _problem(folder: Path, path: Path) -> str:
    """What is wrong with a receipt, as far as is seen without opening its shard; empty where nothing is."""
    try:
        receipt = read_receipt(path)
    except DataError as error:
        return str(error)
    return "".join(f"{shard}: missing, though {path} counts it" for shard in lost_shards(folder, receipt)[:1])
