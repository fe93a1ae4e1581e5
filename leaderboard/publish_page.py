"""Staging the leaderboard's page as a static Space: the page's files, and the README that makes it a Space."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fpp_ml_bench.baselines.tradeoff import shipped_tradeoff
from fpp_ml_bench.errors import PublishError
from fpp_ml_bench.files import printable
from fpp_ml_bench.leaderboard.page import INDEX, SUBMISSIONS, write_page
from fpp_ml_bench.leaderboard.paper import chosen_tables
from fpp_ml_bench.leaderboard.ranking import expand, rank, read_entries, shipped_rows
from fpp_ml_bench.loaders.hub import MARK, Publication, mark_bytes, staged_files

_README = "README.md"
_SUFFIXES = frozenset(
    {
        ".html",
        ".css",
        ".js",
        ".mjs",
        ".json",
        ".csv",
        ".txt",
        ".svg",
        ".png",
        ".jpg",
        ".webp",
        ".avif",
        ".ico",
        ".woff2",
    }
)
_LARGEST_BYTES = 1 << 30


def write_page_of(results: Sequence[Path], folder: Path) -> None:
    """Write the page of result and row files, or of the rows shipped with the package where none are named.

    Nothing is looked for in the current folder: what gets published is named. Raises SubmissionError for a file that is
    no sound result.
    """
    rows = expand(results) if results else shipped_rows()
    settings = None if results else shipped_tradeoff()
    write_page(rank(read_entries(rows)), chosen_tables(None), folder, settings)


def stage_page(page: Path, repo: str, folder: Path, dataset_repo: str | None = None) -> Publication:
    """Copy the page in folder ``page`` to ``folder`` and add the Space's README; ``dataset_repo`` is linked from it.

    Raises `PublishError` for a folder without ``index.html``, or with a file that belongs to no page: a Space
    publishes every file.
    """
    if not (page / INDEX).is_file():
        raise PublishError(f"{page}: expected a page with {INDEX}; write one with: fpp-bench leaderboard --page {page}")
    files = staged_files(page)
    for name, path in files.items():
        hidden = any(part.startswith(".") for part in Path(name).parts)
        if hidden or path.suffix.lower() not in _SUFFIXES or name in (_README, MARK):
            raise PublishError(
                f"{printable(str(path), 300)}: is no part of a page (expected {', '.join(sorted(_SUFFIXES))}); a Space "
                "publishes every file, so move it out"
            )
    total = sum(path.stat().st_size for path in files.values())
    if total > _LARGEST_BYTES:
        raise PublishError(f"{page}: {total:,} bytes; a static Space holds at most {_LARGEST_BYTES:,}")
    for name, path in files.items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
    (folder / _README).write_bytes(_readme(dataset_repo).encode())
    (folder / MARK).write_bytes(mark_bytes("leaderboard"))
    owned = {f"{Path(name).parts[0]}/" for name in files if "/" in name} | {f"{SUBMISSIONS}/"}
    return Publication("space", repo, folder, "FPP-ML-Bench leaderboard", tuple(sorted(owned)))


def _readme(dataset_repo: str | None) -> str:
    import yaml

    head: dict[str, Any] = {
        "title": "FPP-ML-Bench leaderboard",
        "emoji": "📐",
        "colorFrom": "blue",
        "colorTo": "gray",
        "sdk": "static",
        "app_file": INDEX,
        "pinned": False,
        "license": "mit",
        "short_description": "Depth from one fringe image: error and run time",
        "tags": ["leaderboard", "depth-estimation", "structured-light", "fpp-ml-bench"],
        **({"datasets": [dataset_repo]} if dataset_repo is not None else {}),
    }
    text = yaml.safe_dump(head, sort_keys=False, width=110, allow_unicode=True)
    return f"---\n{text}---\nThe page is `{INDEX}`, written by `fpp-bench leaderboard`, sent by `fpp-bench publish`.\n"
