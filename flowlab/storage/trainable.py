"""What must hold of a dataset so that a policy can be trained on it."""

from collections.abc import Iterator

from flowlab.errors import DataError
from flowlab.storage.dataset import Dataset
from flowlab.storage.receipts import check_row_formats


def training_problems(dataset: Dataset) -> Iterator[str]:
    """Why a dataset that holds episodes cannot be trained on, in sentences; training and validation both ask here."""
    try:
        check_row_formats(dataset.path, dataset.receipts)
    except DataError as error:
        yield str(error).removeprefix(f"{dataset.path}: ")
        return
    row_format = next((r.row_format for r in dataset.receipts if r.row_format is not None), None)
    if row_format is None:
        return
    if not row_format.action:
        yield (
            "the episodes have no actions, so no policy can be trained on them; name the robot's state or actions in "
            "the recordings ('state', 'action' in recording.yaml, 'topics' of a bag), and run the same command again"
        )
    if problem := dataset.provenance.width_problem(state=row_format.state, action=row_format.action or None):
        yield f"flowlab.json: provenance.{problem}"
