"""The page of a dataset or policy on the Hub: what the Hub indexes, and what a stranger types to use it."""

from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from flowlab.data.mixture import dataset_shares
from flowlab.hub.names import HubName
from flowlab.hub.repo_layout import PICTURE
from flowlab.policies.trained import TrainedPolicy
from flowlab.storage.card import without_mark
from flowlab.storage.dataset import Dataset
from flowlab.text import markdown, one_line

UNKNOWN = "unknown"
"""What the Hub calls a license that nobody has said."""
_SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"))
_DATASET = """# {title}

{picture}
License: {license}.

```bash
pip install 'flowlab[hub]'
flowlab hub pull {repo} --out data/{short}
flowlab train hub:{repo} --policy fdp --out runs/{short}
```

{rest}"""
_POLICY = """# {title}

{picture}
A policy of flowlab ({policy}), after {step} training steps on {dataset}. Tasks: {tasks}. License: {license}.

```bash
pip install 'flowlab[hub]'
flowlab hub pull {repo} --out runs/{short}
flowlab serve runs/{short}
```

`config.json` says what it is and holds every setting; `model.safetensors` are its weights. Neither is code, and neither
is unpickled.
"""


def dataset_page(name: HubName, dataset: Dataset, card: str, *, picture: bool) -> str:
    """The ``README.md`` of a dataset on the Hub, made of its own card."""
    frames = sum(ref.frames for ref in dataset.refs)
    tasks = sorted(dataset.manifest.requested)
    about = dataset.provenance
    tags = ["robotics", "point-cloud", "3d-flow", "flowlab", *([about.kind] if about.kind != "unknown" else [])]
    head: dict[str, Any] = {
        "license": about.license or UNKNOWN,
        "pretty_name": name.repo.partition("/")[2],
        "task_categories": ["robotics"],
        "tags": [*tags, *_tags(tasks)],
        "size_categories": [next((size for most, size in _SIZES if frames < most), "n>10M")],
        "viewer": False,  # it shows tables only
    }
    rest = without_mark(card).partition("---\n")[2].partition("---\n")[2].partition("\n")[2].lstrip()
    return _front(head) + _filled(_DATASET, name, about.license, picture, rest=rest)


def policy_page(name: HubName, trained: TrainedPolicy, step: int, datasets: Sequence[str], *, picture: bool) -> str:
    """The ``README.md`` of a policy on the Hub; ``datasets`` are those it learned from that are on the Hub."""
    policy = trained.policy.settings.policy
    head: dict[str, Any] = {
        "license": trained.license or UNKNOWN,
        "library_name": "flowlab",
        "pipeline_tag": "robotics",
        "tags": ["robotics", "3d-flow", "flowlab", *_tags([policy, *trained.policy.tasks])],
    }
    if datasets:
        head["datasets"] = list(datasets)
    values = {
        "policy": markdown(policy),
        "step": f"{step:,}",
        "dataset": ", ".join(markdown(name) for name in _learned_from(trained)),
        "tasks": ", ".join(map(markdown, trained.policy.tasks)),
    }
    return _front(head) + _filled(_POLICY, name, trained.license, picture, **values)


def _learned_from(trained: TrainedPolicy) -> list[str]:
    """What a policy learned from, with the shares of several datasets that had weights."""
    mixed = dataset_shares(trained.mixture, trained.dataset)
    return [f"{one.name} ({one.share:.4g} of the windows)" for one in mixed] or [trained.dataset]


def _tags(names: Sequence[str]) -> list[str]:
    """Names as tags; the Hub takes fifty letters."""
    return [one_line(name) for name in names if len(name) <= 50][:100]


def _front(head: Mapping[str, Any]) -> str:
    return f"---\n{yaml.safe_dump(dict(head), sort_keys=False, allow_unicode=True)}---\n"


def _filled(page: str, name: HubName, license_name: str, picture: bool, **values: str) -> str:
    """A page with what all have."""
    said = markdown(license_name) if license_name else "not stated; ask the owner before you use it"
    short = name.repo.partition("/")[2]
    shown_picture = f"![what it looks like]({PICTURE})\n" if picture else ""
    return page.format(
        title=markdown(short), repo=name.repo, short=short, license=said, picture=shown_picture, **values
    )
