"""Policies on a Hugging Face hub: ``hf://USER/REPO[/NAME][@REVISION]``, two files that hold no code.

Those of a repository are ``policy.safetensors`` and ``policy.json``, or another ``NAME``. An agent wants the whole
commit for a revision: so it stays the same one, and is read from the cache without the network from then on.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from agents.learned.policy_files import MOST_BYTES
from slam.files import quoted, read_bytes

__all__ = ["PREFIX", "HubPolicy", "download", "fetch", "parse", "upload"]

PREFIX = "hf://"
_FORM = re.compile(r"hf://([\w-][\w.-]*/[\w-][\w.-]*)(?:/([\w-][\w.-]*))?(?:@([\w-][\w./-]*))?", re.ASCII)
_COMMIT = re.compile(r"[0-9a-f]{40}")
_SUFFIXES = (".safetensors", ".json")


class HubPolicy(NamedTuple):
    """Where on a hub a policy is."""

    repository: str
    name: str = "policy"
    revision: str | None = None  # a commit, branch or tag

    @property
    def files(self) -> tuple[str, str]:
        """The names of its two files, the weights first."""
        weights, about = (f"{self.name}{suffix}" for suffix in _SUFFIXES)
        return weights, about

    def __str__(self) -> str:
        name = "" if self.name == "policy" else f"/{self.name}"
        return f"{PREFIX}{self.repository}{name}" + (f"@{self.revision}" if self.revision else "")


def parse(text: str) -> HubPolicy:
    """Return what ``hf://…`` names; ``ValueError`` in one line where it is no such name."""
    match = _FORM.fullmatch(text)
    if match is None or (match[2] or "").endswith(_SUFFIXES):
        raise ValueError(f"{quoted(text, 120)} is not hf://USER/REPO[/NAME][@REVISION], NAME without its suffix")
    repository, name, revision = match.groups()
    return HubPolicy(repository, name or "policy", revision)


@cache
def fetch(text: str) -> Path:
    """Return the weights of the policy that an agent's name means, the JSON file beside them; fetched at need.

    Raises
    ------
    ValueError
        One line: the name has no commit (which one there is now is said), huggingface_hub or a file is missing,
        too large or not what the hub says it is.
    """
    policy = parse(text)
    if policy.revision is None or not _COMMIT.fullmatch(policy.revision):
        with _hub(policy) as hub:
            now = _metadata(hub, policy, policy.files[0]).commit_hash
        raise ValueError(f"{policy} may become another policy at any time; name its commit, for instance "
                         f"{policy._replace(revision=now)}")  # fmt: skip
    return download(policy)[0]


def download(policy: HubPolicy) -> tuple[Path, str]:
    """Return the path of a policy's weights, the JSON file beside them, and their commit.

    Raises
    ------
    ValueError
        As of :func:`fetch`, but for the commit.
    """
    with _hub(policy) as hub:
        commit = policy.revision or "main"
        if not _COMMIT.fullmatch(commit):
            commit = str(_metadata(hub, policy, policy.files[0]).commit_hash)
        at = policy._replace(revision=commit)
        weights, _ = (_file(hub, at, name) for name in policy.files)
    return weights, commit


def upload(weights: Path, policy: HubPolicy, *, private: bool = False) -> str:
    """Send a policy's two files, as one commit, and return that; the repository is made where there is none.

    Raises
    ------
    ValueError
        One line: what the hub says against it, or that huggingface_hub is missing.
    """
    if policy.revision is not None:
        raise ValueError(f"{policy}: a new commit has no revision yet; leave @{policy.revision} out")
    with _hub(policy) as hub:
        api = hub.HfApi()
        api.create_repo(policy.repository, private=private, exist_ok=True)
        operations = [
            hub.CommitOperationAdd(name, read_bytes(weights.with_suffix(suffix), what="policy", limit=MOST_BYTES))
            for name, suffix in zip(policy.files, _SUFFIXES, strict=True)
        ]
        made = api.create_commit(policy.repository, operations, commit_message=f"Policy {policy.name}")
    return str(made.oid)


# ---- the hub ---------------------------------------------------------------------------------------------------


@contextmanager
def _hub(policy: HubPolicy) -> Iterator[Any]:
    """Give the library; whatever it, or the network, stumbles over becomes a ``ValueError`` of one line."""
    try:
        import huggingface_hub
    except ModuleNotFoundError as error:
        raise ValueError(f"{policy} needs {error.name}; pip install 'mecanum-slam[hub]'") from error
    try:
        yield huggingface_hub
    except (KeyboardInterrupt, _Refused):
        raise
    except Exception as error:  # HTTP's, the network's, a file's
        words = quoted(" ".join(str(error).split()) or type(error).__name__, 240)[1:-1]
        raise ValueError(f"{policy}: {words}; check the name, the network and `hf auth login`") from error


class _Refused(ValueError):
    """What was found is not taken."""


def _metadata(hub: Any, policy: HubPolicy, name: str) -> Any:
    return hub.get_hf_file_metadata(hub.hf_hub_url(policy.repository, name, revision=policy.revision))


def _file(hub: Any, policy: HubPolicy, name: str) -> Path:
    """Return one file of a commit, from the cache or, at need, from the hub."""
    held = hub.try_to_load_from_cache(policy.repository, name, revision=policy.revision)
    if isinstance(held, str):
        return Path(held)
    told = _metadata(hub, policy, name)
    if told.size is None or told.size > MOST_BYTES:
        raise _Refused(f"{policy}: {name} has {told.size} bytes; a policy has at most {MOST_BYTES}")
    path = Path(hub.hf_hub_download(policy.repository, name, revision=policy.revision))
    if not _is_that(path, str(told.etag)):
        path.resolve().unlink()
        path.unlink(missing_ok=True)
        raise _Refused(f"{policy}: {name} is not what the hub says it is, by its checksum; fetch it again")
    return path


def _is_that(path: Path, etag: str) -> bool:
    """Tell whether a file has the checksum that its tag is: Git's of a small one, SHA-256 of a large one."""
    data = read_bytes(path, what="policy", limit=MOST_BYTES)
    if len(etag) == 64:
        return hashlib.sha256(data).hexdigest() == etag
    return hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest() == etag
