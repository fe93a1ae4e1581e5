"""``fpp-bench publish``: the dataset, the leaderboard's page or results on the Hugging Face Hub."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from fpp_ml_bench import leaderboard, loaders
from fpp_ml_bench.errors import PublishError
from fpp_ml_bench.files import printable
from fpp_ml_bench.machine import usable_cores

SUMMARY = "Publish a dataset, the leaderboard's page or results on the Hugging Face Hub; sends only what changed."
EXAMPLES = (
    "fpp-bench publish dataset data/mini --repo me/fpp-mini --dry-run      what would change; sends nothing",
    "fpp-bench publish dataset data/full --repo me/fpp --staging staged    continues where an earlier run stopped",
    "fpp-bench publish leaderboard --repo me/fpp-leaderboard --dataset-repo me/fpp",
    "fpp-bench publish results result.json --repo me/my-model --dataset-repo me/fpp",
)
_SIGNS = {"new": "+", "changed": "~", "deleted": "-", "unchanged": " "}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    kinds = parser.add_subparsers(dest="what", required=True, metavar="WHAT")

    add = _part(kinds, "dataset", "a built or imported dataset: Parquet that the Hub's viewer shows, card, meshes")
    add("dataset", type=Path, metavar="DATASET", help="folder of the dataset")
    add("--private", action="store_true", help="make the repository private if it is new")
    add("--license", metavar="ID", help="licence on the card (default: mit; imported data needs one)")
    add(
        "--staging",
        type=Path,
        metavar="DIR",
        help="put the files together in DIR and keep them, so that a later run continues (default: a temporary folder)",
    )

    add = _part(kinds, "leaderboard", "the leaderboard's page as a static Space")
    add(
        "results",
        type=Path,
        nargs="*",
        metavar="RESULT.json",
        help="result or row files, or folders of them (default: the rows shipped with the package)",
    )
    add("--page", type=Path, metavar="DIR", help="an existing page instead of results")
    add("--private", action="store_true", help="make the Space private if it is new")
    add("--dataset-repo", metavar="OWNER/NAME", help="dataset that the Space links to")

    add = _part(kinds, "results", "results as .eval_results/*.yaml of a model's repository", adopt=False)
    add("results", type=Path, nargs="+", metavar="RESULT.json", help="result files of fpp-eval")
    add("--dataset-repo", required=True, metavar="OWNER/NAME", help="published dataset that the results were scored on")
    add("--source-url", metavar="URL", help="https address where the results come from")


def _part(kinds: argparse._SubParsersAction, name: str, summary: str, adopt: bool = True) -> Callable[..., object]:
    add = kinds.add_parser(name, help=summary, description=f"Publish {summary}.", allow_abbrev=False).add_argument
    add("--repo", required=True, metavar="OWNER/NAME", help="repository on the Hub")
    add("--dry-run", action="store_true", help="print what would change and send nothing")
    if adopt:
        add("--adopt", action="store_true", help="publish into a repository that was not filled by this command")
    return add  # type: ignore[no-any-return]


def run(args: argparse.Namespace) -> int:
    """Publish. Raises FppBenchError for files that can't be published and for errors of the Hub or the network."""
    for repo in (args.repo, getattr(args, "dataset_repo", None)):
        if repo is not None:
            loaders.hub.check_repo_name(repo)
    steps = {"dataset": _dataset, "leaderboard": _leaderboard, "results": _results}
    return steps[args.what](args, loaders.hub.Hub())


def _dataset(args: argparse.Namespace, hub: loaders.hub.Hub) -> int:
    from fpp_ml_bench.cli.console import progress_bar  # imports rich, which --help must not

    dataset = loaders.DatasetFolder(args.dataset)
    licence = loaders.hub_dataset.dataset_licence(dataset, args.license)
    remote = _remote(args, hub, "dataset")
    texts = leaderboard.publish.dataset_texts(dataset, args.repo, licence)
    rows = sum(len(samples) for samples in dataset.splits.values())
    with loaders.hub_dataset.staging_folder(args.staging, dataset.fingerprint) as folder:
        try:
            with progress_bar("preparing", rows, "samples") as advance:
                stage = loaders.hub_dataset.stage_dataset
                publication = stage(dataset, args.repo, folder, texts, usable_cores(), advance)
        except OSError as error:
            raise PublishError(
                f"can't put the files together in {folder} ({error.strerror or error}); free some space, or give a "
                "folder on another disk with --staging"
            ) from error
        return _carry_out(args, hub, publication, remote)


def _leaderboard(args: argparse.Namespace, hub: loaders.hub.Hub) -> int:
    if args.page is not None and args.results:
        raise PublishError("expected result files or --page, got both; give one of them")
    with TemporaryDirectory(prefix="fpp-bench-publish-") as folder, TemporaryDirectory() as written:
        if args.page is None:
            leaderboard.publish.write_page_of(args.results, Path(written))
        page = args.page or Path(written)
        publication = leaderboard.publish.stage_page(page, args.repo, Path(folder), args.dataset_repo)
        return _carry_out(args, hub, publication, _remote(args, hub, "space"))


def _results(args: argparse.Namespace, hub: loaders.hub.Hub) -> int:
    remote = _remote(args, hub, "model")
    dataset = hub.state("dataset", args.dataset_repo)
    content = hub.mark("dataset", args.dataset_repo, dataset).get("content")
    scored_on = args.dataset_repo, dataset.commit or "", content, args.source_url
    with TemporaryDirectory(prefix="fpp-bench-publish-") as folder:
        publication = leaderboard.publish.stage_results(args.results, args.repo, Path(folder), *scored_on)
        return _carry_out(args, hub, publication, remote)


def _remote(args: argparse.Namespace, hub: loaders.hub.Hub, kind: loaders.hub.Kind) -> loaders.hub.Remote:
    """The current state of the repository, after checking that token, owner and visibility allow the run."""
    names = set() if args.dry_run else hub.check_token()
    remote = hub.state(kind, args.repo)
    if not remote.exists and kind == "model":
        raise PublishError(f"{args.repo}: no such model on {hub.endpoint}, or this token may not see it; make it first")
    if not remote.exists and not args.dry_run:
        hub.check_may_create(args.repo, names)
    if remote.exists and not remote.private and getattr(args, "private", False):
        raise PublishError(f"{args.repo}: --private was asked for, but this {kind} exists and is public")
    return remote


def _carry_out(
    args: argparse.Namespace, hub: loaders.hub.Hub, publication: loaders.hub.Publication, remote: loaders.hub.Remote
) -> int:
    """Print what changes and send it, unless nothing changes or this is a dry run."""
    from fpp_ml_bench.cli.console import gigabytes, progress_bar

    private = getattr(args, "private", False)
    loaders.hub.check_replaceable(publication, remote, getattr(args, "adopt", False))
    planned = loaders.hub.changes(publication, remote)
    visibility = "private" if (remote.private if remote.exists else private) else "public"
    kind = publication.kind
    print(f"{kind} {hub.url(kind, publication.repo)} ({'' if remote.exists else 'new, '}{visibility})")
    for change in planned:
        size = gigabytes(change.bytes)
        print(f"  {_SIGNS[change.status]} {change.status:<9}  {size:>9}  {printable(change.path, 300)}")
    bytes_of = {status: [change.bytes for change in planned if change.status == status] for status in _SIGNS}
    counts = [f"{len(sizes)} {status} ({gigabytes(sum(sizes))})" for status, sizes in bytes_of.items() if sizes]
    print(f"{len(planned)} files: {', '.join(counts)}")
    nothing = all(change.status == "unchanged" for change in planned)
    if nothing or args.dry_run:
        print("Nothing to send: the Hub has all files." if nothing else "Dry run: nothing was sent.")
        return 0
    with progress_bar("sending", sum(bytes_of["new"] + bytes_of["changed"]), "bytes") as advance:
        url = hub.send(publication, planned, remote, private, advance)
    print(f"Published: {url}")
    return 0
