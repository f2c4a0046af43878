"""What must hold of a dataset so that a policy can be trained on it."""

from collections.abc import Iterator

from flowlab.errors import DataError
from flowlab.storage.dataset import Dataset
from flowlab.storage.receipts import check_row_formats


def training_problems(dataset: Dataset) -> Iterator[str]:
    """Why a dataset that holds episodes cannot be trained on, in sentences: training asks here."""
    if problem := missing_actions(dataset):
        yield problem
    yield from row_problems(dataset)


def missing_actions(dataset: Dataset) -> str:
    """That the episodes have no actions, and what to do about it; empty where they have. It is no damage: films of a
    robot have none, until actions are labeled."""
    known = dataset.row_format
    if known is None or known.action:
        return ""
    return (
        "the episodes have no actions, so no policy can be trained on them; infer them from motion by 'flowlab "
        f"label-actions {dataset.path} --from LABELED --out OUT', or name the robot's state or actions in the "
        "recordings ('state', 'action' in recording.yaml, 'topics' of a bag) and make the dataset again"
    )


def row_problems(dataset: Dataset) -> Iterator[str]:
    """Where state and actions do not fit each other, or what the dataset says of them: validation asks here, too."""
    try:
        check_row_formats(dataset.path, dataset.receipts)
    except DataError as error:
        yield str(error).removeprefix(f"{dataset.path}: ")
        return
    known = dataset.row_format
    if known and (problem := dataset.provenance.width_problem(state=known.state, action=known.action or None)):
        yield f"flowlab.json: provenance.{problem}"
