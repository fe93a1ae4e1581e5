"""``fpp-bench publish``: the dataset, the leaderboard's page or results on the Hugging Face Hub."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from fpp_ml_bench.errors import PublishError

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.hub import Change, Publication, Remote
    from fpp_ml_bench.loaders.hub_client import Hub

SUMMARY = "Publish a dataset, the leaderboard's page or results on the Hugging Face Hub; sends only what changed."
EXAMPLES = (
    "fpp-bench publish dataset data/mini --repo me/fpp-mini --dry-run      what would change; sends nothing",
    "fpp-bench publish dataset data/full --repo me/fpp --staging staged    continues where an earlier run stopped",
    "fpp-bench publish leaderboard --repo me/fpp-leaderboard --dataset-repo me/fpp",
    "fpp-bench publish results result.json --repo me/my-model --dataset-repo me/fpp",
)
_SIGNS = {"new": "+", "changed": "~", "deleted": "-", "unchanged": " "}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's arguments."""
    kinds = parser.add_subparsers(dest="what", required=True, metavar="WHAT")

    dataset = _part(kinds, "dataset", "a built or imported dataset: Parquet that the Hub's viewer shows, card, meshes")
    dataset.add_argument("dataset", type=Path, metavar="DATASET", help="folder of the dataset")
    dataset.add_argument("--private", action="store_true", help="make the repository private if it is new")
    dataset.add_argument("--license", metavar="ID", help="licence on the card (default: mit; imported data needs one)")
    dataset.add_argument(
        "--staging",
        type=Path,
        metavar="DIR",
        help="put the files together in DIR and keep them, so that a later run continues (default: a temporary folder)",
    )

    page = _part(kinds, "leaderboard", "the leaderboard's page as a static Space")
    page.add_argument(
        "results", type=Path, nargs="*", metavar="RESULT.json",
        help="result or row files, or folders of them (default: the rows shipped with the package)",
    )  # fmt: skip
    page.add_argument("--page", type=Path, metavar="DIR", help="an existing page instead of results")
    page.add_argument("--private", action="store_true", help="make the Space private if it is new")
    page.add_argument("--dataset-repo", metavar="OWNER/NAME", help="dataset that the Space links to")

    results = _part(kinds, "results", "results as .eval_results/*.yaml of a model's repository", adopt=False)
    results.add_argument("results", type=Path, nargs="+", metavar="RESULT.json", help="result files of fpp-eval")
    results.add_argument(
        "--dataset-repo", required=True, metavar="OWNER/NAME", help="published dataset that the results were scored on"
    )
    results.add_argument("--source-url", metavar="URL", help="https address where the results come from")


def _part(kinds: "argparse._SubParsersAction", name: str, summary: str, adopt: bool = True) -> argparse.ArgumentParser:
    part: argparse.ArgumentParser = kinds.add_parser(
        name, help=summary, description=f"Publish {summary}.", allow_abbrev=False
    )
    part.add_argument("--repo", required=True, metavar="OWNER/NAME", help="repository on the Hub")
    part.add_argument("--dry-run", action="store_true", help="print what would change and send nothing")
    if adopt:
        part.add_argument(
            "--adopt", action="store_true", help="publish into a repository that was not filled by this command"
        )
    return part


def run(args: argparse.Namespace) -> int:
    """Publish. Raises FppBenchError for files that can't be published and for errors of the Hub or the network."""
    from fpp_ml_bench.loaders.hub_client import Hub, check_repo_name

    check_repo_name(args.repo)
    if getattr(args, "dataset_repo", None) is not None:
        check_repo_name(args.dataset_repo)
    steps: dict[str, Callable[[argparse.Namespace, Hub], int]] = {
        "dataset": _dataset, "leaderboard": _leaderboard, "results": _results,
    }  # fmt: skip
    return steps[args.what](args, Hub())


def _dataset(args: argparse.Namespace, hub: "Hub") -> int:
    from fpp_ml_bench.cli.console import progress_bar
    from fpp_ml_bench.leaderboard.publish_dataset import dataset_licence, stage_dataset
    from fpp_ml_bench.loaders.hub_staging import staging_folder
    from fpp_ml_bench.loaders.storage import DatasetFolder
    from fpp_ml_bench.machine import usable_cores

    dataset = DatasetFolder(args.dataset)
    licence = dataset_licence(dataset, args.license)
    remote = _remote(args, hub, "dataset")
    rows = sum(len(samples) for samples in dataset.splits.values())
    with staging_folder(args.staging, dataset.fingerprint) as folder:
        try:
            with progress_bar("preparing", rows, "samples") as advance:
                publication = stage_dataset(dataset, args.repo, folder, licence, usable_cores(), advance)
        except OSError as error:
            raise PublishError(
                f"can't put the files together in {folder} ({error.strerror or error}); free some space, or give a "
                "folder on another disk with --staging"
            ) from error
        return _carry_out(args, hub, publication, remote)


def _leaderboard(args: argparse.Namespace, hub: "Hub") -> int:
    from tempfile import TemporaryDirectory

    from fpp_ml_bench.leaderboard.publish_page import stage_page, write_page_of

    if args.page is not None and args.results:
        raise PublishError("expected result files or --page, got both; give one of them")
    with TemporaryDirectory(prefix="fpp-bench-publish-") as folder, TemporaryDirectory() as written:
        if args.page is None:
            write_page_of(args.results, Path(written))
        publication = stage_page(args.page or Path(written), args.repo, Path(folder), args.dataset_repo)
        return _carry_out(args, hub, publication, _remote(args, hub, "space"))


def _results(args: argparse.Namespace, hub: "Hub") -> int:
    from tempfile import TemporaryDirectory

    from fpp_ml_bench.leaderboard.publish_results import stage_results

    remote = _remote(args, hub, "model")
    dataset = hub.state("dataset", args.dataset_repo)
    published = hub.mark("dataset", args.dataset_repo, dataset)
    with TemporaryDirectory(prefix="fpp-bench-publish-") as folder:
        publication = stage_results(
            args.results, args.repo, args.dataset_repo, published, dataset.commit or "", Path(folder), args.source_url
        )
        return _carry_out(args, hub, publication, remote)


def _remote(args: argparse.Namespace, hub: "Hub", kind: str) -> "Remote":
    """The current state of the repository, after checking that token, owner and visibility allow the run."""
    names = set() if args.dry_run else hub.check_token()
    remote = hub.state(kind, args.repo)  # type: ignore[arg-type]
    if not remote.exists and kind == "model":
        raise PublishError(f"{args.repo}: no such model on {hub.endpoint}, or this token may not see it; make it first")
    if not remote.exists and not args.dry_run:
        hub.check_may_create(args.repo, names)
    if remote.exists and not remote.private and getattr(args, "private", False):
        raise PublishError(f"{args.repo}: --private was asked for, but this {kind} exists and is public")
    return remote


def _carry_out(args: argparse.Namespace, hub: "Hub", publication: "Publication", remote: "Remote") -> int:
    """Print what changes and send it, unless nothing changes or this is a dry run."""
    from fpp_ml_bench.cli.console import progress_bar
    from fpp_ml_bench.loaders.hub import changes, check_replaceable

    check_replaceable(publication, remote, getattr(args, "adopt", False))
    planned = changes(publication, remote)
    _show(args, hub, publication, remote, planned)
    if all(change.status == "unchanged" for change in planned):
        print("Nothing to send: the Hub has all files.")
        return 0
    if args.dry_run:
        print("Dry run: nothing was sent.")
        return 0
    sending = [change for change in planned if change.status in ("new", "changed")]
    with progress_bar("sending", sum(change.bytes for change in sending), "bytes") as advance:
        url = hub.send(publication, planned, remote, getattr(args, "private", False), advance)
    print(f"Published: {url}")
    return 0


def _show(
    args: argparse.Namespace, hub: "Hub", publication: "Publication", remote: "Remote", planned: "list[Change]"
) -> None:
    from fpp_ml_bench.cli.console import gigabytes
    from fpp_ml_bench.files import printable

    if remote.exists:
        visibility = "private" if remote.private else "public"
    else:
        visibility = "new, private" if getattr(args, "private", False) else "new, public"
    print(f"{publication.kind} {hub.url(publication.kind, publication.repo)} ({visibility})")
    for change in planned:
        size = gigabytes(change.bytes)
        print(f"  {_SIGNS[change.status]} {change.status:<9}  {size:>9}  {printable(change.path, 300)}")
    counts = []
    for status in _SIGNS:
        sizes = [change.bytes for change in planned if change.status == status]
        if sizes:
            counts.append(f"{len(sizes)} {status} ({gigabytes(sum(sizes))})")
    print(f"{len(planned)} files: {', '.join(counts)}")
