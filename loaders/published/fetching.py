"""A dataset of the published layout on the Hugging Face Hub: the files of it that an import reads, and downloading them
into the cache of ``huggingface_hub``, where a download that was stopped continues."""

from dataclasses import dataclass
from pathlib import Path

from huggingface_hub import constants, try_to_load_from_cache
from huggingface_hub.utils import filter_repo_objects

from fpp_ml_bench.constants import FULL_SIZE
from fpp_ml_bench.errors import LayoutError, RemoteError
from fpp_ml_bench.files import check_space
from fpp_ml_bench.loaders.hub import MARK, Hub
from fpp_ml_bench.loaders.published.importing import Source
from fpp_ml_bench.loaders.published.tree import FRINGE, INFO, RAW_SCANS, TRAINING, VARIANT_FOLDERS
from fpp_ml_bench.optics.sequence import PAPER_SEQUENCE

_SCAN_FRAMES = f"{RAW_SCANS}/*/A_*.png"
_DEPTH_BYTES = 4


@dataclass(frozen=True)
class Download:
    """What an import downloads from ``source``: ``sizes`` in bytes by name of file, those matched by ``patterns``.
    ``missing`` are those of them that ``cache`` does not hold, ``raw_scans`` the images that are left out."""

    source: Source
    patterns: tuple[str, ...]
    sizes: dict[str, int]
    missing: dict[str, int]
    raw_scans: dict[str, int]
    cache: Path


def plan_download(hub: Hub, repository: str, revision: str | None = None, raw_scans: bool = False) -> Download:
    """What an import of ``repository`` at ``revision`` (branch, tag or commit; None: its main branch) downloads: the
    depth variant that it reads, the depth ranges and, with ``raw_scans``, the frames of the raw scans. Raises
    `RemoteError` as `Hub.state`, `LayoutError` for a repository without the published layout or raw scans."""
    remote = hub.state("dataset", repository, revision)
    if not remote.exists:
        raise RemoteError(
            f"{repository}: no such folder here, and no such dataset on {hub.endpoint}, or it is private; check the "
            "name, or run 'hf auth login' with a token that may read it"
        )

    def matching(*patterns: str) -> dict[str, int]:
        names = filter_repo_objects(remote.files, allow_patterns=list(patterns))
        return {name: remote.files[name].size for name in names}

    variant = next((name for name in VARIANT_FOLDERS.values() if matching(f"{TRAINING}/{name}/*")), None)
    scans = matching(_SCAN_FRAMES)
    if variant is None:
        hint = f"expected {TRAINING}/ with one of {', '.join(VARIANT_FOLDERS.values())}"
        if MARK in remote.files:
            hint = f'it holds Parquet files, which datasets.load_dataset("{repository}") opens'
        raise LayoutError(f"{repository}: this dataset does not have the published layout; {hint}")
    if raw_scans and not scans:
        raise LayoutError(f"{repository}: has no raw scans ({RAW_SCANS}/), only the single-shot images and their depth")
    patterns = (f"{TRAINING}/{variant}/*", f"{TRAINING}/{INFO}/*", *([_SCAN_FRAMES] if raw_scans else []))
    sizes, commit = matching(*patterns), remote.commit or ""
    missing = {
        name: size
        for name, size in sizes.items()
        if not isinstance(try_to_load_from_cache(repository, name, revision=commit, repo_type="dataset"), str)
    }
    source = Source(repository, commit, (variant, *([RAW_SCANS] if raw_scans else [])))
    return Download(source, patterns, sizes, missing, {} if raw_scans else scans, Path(constants.HF_HUB_CACHE))


def fetch_tree(hub: Hub, download: Download, out: Path) -> Path:
    """Download what is missing, with the client's own progress bars; returns the folder of the tree in the cache.
    Raises `BuildError` where a disk has no space for the download and the dataset to be written to ``out``,
    `RemoteError` as `Hub.download`."""
    if download.missing:
        # The import is estimated for images of the paper's size.
        frames = len(PAPER_SEQUENCE) if RAW_SCANS in download.source.folders else 1
        samples = sum(f"/{FRINGE}/" in name for name in download.sizes)
        imported, downloaded = samples * FULL_SIZE**2 * (frames + _DEPTH_BYTES), sum(download.missing.values())
        cure = " for the download (HF_HOME) or the dataset (--out)"
        check_space({download.cache: downloaded, out: imported}, "download and import need", cure)
    return hub.download(download.source.repository, download.source.commit, list(download.patterns))
