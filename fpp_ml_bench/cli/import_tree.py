"""``fpp-bench import``: a published tree, or a scanner's captures, into the dataset format."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from fpp_ml_bench.calibration.from_depth import fit_projector
from fpp_ml_bench.cli.calibrate import print_fit
from fpp_ml_bench.cli.console import contents, gigabytes, progress_bar, show
from fpp_ml_bench.cli.options import AT_LEAST_ONE, command, given
from fpp_ml_bench.coding.code import Limits, Reason
from fpp_ml_bench.constants import REPOSITORY_NAME
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders.captures.decoding import capture_notes, plan_captures
from fpp_ml_bench.loaders.captures.images import read_splits
from fpp_ml_bench.loaders.captures.real import plan_real, read_set, real_notes, set_names
from fpp_ml_bench.loaders.published.importing import (
    AGREEING_MM,
    RowReader,
    Source,
    depth_difference_mm,
    depth_reading,
    holds_whole_numbers,
    import_notes,
    import_rows,
    plan_import,
    tree_views,
)
from fpp_ml_bench.loaders.published.tree import INFO
from fpp_ml_bench.loaders.storage.assembly import Assembly
from fpp_ml_bench.loaders.storage.manifest import Manifest
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.optics.rig_file import load_rig
from fpp_ml_bench.options import REQUIRED, argument, option
from fpp_ml_bench.tables import Table

_MOST_SHOWN = 30


@dataclass(frozen=True, kw_only=True)
class CaptureSettings:
    """How captures without depth are read and decoded."""

    HEADING = "captures without depth"
    splits: Path | None = option(
        None,
        "YAML lists of objects under train, validation and test (default: all in test)",
        "FILE",
    )
    bits: int | None = option(
        None, "bits of the camera, 8 to 16 (default: found in the images)", "N"
    )
    colour: str | None = option(
        None,
        "what to take of colour images: luminance, red, green, blue or mean (default: refuse them)",
        "NAME",
    )
    min_modulation: float | None = option(
        None, "least modulation of a pixel with depth, grey levels of 255 (default: 5)", "GREY"
    )
    max_clipped_steps: int | None = option(
        None, "phase steps that may be saturated at a pixel (default: a ninth of them)", "N"
    )
    anyway: bool = option(False, "import captures that their examination refuses, too")
    max_disagreement: float | None = option(
        None,
        "largest distance of both directions' coordinates from the epipolar line (default: 1.5)",
        "PX",
    )


@dataclass(frozen=True, kw_only=True)
class HubSettings:
    """What is fetched of a dataset on the Hub."""

    HEADING = "a dataset of the Hugging Face Hub"
    revision: str | None = option(None, "branch, tag or commit (default: its main branch)", "REV")
    raw_scans: bool = option(
        False, "fetch the raw scans, too; --fit-rig and --frame-order imply it"
    )


@dataclass(frozen=True, kw_only=True)
class ImportSettings(HubSettings, CaptureSettings):
    """Settings of `import_tree`."""

    tree: Path = argument(
        "folder that holds training_datasets/, or captures; or OWNER/NAME on the Hugging Face Hub",
        "TREE",
    )
    out: Path = option(REQUIRED, "new folder, or the folder of an interrupted import", "DIR")
    workers: int | None = option(
        None, "processes (default: one per processor)", "N", parse=AT_LEAST_ONE
    )
    real: str | None = option(
        None,
        f"TREE is a copy of the repository of a set of real captures: {', '.join(set_names())}, "
        f"or a YAML file that describes another",
        "NAME",
    )
    captures: bool = option(False, "TREE holds captures, which --rig decodes into the ground truth")
    rig: Path | None = option(
        None, "rig that took the images, YAML or JSON (default: the paper's, scaled)", "FILE"
    )
    fit_rig: bool = option(
        False, "find projector and pitch from raw scans and depth (fpp-bench calibrate)"
    )
    frame_order: str = option(
        "auto", "order of the raw scans' files (default: auto, determined from the images)", "NAME"
    )
    nodata: float | None = option(
        None,
        "value of a tree's depth files where no surface is, in their unit (default: 0)",
        "VALUE",
    )


@command(
    """\
fpp-bench import aharoon/fpp-ml-bench --out data/published      fetch the published dataset and import it
fpp-bench import fpp-ml-bench --out data/published              import a copy of it in a folder
fpp-bench import fpp-ml-bench --out data/published --frame-order paper
fpp-bench import my-scans --out data/mine --rig my-rig.yaml
fpp-bench import my-scans --out data/mine --fit-rig         find the rig from frames and depth, as calibrate does
fpp-bench import my-captures --captures --out data/mine --rig my-rig.yaml --splits splits.yaml
fpp-bench import SLMaster --real slmaster --out data/real-slmaster        a clone of that repository

TREE holds training_datasets/ (training_data_depth_raw, or the global or individual variant) and, if there are
raw scans, fpp_synthetic_dataset/. The tree's split is used. If files break the layout, they are all listed and
nothing is imported. Frame orders: paper, vertical-first, by-direction, by-direction-vertical-first, with any of
+white-first, +backward-steps, +least-bit-first; the order is checked on the images.

Where there is no folder TREE, OWNER/NAME is a dataset of the Hub with the same layout. What will be downloaded is
printed first: the depth variant that is read and, with --raw-scans, the frames of the raw scans, into the cache of
huggingface_hub (HF_HOME). Run a stopped command again, and it continues.

With --captures, TREE holds a folder for each object, with a folder of frames for each view, or with the frames
of a single view: as many images as the rig's sequence has, in the order of their names. The rig decodes them
into the ground truth. splits.yaml lists the objects under train, validation and test.
"""
)
def import_tree(settings: ImportSettings) -> None:
    """Read a published tree (PNG fringes, .mat depth, raw scans), or the captures of a scanner,
    into the same dataset format as a build.

    Prints a summary. Raises FppBenchError for an unusable tree, captures, rig or folder."""
    from_hub = (
        REPOSITORY_NAME.fullmatch(str(settings.tree))
        and not settings.tree.exists()
        and not settings.captures
    )
    if (of_hub := given(settings, HubSettings)) and not from_hub:
        raise BuildError(
            f"{of_hub[0]} belongs to a dataset of the Hub, given as OWNER/NAME; {settings.tree} is "
            f"a folder"
        )
    if settings.rig is not None and settings.fit_rig:
        raise BuildError(
            "--rig and --fit-rig: the first gives the rig that the second finds; give one of them"
        )
    if settings.real is not None:
        _import_real(settings)
    elif settings.captures:
        _import_captures(settings)
    else:
        _import_tree(settings, bool(from_hub))


def _import_real(settings: ImportSettings) -> None:
    fixed = [*given(settings, CaptureSettings), *given(settings, HubSettings)]
    fixed += ["--rig"] * (settings.rig is not None) + ["--captures"] * settings.captures
    fixed += ["--fit-rig"] * settings.fit_rig + ["--nodata"] * (settings.nodata is not None)
    if settings.frame_order != "auto":
        fixed.append("--frame-order")
    if fixed:
        raise BuildError(
            f"--real: {fixed[0]} can't be changed, because the set's own file says it; leave it out"
        )
    read = read_set(str(settings.real))
    manifest, seconds = _written(settings, plan_real(read, settings.tree))
    _print_captures(manifest)
    notes = real_notes(read, manifest.settings) + capture_notes(manifest)
    _print_end(settings.out, manifest, seconds, notes)


def _import_captures(settings: ImportSettings) -> None:
    if settings.rig is None:
        raise BuildError(
            "--captures: the rig that took them is missing; give its file with --rig (fpp-bench "
            "calibrate)"
        )
    if settings.frame_order != "auto":
        raise BuildError(
            "--frame-order belongs to published trees; captures have the order of their rig's "
            "sequence"
        )
    if settings.nodata is not None:
        raise BuildError(
            "--nodata belongs to published trees; captures have no depth yet: leave it out"
        )
    options: dict[str, Any] = {
        "min_modulation": settings.min_modulation,
        "max_clipped_steps": settings.max_clipped_steps,
        "max_disagreement_px": settings.max_disagreement,
    }
    limits = Limits(**{name: value for name, value in options.items() if value is not None})
    splits = None if settings.splits is None else read_splits(settings.splits)
    plan = plan_captures(
        settings.tree,
        load_rig(settings.rig),
        splits,
        limits,
        settings.bits,
        settings.colour,
        settings.anyway,
    )
    manifest, seconds = _written(settings, plan)
    _print_captures(manifest)
    _print_end(settings.out, manifest, seconds, capture_notes(manifest))


def _written(settings: ImportSettings, plan: Assembly[RowReader]) -> tuple[Manifest, float]:
    """Write the planned dataset; its manifest, and the seconds that it took."""
    started = perf_counter()
    with progress_bar("importing", len(plan.rows.samples), "samples") as advance:
        manifest = import_rows(settings.out, plan, settings.workers or usable_cores(), advance)
    return manifest, perf_counter() - started


def _print_captures(manifest: "Manifest") -> None:
    """Print what was decoded of each capture, those with the least first where there are many."""
    rows = manifest.rows
    shown = (
        rows
        if len(rows) <= _MOST_SHOWN
        else sorted(rows, key=lambda row: row["decoded_share"])[:_MOST_SHOWN]
    )
    reasons = [reason.name.lower() for reason in Reason]
    reasons = [name for name in reasons if any(name in row["refused_share"] for row in shown)]
    more = (
        f", the {len(shown)} of {len(rows)} captures with the least decoded"
        if len(shown) < len(rows)
        else ""
    )
    titles = "decoded", "modulation", *(name.replace("_", " ") for name in reasons)
    table = Table(
        "",
        numbers=titles,
        title=f"pixels decoded, their median modulation, and pixels refused{more}",
    )
    for row in shown:
        refused = (f"{100 * row['refused_share'].get(name, 0.0):.1f}%" for name in reasons)
        table.add_row(
            row["sample"],
            f"{100 * row['decoded_share']:.1f}%",
            f"{row['median_modulation']:.1f}",
            *refused,
        )
    show(table)


def _print_end(out: Path, manifest: "Manifest", seconds: float, notes: list[str]) -> None:
    print(f"{out}: {contents(manifest)} in {seconds:.1f} s")
    for note in notes:
        print(f"  {note}")
    print(f"next: fpp-bench info {out}")


def _fetch(settings: ImportSettings) -> tuple[Path, Source]:
    """Download what the import needs of a dataset of the Hub: the folder of its tree, and where it
    is from."""
    from fpp_ml_bench.loaders.hub import (
        Hub,
        fetch_tree,
        plan_download,
    )  # imports huggingface_hub, which others don't

    hub = Hub(sending=False)
    raw_scans = settings.raw_scans or settings.fit_rig or settings.frame_order != "auto"
    download = plan_download(hub, str(settings.tree), settings.revision, raw_scans)
    source, revision = (
        download.source,
        "" if settings.revision is None else f" ({printable(settings.revision, 60)})",
    )
    print(f"{hub.url('dataset', source.repository)} at commit {source.commit}{revision}")
    print(f"  needed: {', '.join((*source.folders, INFO))}: {_amount(download.sizes)}")
    print(f"  to download: {_amount(download.missing)}, into {download.cache} (HF_HOME)")
    if download.raw_scans:
        print(
            f"  not needed: images of raw scans, {_amount(download.raw_scans)}; --raw-scans "
            f"fetches them, too"
        )
    sys.stdout.flush()  # into a file or pipe, too, it is said before the download
    return fetch_tree(hub, download, settings.out), source


def _amount(sizes: Mapping[str, int]) -> str:
    return f"{len(sizes):,} files, {gigabytes(sum(sizes.values()))}"


def _import_tree(settings: ImportSettings, from_hub: bool) -> None:
    if of_captures := given(settings, CaptureSettings):
        raise BuildError(f"{of_captures[0]} belongs to captures without depth; give --captures too")
    rig = None if settings.rig is None else load_rig(settings.rig)
    if not from_hub and REPOSITORY_NAME.fullmatch(str(settings.tree)) and settings.tree.is_dir():
        print(
            f"{settings.tree}: reading this folder, not a dataset of that name on the Hugging Face "
            f"Hub"
        )
    tree, source = _fetch(settings) if from_hub else (settings.tree, None)
    plan = plan_import(tree, rig, settings.frame_order, source, settings.nodata)
    if settings.fit_rig:
        with progress_bar("reading", len(plan.rows.samples), "views") as advance:
            views = tree_views(plan.rows, settings.workers or usable_cores(), advance)
        rig, fit = fit_projector(views, plan.rows.rig)
        print_fit(rig, fit)
        plan = plan_import(tree, rig, settings.frame_order, source, settings.nodata)
    manifest, seconds = _written(settings, plan)
    _print_end(settings.out, manifest, seconds, import_notes(manifest))
    if holds_whole_numbers(plan.rows):
        print(
            "warning: the depth files hold whole numbers, so depth is rounded; write single or "
            "double",
            file=sys.stderr,
        )
    difference_mm = depth_difference_mm(plan.rows)
    if difference_mm is None or difference_mm <= AGREEING_MM:
        return
    if reading := depth_reading(plan.rows):
        print(f"warning: {reading}", file=sys.stderr)
    elif rig is None:
        off = (
            f"{difference_mm:.1f} mm off in the median"
            if difference_mm < float("inf")
            else "none at most pixels"
        )
        print(
            f"warning: the paper's rig did not take these raw scans: the depth it decodes from the "
            f"first is {off}. "
            f"Find their rig by fpp-bench calibrate --from-depth {tree} --out rig.yaml and import "
            f"with --rig rig.yaml, "
            "or import with --fit-rig",
            file=sys.stderr,
        )
