"""Methods in model repositories of the Hugging Face Hub: ``hf://OWNER/NAME`` or
``hf://OWNER/NAME@REVISION``.

A repository holds `CONFIG`, whose `KEY` says which method it is and its options; a trained network
is `WEIGHTS` beside it, where ``PyTorchModelHubMixin`` has them. Weights are safetensors, which hold
no code. Code of a repository is downloaded and run only where the user trusts it.
"""

from functools import cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import AfterValidator, Field

from fpp_ml_bench.errors import PredictionError, PublishError, RemoteError
from fpp_ml_bench.files import is_file, printable, read_json
from fpp_ml_bench.loaders.hub import Hub, check_repo_name
from fpp_ml_bench.schema import Scalar, StrictModel, Text, validate

SCHEME, REVISION = "hf://", "@"
CONFIG, KEY, WEIGHTS = "config.json", "fpp_ml_bench", "model.safetensors"
FILE_MARK = ".py:"
"""What tells ``mine.py:Mine`` from a name."""


def _no_paths(options: dict[str, Any]) -> dict[str, Any]:
    if named := sorted({"weights", "recipe"} & options.keys()):
        raise ValueError(f"{named[0]}: a repository names its file of weights beside its options")
    return options


class MethodEntry(StrictModel):
    """What `CONFIG` says of a method under `KEY`: its ``method``, a name or ``mine.py:Mine`` in
    this repository, None for a network from image to depth; and its ``options``."""

    method: Text | None = None
    options: Annotated[dict[Text, Scalar], AfterValidator(_no_paths)] = Field(default_factory=dict)
    weights: Annotated[str | None, Field(pattern=r"^[A-Za-z0-9_-]+\.safetensors$")] = None


class Fetched(NamedTuple):
    """A method as `registry.find` takes it, with its options, and where it came from."""

    name: str
    options: dict[str, Any]
    source: str


@cache
def fetched(address: str, trust: bool = False) -> Fetched:
    """Download what ``address`` needs into the client's cache; with ``trust`` its code, too. Raises
    `PredictionError` for an address that is none, a repository that holds no method, and code that
    is not trusted; `RemoteError` where the Hub gives nothing."""
    repo, _, revision = address.removeprefix(SCHEME).partition(REVISION)
    try:
        check_repo_name(repo)
    except PublishError as error:
        raise PredictionError(
            f"{printable(address, 200)}: expected hf://OWNER/NAME or hf://OWNER/NAME@REVISION"
        ) from error
    hub = Hub(sending=False)
    remote = hub.state("model", repo, revision or None)
    if remote.commit is None:
        raise RemoteError(
            f"{address}: no such model on {hub.endpoint}, or it is private; check the name, or run "
            f"'hf auth login' with a token that may read it"
        )
    source = f"{SCHEME}{repo}{REVISION}{remote.commit}"
    if CONFIG not in remote.files and WEIGHTS not in remote.files:
        raise PredictionError(
            f"{address}: holds no method: neither {CONFIG} nor {WEIGHTS}; fpp-bench publish method "
            f"makes such a repository"
        )
    folder = hub.download(repo, remote.commit, [CONFIG], "model")
    entry = _entry(folder / CONFIG)
    code = entry.method is not None and FILE_MARK in entry.method
    if code and not trust:
        raise PredictionError(
            f"{address}: its method is code, {entry.method}, which would run on this machine with "
            f"your rights; read it at {hub.url('model', repo)}, then give --trust (trust=True)"
        )
    weights = entry.weights or (WEIGHTS if WEIGHTS in remote.files else None)
    folder = hub.download(repo, remote.commit, ["*"] if code else [weights or CONFIG], "model")
    options: dict[str, Any] = dict(entry.options)
    if code:
        return Fetched(f"{folder / str(entry.method)}", options, source)
    if weights is None or not is_file(folder / weights):
        if entry.method is None:
            raise PredictionError(f"{address}: {CONFIG} names no method, and {WEIGHTS} is missing")
        return Fetched(entry.method, options, source)
    if entry.method is None:
        return Fetched(str(folder / weights), options, source)
    return Fetched(entry.method, {**options, "weights": folder / weights}, source)


def _entry(config: Path) -> MethodEntry:
    """What a repository's `CONFIG` says; nothing where there is none or it says nothing to this
    package."""
    if not is_file(config):
        return MethodEntry()
    content = read_json(config, PredictionError, "it is of a repository of the Hub")
    own = content.get(KEY, {}) if isinstance(content, dict) else {}
    return validate(MethodEntry, own, config, f"{KEY} entry", PredictionError)
