"""The Hub itself: whatever it, the network or a token fails at is one sentence that says what to type."""

import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from glob import escape
from itertools import islice
from pathlib import Path
from typing import Any

from flowlab.errors import DataError, FlowlabError, MissingLibraryError, UsageError, first_line
from flowlab.hub.names import HubName, Kind, repo_type
from flowlab.hub.repo_layout import MOST_FILES
from flowlab.text import shown
from flowlab.version import __version__

_LOG_IN = "log in with 'hf auth login', or set HF_TOKEN to a token of https://huggingface.co/settings/tokens"
_AGAIN = "the same command goes on where this one ended"


class HubError(FlowlabError):
    """The Hub, or the way there, does not do what it is asked for."""


@dataclass(frozen=True, slots=True)
class RepoState:
    """A repository as it is at one commit."""

    commit: str
    private: bool
    sizes: Mapping[str, int]
    """Of all of its files [bytes]."""


class HubConnection:
    """What flowlab asks of the Hub. ``HF_ENDPOINT`` says where that is, ``HF_TOKEN`` or a login who asks."""

    def __init__(self, *, quiet: bool = False) -> None:
        """``quiet`` leaves out the bars of what is on its way."""
        try:
            from huggingface_hub import HfApi
            from huggingface_hub.utils.logging import set_verbosity
            from huggingface_hub.utils.tqdm import disable_progress_bars
        except ImportError as error:
            raise MissingLibraryError(
                f"the Hub needs huggingface_hub: pip install 'flowlab[hub]' ({first_line(error)})"
            ) from error
        set_verbosity(logging.ERROR)
        if quiet:
            disable_progress_bars()
        self._api: HfApi = HfApi(
            endpoint=os.environ.get("HF_ENDPOINT"), library_name="flowlab", library_version=__version__
        )

    def url(self, name: HubName, kind: Kind) -> str:
        """Where people see a repository."""
        at = f"/tree/{name.revision}" if name.revision else ""
        return f"{self._api.endpoint}/{'datasets/' if kind == 'dataset' else ''}{name.repo}{at}"

    def find(self, name: HubName, kind: Kind) -> RepoState | None:
        """A repository at the named revision, or the newest; None where there is none, or none that may be seen."""
        from huggingface_hub.errors import GatedRepoError, RepositoryNotFoundError

        with self._told(name, kind):
            about: dict[str, Any] = {"repo_id": name.repo, "repo_type": repo_type(kind)}
            try:
                info = self._api.repo_info(revision=name.revision, **about)
            except GatedRepoError:
                raise
            except RepositoryNotFoundError:
                return None
            tree = self._api.list_repo_tree(recursive=True, revision=info.sha, **about)
            files = (entry for entry in islice(tree, 2 * MOST_FILES) if hasattr(entry, "size"))  # folders have none
            return RepoState(str(info.sha), bool(info.private), {f.path: int(f.size) for f in files})

    def download(self, name: HubName, kind: Kind, patterns: Sequence[str], folder: Path) -> None:
        """Have files of a commit in a folder; what is there already is not fetched again."""
        with self._told(name, kind):
            self._api.snapshot_download(
                name.repo,
                repo_type=repo_type(kind),
                revision=name.revision,
                local_dir=folder,
                allow_patterns=list(patterns),
            )

    def create(self, name: HubName, kind: Kind, *, private: bool) -> None:
        """Have a repository be there."""
        with self._told(name, kind):
            self._api.create_repo(name.repo, repo_type=repo_type(kind), private=private or None, exist_ok=True)

    def upload(self, name: HubName, kind: Kind, folder: Path, delete: Sequence[str]) -> str:
        """Have all files of a folder in a repository, and some others no longer; the commit that has them."""
        with self._told(name, kind):
            done = self._api.upload_folder(
                repo_id=name.repo,
                repo_type=repo_type(kind),
                folder_path=folder,
                delete_patterns=[escape(path) for path in delete],
                commit_message=f"Upload a {kind} with flowlab {__version__}",
            )
            return str(done.oid)

    @contextmanager
    def _told(self, name: HubName, kind: Kind) -> Iterator[None]:
        """Turns what fails into a sentence."""
        from huggingface_hub.errors import HfHubHTTPError

        http_error: type[Exception] = HfHubHTTPError.__bases__[0]  # of the library beneath, which versions differ in
        try:
            yield
        except FlowlabError:
            raise
        except (http_error, OSError, ValueError, LookupError, RuntimeError) as error:
            raise _explained(error, name, f"{kind} '{name.repo}'", self.url(HubName(name.repo), kind)) from error


def _explained(error: Exception, name: HubName, what: str, url: str) -> FlowlabError:
    """The sentence for an error of ``huggingface_hub`` and below."""
    from huggingface_hub import errors

    known: tuple[tuple[type[Exception], Callable[[], FlowlabError]], ...] = (
        (errors.OfflineModeIsEnabled, lambda: HubError("HF_HUB_OFFLINE is set, so nothing is looked up; unset it")),
        (errors.LocalTokenNotFoundError, lambda: HubError(f"{what}: there is no token; {_LOG_IN}")),
        (errors.GatedRepoError, lambda: HubError(f"{what}: its owner must let you in; ask at {url}, and {_LOG_IN}")),
        (errors.RepositoryNotFoundError, lambda: not_found(what)),
        (
            errors.RevisionNotFoundError,
            lambda: UsageError(f"{what}: has no revision {shown(name.revision)}; leave out '@...' for the newest"),
        ),
        (errors.HfHubHTTPError, lambda: _refused(error, what)),
    )
    for kind, sentence in known:
        if isinstance(error, kind):
            return sentence()
    cause: BaseException | None = error
    while cause is not None:  # what was wrong stands behind an error that says where else it was looked for
        if isinstance(cause, errors.HfHubHTTPError | errors.OfflineModeIsEnabled) and cause is not error:
            return _explained(cause, name, what, url)
        cause = cause.__cause__
    if isinstance(error, OSError) and error.errno is not None and error.filename is not None:
        return DataError(f"{error.filename}: cannot be written ({error.strerror}); make room, and {_AGAIN}")
    return HubError(f"{what}: the Hub cannot be reached ({first_line(error)}); look at the network, and {_AGAIN}")


def not_found(what: str) -> UsageError:
    """The error for what is not there, or is hidden, which the Hub does not tell apart."""
    return UsageError(f"{what}: there is none on the Hub, or it is private; look at its name, or {_LOG_IN}")


def _refused(error: Any, what: str) -> HubError:
    """The sentence for an answer that is none."""
    status = error.response.status_code
    said = first_line(Exception(error.server_message or error))
    if status == 401:
        return HubError(f"{what}: the Hub does not know this token; {_LOG_IN}")
    if status == 403:
        return HubError(
            f"{what}: your token may not do this ({said}); use a token that may write, and a name that is yours"
        )
    if status == 429:
        return HubError(f"{what}: the Hub was asked too often; wait some minutes, and {_AGAIN}")
    if status >= 500:
        return HubError(f"{what}: the Hub fails at the moment ({status}); wait, and {_AGAIN}")
    return HubError(f"{what}: the Hub refuses this ({said})")
