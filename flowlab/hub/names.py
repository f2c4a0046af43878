"""Names of repositories on the Hugging Face Hub, as people type them."""

import re
from dataclasses import dataclass
from typing import Literal, Self

from flowlab.errors import UsageError
from flowlab.text import shown

PREFIX = "hub:"
"""What a dataset begins with that is to be pulled before it is used."""
Kind = Literal["dataset", "policy"]
"""What a repository holds."""
_PART = r"[A-Za-z0-9](?:[\w.-]{0,94}[A-Za-z0-9_])?"
_REPO = re.compile(rf"{_PART}/{_PART}", re.ASCII)
_REVISION = re.compile(r"[A-Za-z0-9][\w./-]{0,199}", re.ASCII)
_COMMIT = re.compile(r"[0-9a-f]{40}")


@dataclass(frozen=True, slots=True)
class HubName:
    """A repository, and which state of it."""

    repo: str
    """``user/name``."""
    revision: str | None = None
    """A commit, a branch or a tag; None is the newest."""

    @classmethod
    def parse(cls, text: str) -> Self:
        """The name that somebody typed, with or without ``hub:``. Raises :class:`UsageError` where it is none."""
        repo, at, revision = text.removeprefix(PREFIX).partition("@")
        odd = "--" in repo or ".." in text or repo.endswith(".git")
        if odd or not _REPO.fullmatch(repo) or (at and not _REVISION.fullmatch(revision)):
            raise UsageError(
                f"{shown(text)}: is no name on the Hub, expected user/name, or user/name@REVISION with a commit, a "
                "branch or a tag"
            )
        return cls(repo, revision or None)

    @property
    def is_pinned(self) -> bool:
        """Whether it names one commit, whose content never changes."""
        return self.revision is not None and bool(_COMMIT.fullmatch(self.revision))

    @property
    def folder(self) -> str:
        """What a folder for it is called; no two repositories share it."""
        return self.repo.replace("/", "--")

    def at(self, commit: str) -> Self:
        """The same, pinned to a commit."""
        return type(self)(self.repo, commit)

    def __str__(self) -> str:
        return self.repo if self.revision is None else f"{self.repo}@{self.revision}"


def repo_type(kind: Kind) -> Literal["dataset", "model"]:
    """What the Hub calls such repositories."""
    return "dataset" if kind == "dataset" else "model"
