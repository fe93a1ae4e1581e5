"""``fpp-bench publish``: the dataset, the leaderboard's page or results on the Hugging Face Hub."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from fpp_ml_bench.cli import Program
from fpp_ml_bench.cli.console import gigabytes, progress_bar
from fpp_ml_bench.cli.options import command
from fpp_ml_bench.errors import PublishError
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard import publish as board_publish
from fpp_ml_bench.loaders import hub as hub_client
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.options import REQUIRED, argument, option

publish = Program(
    "fpp-bench publish",
    "Publish a dataset, the leaderboard's page or results on the Hugging Face Hub; sends only what "
    "changed.",
    {
        "commands": {
            "dataset": (
                "publish:publish_dataset",
                "a built or imported dataset: Parquet that the Hub's viewer shows, card, meshes",
            ),
            "leaderboard": (
                "publish:publish_leaderboard",
                "the leaderboard's page as a static Space",
            ),
            "method": (
                "publish:publish_method",
                "trained weights, or a method of yours, for predict hf://OWNER/NAME",
            ),
            "results": (
                "publish:publish_results",
                "results as .eval_results/*.yaml of a model's repository",
            ),
        }
    },
    """\
fpp-bench publish dataset data/mini --repo me/fpp-mini --dry-run      what would change; sends nothing
fpp-bench publish dataset data/full --repo me/fpp --staging staged    continues where an earlier run stopped
fpp-bench publish leaderboard --repo me/fpp-leaderboard --dataset-repo me/fpp
fpp-bench publish method runs/mine/weights.safetensors --repo me/my-model
fpp-bench publish results result.json --repo me/my-model --dataset-repo me/fpp
""",
)
_SIGNS = {"new": "+", "changed": "~", "deleted": "-", "unchanged": " "}


@dataclass(frozen=True, kw_only=True)
class Repository:
    """Where to publish, and whether to."""

    private = adopt = False
    repo: str = option(
        REQUIRED, "repository on the Hub", "OWNER/NAME", parse=hub_client.check_repo_name
    )
    dry_run: bool = option(
        False, "print what would change and send nothing; works without a network, too"
    )


@dataclass(frozen=True, kw_only=True)
class FilledRepository(Repository):
    """A repository that is filled as a whole."""

    private: bool = option(False, "make the repository private if it is new")
    adopt: bool = option(False, "publish into a repository that was not filled by this command")


@command(
    """\
fpp-bench publish dataset data/mini --repo me/fpp-mini --dry-run      what would change; sends nothing
fpp-bench publish dataset data/full --repo me/fpp --staging staged    continues where an earlier run stopped
"""
)
def publish_dataset(
    *,
    dataset: Path = argument("folder of the dataset", "DATASET"),
    license: str | None = option(
        None, "licence on the card (default: mit; imported data needs one)", "ID"
    ),
    staging: Path | None = option(
        None,
        "put the files together in DIR and keep them, so that a later run continues (default: a "
        "temporary folder)",
        "DIR",
    ),
    target: FilledRepository,
) -> None:
    """Publish a built or imported dataset: Parquet that the Hub's viewer shows, card, meshes.

    Raises FppBenchError for files that can't be published and for errors of the Hub or the
    network."""
    hub = hub_client.Hub()
    opened = DatasetFolder(dataset)
    licence = hub_client.dataset_licence(opened, license)
    remote = _remote(target, hub, "dataset")
    texts = board_publish.dataset_texts(opened, target.repo, licence)
    rows = sum(len(samples) for samples in opened.splits.values())
    with hub_client.staging_folder(staging, opened.fingerprint) as folder:
        try:
            with progress_bar("preparing", rows, "samples") as advance:
                stage = hub_client.stage_dataset
                publication = stage(
                    opened, target.repo, licence, folder, texts, usable_cores(), advance
                )
        except OSError as error:
            raise PublishError(
                f"can't put the files together in {folder} ({error.strerror or error}); free some "
                f"space, or give a "
                "folder on another disk with --staging"
            ) from error
        _carry_out(target, hub, publication, remote)


@command(
    """\
fpp-bench publish leaderboard --repo me/fpp-leaderboard --dataset-repo me/fpp
"""
)
def publish_leaderboard(
    *,
    results: tuple[Path, ...] = argument(
        "result or row files, or folders of them (default: the rows shipped with the package)",
        "RESULT.json",
        (),
        many=True,
    ),
    dataset_repo: str | None = option(
        None, "dataset that the Space links to", "OWNER/NAME", parse=hub_client.check_repo_name
    ),
    target: FilledRepository,
) -> None:
    """Publish the leaderboard's page as a static Space."""
    hub = hub_client.Hub()
    with TemporaryDirectory(prefix="fpp-bench-publish-") as folder:
        publication = board_publish.stage_page(results, target.repo, Path(folder), dataset_repo)
        _carry_out(target, hub, publication, _remote(target, hub, "space"))


@command(
    """\
fpp-bench publish method runs/mine/weights.safetensors --repo me/my-model
fpp-bench publish method mine.py:Mine --repo me/my-method --dry-run
"""
)
def publish_method(
    *,
    method: str = argument(
        "weights (a name, recipe or .safetensors file), or file.py:Class", "METHOD"
    ),
    target: FilledRepository,
) -> None:
    """Publish a method as a model repository: fpp-bench predict hf://OWNER/NAME runs it."""
    hub = hub_client.Hub()
    with TemporaryDirectory(prefix="fpp-bench-publish-") as folder:
        publication = board_publish.stage_method(method, target.repo, Path(folder))
        _carry_out(target, hub, publication, _remote(target, hub, "model", new=True))


@command(
    """\
fpp-bench publish results result.json --repo me/my-model --dataset-repo me/fpp
"""
)
def publish_results(
    *,
    results: tuple[Path, ...] = argument("result files of fpp-eval", "RESULT.json", many=True),
    dataset_repo: str = option(
        REQUIRED,
        "published dataset that the results were scored on",
        "OWNER/NAME",
        parse=hub_client.check_repo_name,
    ),
    source_url: str | None = option(None, "https address where the results come from", "URL"),
    target: Repository,
) -> None:
    """Publish results as .eval_results/*.yaml of a model's repository."""
    hub = hub_client.Hub()
    remote = _remote(target, hub, "model")
    dataset = _state(target, hub, "dataset", dataset_repo)
    content = hub.mark("dataset", dataset_repo, dataset).get("content") if dataset.asked else None
    if not dataset.asked:
        print(f"The results were not compared with the content of {dataset_repo}.")
    scored_on = dataset_repo, dataset.commit, content, source_url
    with TemporaryDirectory(prefix="fpp-bench-publish-") as folder:
        publication = board_publish.stage_results(results, target.repo, Path(folder), *scored_on)
        _carry_out(target, hub, publication, remote)


def _state(
    target: Repository, hub: hub_client.Hub, kind: hub_client.Kind, repo: str
) -> hub_client.Remote:
    """The current state of ``repo``; for a dry run that can't ask the Hub, that of one with no
    files, and a note."""
    try:
        return hub.state(kind, repo)
    except hub_client.Unreachable as error:
        if not target.dry_run:
            raise
        print(f"Nothing was asked of the Hub: {error}")
        return hub_client.Remote(None, asked=False)


def _remote(
    target: Repository, hub: hub_client.Hub, kind: hub_client.Kind, new: bool = False
) -> hub_client.Remote:
    """The current state of the repository, after checking that token, owner and visibility allow
    the run; a model that is not there is made only where ``new`` says so."""
    names = set() if target.dry_run else hub.check_token()
    remote = _state(target, hub, kind, target.repo)
    if not remote.exists and kind == "model" and remote.asked and not new:
        raise PublishError(
            f"{target.repo}: no such model on {hub.endpoint}, or this token may not see it; make "
            f"it first"
        )
    if not remote.exists and not target.dry_run:
        hub.check_may_create(target.repo, names)
    if remote.exists and not remote.private and target.private:
        raise PublishError(
            f"{target.repo}: --private was asked for, but this {kind} exists and is public"
        )
    return remote


def _carry_out(
    target: Repository,
    hub: hub_client.Hub,
    publication: hub_client.Publication,
    remote: hub_client.Remote,
) -> None:
    """Print what changes and send it, unless nothing changes or this is a dry run."""
    hub_client.check_replaceable(publication, remote, target.adopt)
    planned = hub_client.changes(publication, remote)
    visibility = "private" if (remote.private if remote.exists else target.private) else "public"
    url = hub.url(publication.kind, publication.repo)
    state = (
        f"{'' if remote.exists else 'new, '}{visibility}"
        if remote.asked
        else "the Hub was not asked"
    )
    print(f"{publication.kind} {url} ({state})")
    for change in planned:
        size = gigabytes(change.bytes)
        print(
            f"  {_SIGNS[change.status]} {change.status:<9}  {size:>9}  "
            f"{printable(change.path, 300)}"
        )
    bytes_of = {
        status: [change.bytes for change in planned if change.status == status] for status in _SIGNS
    }
    counts = [
        f"{len(sizes)} {status} ({gigabytes(sum(sizes))})"
        for status, sizes in bytes_of.items()
        if sizes
    ]
    print(f"{len(planned)} files: {', '.join(counts)}")
    nothing = all(change.status == "unchanged" for change in planned)
    if nothing or target.dry_run:
        print(
            "Nothing to send: the Hub has all files." if nothing else "Dry run: nothing was sent."
        )
        if not remote.asked:
            print("The Hub was not asked which files it has, so all files are listed as new.")
        return
    with progress_bar("sending", sum(bytes_of["new"] + bytes_of["changed"]), "bytes") as advance:
        print(f"Published: {hub.send(publication, planned, remote, target.private, advance)}")
