"""Commands that open a dataset: ``fpp-bench info``, ``show``, ``verify`` and ``export``."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.calibration.volume import VolumeError, volume_error_mm
from fpp_ml_bench.cli import CHECK_FAILED
from fpp_ml_bench.cli.console import gigabytes, millimetres, progress_bar, say_benchmark, show
from fpp_ml_bench.cli.options import SPLITS, command, new_file, some_of
from fpp_ml_bench.constants import MM_PER_M, VIEWS
from fpp_ml_bench.errors import BuildError, DatasetError
from fpp_ml_bench.evaluation.result.file import write_json
from fpp_ml_bench.evaluation.score.check import predicted_mm
from fpp_ml_bench.files import write_files
from fpp_ml_bench.loaders.cloud import write_cloud
from fpp_ml_bench.loaders.pictures import contact_sheet, front_picture, sample_cloud, sample_picture
from fpp_ml_bench.loaders.published.exporting import (
    FORMS,
    MAP_FORMS,
    SAMPLE_FORMS,
    chosen_splits,
)
from fpp_ml_bench.loaders.published.exporting import export as export_published
from fpp_ml_bench.loaders.render.scene import PHOTOGRAPHED_BY
from fpp_ml_bench.loaders.sample import DEPTH, DEPTH_EXACT
from fpp_ml_bench.loaders.storage.benchmark import benchmark_of, benchmark_sentence
from fpp_ml_bench.loaders.storage.card import split_statistics
from fpp_ml_bench.loaders.storage.manifest import Manifest, read_manifest
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.loaders.storage.verification import verify as verify_dataset
from fpp_ml_bench.machine import usable_cores
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.rig_file import rig_from_dict
from fpp_ml_bench.optics.sequence import Sequence
from fpp_ml_bench.options import REQUIRED, argument, option
from fpp_ml_bench.style import percent
from fpp_ml_bench.tables import Table


@command("""\
fpp-bench info data/mini
fpp-bench info data/mini --json - | jq .splits
""")
def info(
    *,
    dataset: Path = argument("dataset folder", "DATASET"),
    json: Path | None = option(
        None,
        "write all of it as JSON; - is standard output, without the table",
        "FILE",
        parse=new_file,
    ),
) -> None:
    """Print what a dataset holds: sizes, configurations, splits, rig, and how exact its ground
    truth is."""
    opened = DatasetFolder(dataset)
    benchmark = benchmark_of(opened.content)
    manifest, rig = opened.manifest, opened.rig
    statistics, error = split_statistics(manifest), _calibration_error(manifest)
    if json is not None:
        content = {
            "path": str(opened.path),
            "fingerprint": opened.fingerprint,
            "benchmark": None
            if benchmark is None
            else {"name": benchmark.name, "version": benchmark.version},
            "origin": manifest.origin,
            "size": list(opened.size),
            "configs": list(opened.configs),
            "bytes": sum(file.bytes for file in manifest.files),
            "settings": manifest.settings,
            "rig": manifest.rig,
            "calibration_error": None if error is None else error._asdict(),
            "splits": statistics[:-1],
            "all": statistics[-1],
            "samples": opened.splits,
        }
        write_json(content, json)
    groups: dict[str, int] = {}
    for shard in manifest.shards:
        groups[shard.group] = groups.get(shard.group, 0) + shard.bytes
    near, far = rig.working_range_mm
    long = ("objects", "user_meshes", PHOTOGRAPHED_BY)
    built_with = {key: value for key, value in manifest.settings.items() if key not in long}
    if isinstance(built_with.get("light"), dict):
        built_with["light"] = built_with["light"].get("name")
    generator = manifest.generator
    height, width = opened.size
    print(f"dataset         {opened.path}")
    print(
        f"origin          {manifest.origin}, by {generator.get('name')} {generator.get('version')}"
    )
    print(f"fingerprint     {opened.fingerprint}")
    print(f"benchmark       by its manifest: {benchmark_sentence(manifest)[1]}")
    print("                (fpp-bench verify reads the images)")
    print(
        f"images          {height} x {width} px, {len(opened.sequence)} frames a sequence, stored: "
        f"{manifest.stored}"
    )
    print(f"configurations  {', '.join(opened.configs)}")
    print(
        f"on disk         {', '.join(f'{name} {gigabytes(size)}' for name, size in groups.items())}"
    )
    print(f"rig             baseline {MM_PER_M * rig.baseline_m:.1f} mm, range {near:g}-{far:g} mm")
    if error is not None:
        lengths = f"{error.rms_mm:.3f} mm RMS, {error.worst_mm:.3f} mm at most"
        print(
            f"calibration     decoded with this rig, photographed by another; depths differ by "
            f"{lengths}"
        )
    for line in _fringe_lines(rig):
        print(line)
    print(f"settings        {', '.join(f'{key} {value}' for key, value in built_with.items())}")
    title = "lengths in mm, means over samples; ground-truth error: decoded - exact depth"
    table = Table(
        "", numbers=[split["split"] for split in statistics], title=title, elsewhere="--json FILE"
    )
    for row_title, cell in _ROWS:
        table.add_row(row_title, *map(cell, statistics))
    show(table)


def _calibration_error(manifest: "Manifest") -> "VolumeError | None":
    """Depth error of the stated rig over the working range, where another rig photographed."""
    photographed_by = manifest.settings.get(PHOTOGRAPHED_BY)
    if photographed_by is None:
        return None
    return volume_error_mm(rig_from_dict(manifest.rig), rig_from_dict(photographed_by))


def _fringe_lines(rig: "Rig") -> list[str]:
    """How the rig codes, and how the camera samples the fringes: the vertical ones where there are
    both."""
    ways = rig.fringe_directions
    if isinstance(rig.sequence, Sequence):
        coded = f"pitch {rig.pitch('horizontal'):g} / {rig.pitch('vertical'):g} px"
    else:
        crossed = [rig.crossed.title] if rig.crossed else []
        coded = "; ".join([*crossed, *(f"{way} {rig.code(way).title}" for way in rig.directions)])
    if not ways:
        return [f"code            {coded}"]
    periods = " / ".join(f"{rig.periods_in_range(way):.2f} {way}" for way in ways)
    sampled = f"{rig.image_px_per_period(ways[-1]):.1f} image px a period at the standoff"
    return [f"fringes         {coded}; periods in range {periods}", f"sampling        {sampled}"]


_ROWS: tuple[tuple[str, Callable[[dict[str, Any]], str]], ...] = (
    ("objects, samples", lambda s: f"{s['objects']}, {s['samples']}"),
    ("cover, mean", lambda s: percent(s["cover_mean"], 2)),
    ("cover, least-most", lambda s: f"{100 * s['cover_min']:.1f}-{100 * s['cover_max']:.1f}%"),
    ("depth range, median", lambda s: f"{s['depth_range_median_mm']:.0f}"),
    ("depth range, largest", lambda s: f"{s['depth_range_max_mm']:.0f}"),
    ("ground-truth error, MAE", lambda s: millimetres(s["gt_mae_mm"])),
    ("  RMSE", lambda s: millimetres(s["gt_rmse_mm"])),
    ("  MAE inside (3 px from edges)", lambda s: millimetres(s["gt_interior_mae_mm"])),
    ("  largest", lambda s: millimetres(s["gt_max_mm"])),
    ("pixels without ground truth", lambda s: percent(s["undecoded_share"], 2)),
)


@command("""\
fpp-bench show data/mini power_drill_A60                 writes power_drill_A60.png
fpp-bench show data/mini mug_A0 --out pictures/mug.png
fpp-bench show data/mini mug_A0 --cloud                  also mug_A0.ply, and mug_A0.html to turn it in a browser
fpp-bench show data/mini power_drill_A60 --predictions predictions --cloud    what a method made of it
fpp-bench show data/full --sheet --out sheet.png         all 50 objects x 6 views
fpp-bench show data/full --sheet --views 2               the first two views of each object
""")
def show_sample(
    *,
    dataset: Path = argument("dataset folder", "DATASET"),
    sample: str | None = argument("sample such as power_drill_A60", "SAMPLE", None),
    cloud: bool = option(
        False, "also write the points: SAMPLE.ply, and SAMPLE.html to turn in a browser"
    ),
    predictions: Path | None = option(
        None, "show the prediction in this folder, its error and its points instead", "DIR"
    ),
    sheet: bool = option(False, "all objects and views on one sheet instead"),
    split: str = option("all", "split that --sheet shows (default: all)", "SPLIT"),
    views: int = option(
        len(VIEWS), "views of each object that --sheet shows, from the first (default: all)", "N"
    ),
    out: Path | None = option(
        None, "picture to write (default: SAMPLE.png or sheet.png)", "FILE.png"
    ),
) -> None:
    """Draw one sample (frames, depth, error, mask, mesh), a prediction of it, or a contact sheet of
    all objects."""
    if sheet == (sample is not None):
        raise DatasetError(
            "expected either a SAMPLE or --sheet; `fpp-bench info DATASET --json -` lists the "
            "samples"
        )
    for flag, given in (("--cloud", cloud), ("--predictions", predictions)):
        if sheet and given:
            raise DatasetError(
                f"{flag}: expected a SAMPLE, which it shows, not --sheet; leave one of them out"
            )
    picture = out or Path("sheet.png" if sheet else f"{sample}.png")
    if picture.suffix.lower() != ".png":
        raise DatasetError(f"--out {out}: expected a file ending in .png")
    opened = DatasetFolder(dataset)
    written = [picture]
    if sample is None:
        contact_sheet(opened, split, picture, views)
    elif predictions is not None:
        written = _prediction_picture(opened, sample, predictions, picture, cloud)
    else:
        opened.split_of_sample(sample)
        sample_picture(opened, sample, picture)
        written += sample_cloud(opened, sample, picture.parent, picture.stem) if cloud else []
    print(*written, sep="\n")


def _prediction_picture(
    opened: DatasetFolder, sample: str, folder: Path, picture: Path, cloud: bool
) -> list[Path]:
    """Draw the prediction of ``sample`` in ``folder`` to ``picture``, with ``cloud`` its points
    too; the files. Raises PredictionError for predictions that could not be scored."""
    split = opened.split_of_sample(sample)
    target = DEPTH_EXACT if opened.has_exact else DEPTH
    submission, depth_mm = predicted_mm(folder, opened, split, sample, target)
    target_mm = np.where(opened.void(sample, target), 0, opened.depth_mm(sample, target))
    title = f"{sample}: {submission.name}, {opened.size[1]} x {opened.size[0]} px"
    frame = opened.frame(sample, next(iter(submission.frames_used), 0))
    drawn = front_picture(frame, depth_mm, target_mm, opened.rig, title)
    written = write_files(picture.parent, {picture.name: drawn}, DatasetError)
    if cloud:
        written += write_cloud(picture.parent, picture.stem, title, opened.rig, depth_mm, frame)
    return written


@command("""\
fpp-bench verify data/mini
fpp-bench verify data/mini && echo safe to train on
""")
def verify(
    *,
    dataset: Path = argument("dataset folder", "DATASET"),
) -> int | None:
    """Check that a dataset is intact: checksums, files, labels, split leaks, duplicated images;
    name its benchmark."""
    manifest = read_manifest(dataset)
    files = manifest.files
    with progress_bar("verifying", len(files), "files") as advance:
        findings = verify_dataset(dataset, advance)
    for finding in findings:
        print(finding)
    size = gigabytes(sum(file.bytes for file in files))
    samples = len(manifest.rows)
    if findings:
        print(f"{dataset}: {len(findings)} finding(s) in {len(files)} files, {size}")
        return CHECK_FAILED
    print(
        f"{dataset}: intact; {len(files)} files, {size}, {samples} samples, no object or image in "
        f"two splits"
    )
    print(f"fingerprint {manifest.fingerprint}")
    say_benchmark(manifest)
    return None


@command("""\
fpp-bench export data/mini --out hub --parquet              plain load_dataset opens every configuration
fpp-bench export data/mini --out tree --mat                 the published layout; fpp-bench import reads it back
fpp-bench export data/mini --out maps --maps pfm,png        depth in mm, a file a sample, as other benchmarks
fpp-bench export data/mini --out clouds --maps ply --predictions predictions --split test    of what a method made
fpp-bench export data/mini --out out --meshes --patterns    several forms: out/meshes and out/patterns
fpp-bench export data/mini --out test --parquet --split test
""")
def export(
    *,
    dataset: Path = argument("folder of the dataset", "DATASET"),
    out: Path = option(REQUIRED, "new or empty folder; written completely or not at all", "DIR"),
    parquet: bool = option(False, "Parquet and a card, ready for the Hugging Face Hub"),
    mat: bool = option(False, "the published tree: PNG fringes, .mat depth, raw scans"),
    maps: tuple[str, ...] = option(
        (),
        "depth maps, a file a sample: pfm (float32 mm), png (16 bits, png_scale.txt says the unit), "
        "ply (points in mm)",
        "A,B",
        parse=some_of(MAP_FORMS),
    ),
    predictions: Path | None = option(
        None, "with --maps: those of this folder of predictions, of one split", "DIR"
    ),
    meshes: bool = option(False, "the objects' meshes as PLY (metres)"),
    patterns: bool = option(False, "the projected patterns as PNG"),
    split: str = option("all", "samples to export (default: all)", choices=SPLITS),
) -> None:
    """Write a dataset as Parquet, the published .mat tree, depth maps, meshes or patterns.

    Raises FppBenchError for an unusable dataset, form or folder."""
    wanted = {
        "parquet": parquet,
        "mat": mat,
        "maps": maps,
        "meshes": meshes,
        "patterns": patterns,
    }
    forms = [form for form in FORMS if wanted[form]]
    if predictions is not None and (not maps or split == "all"):
        raise BuildError("--predictions: needs --maps, and --split with the split they are of")
    if not forms:
        raise BuildError(
            "nothing to export: give at least one of --parquet, --mat, --maps, --meshes, --patterns"
        )
    opened = DatasetFolder(dataset)
    splits = chosen_splits(opened, split)
    target = DEPTH_EXACT if opened.has_exact else DEPTH

    def depth_mm(sample: str) -> NDArray[Any]:
        if predictions is None:
            return opened.depth_mm(sample)
        return predicted_mm(predictions, opened, splits[0], sample, target)[1]

    samples = sum(len(opened.samples(part)) for part in splits)
    steps = samples * sum(form in SAMPLE_FORMS for form in forms)
    with progress_bar("exporting", steps, "samples") as advance:
        export_published(opened, out, forms, splits, usable_cores(), advance, maps, depth_mm)
    files = [path for path in out.rglob("*") if path.is_file()]
    size = gigabytes(sum(path.stat().st_size for path in files))
    print(f"{out}: {', '.join(forms)} of {samples} samples, {len(files):,} files, {size}")
    if "mat" in forms:
        scans = (
            "with raw scans"
            if "all" in opened.configs
            else "without raw scans: not all frames are stored"
        )
        exact = "; depth_exact has no place in the published layout" if opened.has_exact else ""
        print(f"  published layout {scans}{exact}")
