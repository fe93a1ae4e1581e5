"""``fpp-bench info``: what a dataset holds."""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fpp_ml_bench import calibration, optics
from fpp_ml_bench.cli.console import gigabytes, millimetres, show
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.loaders import render, storage
from fpp_ml_bench.tables import Table

SUMMARY = "What a dataset holds: sizes, configurations, splits, rig, and how exact its ground truth is."
EXAMPLES = ("fpp-bench info data/mini", "fpp-bench info data/mini --json | jq .splits")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="dataset folder")
    parser.add_argument("--json", action="store_true", help="machine-readable, on standard output")


def run(args: argparse.Namespace) -> int:
    opened = storage.DatasetFolder(args.dataset)
    benchmark = storage.benchmark_of(opened.content)
    statistics = storage.split_statistics(opened.manifest)
    if args.json:
        content = {
            "path": str(opened.path),
            "fingerprint": opened.fingerprint,
            "benchmark": None if benchmark is None else {"name": benchmark.name, "version": benchmark.version},
            "origin": opened.manifest.origin,
            "size": list(opened.size),
            "configs": list(opened.configs),
            "bytes": sum(file.bytes for file in opened.manifest.files),
            "settings": opened.manifest.settings,
            "rig": opened.manifest.rig,
            "calibration_error": None if (error := _calibration_error(opened.manifest)) is None else error._asdict(),
            "splits": statistics,
            "all": storage.whole_statistics(opened.manifest),
            "samples": opened.splits,
        }
        print(json.dumps(content, indent=1, allow_nan=False))
        return 0
    manifest, rig = opened.manifest, opened.rig
    groups: dict[str, int] = {}
    for shard in manifest.shards:
        groups[shard.group] = groups.get(shard.group, 0) + shard.bytes
    near, far = rig.working_range_mm
    long = ("objects", "user_meshes", render.PHOTOGRAPHED_BY)
    settings = {key: value for key, value in manifest.settings.items() if key not in long}
    if isinstance(settings.get("light"), dict):
        settings["light"] = settings["light"].get("name")
    generator = manifest.generator
    height, width = opened.size
    print(f"dataset         {opened.path}")
    print(f"origin          {manifest.origin}, by {generator.get('name')} {generator.get('version')}")
    print(f"fingerprint     {opened.fingerprint}")
    print(f"benchmark       by its manifest: {storage.benchmark_sentence(manifest)[1]}")
    print("                (fpp-bench verify reads the images)")
    print(f"images          {height} x {width} px, {len(opened.sequence)} frames a sequence, stored: {manifest.stored}")
    print(f"configurations  {', '.join(opened.configs)}")
    print(f"on disk         {', '.join(f'{name} {gigabytes(size)}' for name, size in groups.items())}")
    print(f"rig             baseline {MM_PER_M * rig.baseline_m:.1f} mm, range {near:g}-{far:g} mm")
    if error := _calibration_error(manifest):
        lengths = f"{error.rms_mm:.3f} mm RMS, {error.worst_mm:.3f} mm at most"
        print(f"calibration     decoded with this rig, photographed by another; depths differ by {lengths}")
    for line in _fringe_lines(rig):
        print(line)
    print(f"settings        {', '.join(f'{key} {value}' for key, value in settings.items())}")
    title = "lengths in mm, means over samples; ground-truth error: decoded - exact depth"
    statistics = [*statistics, storage.whole_statistics(manifest)]
    table = Table("", numbers=[split["split"] for split in statistics], title=title, elsewhere="--json")
    for row_title, cell in _ROWS:
        table.add_row(row_title, *map(cell, statistics))
    show(table)
    return 0


def _calibration_error(manifest: "storage.Manifest") -> "calibration.VolumeError | None":
    """Depth error of the stated rig over the working range, where another rig photographed."""
    photographed_by = manifest.settings.get(render.PHOTOGRAPHED_BY)
    if photographed_by is None:
        return None
    return calibration.volume_error_mm(optics.rig_from_dict(manifest.rig), optics.rig_from_dict(photographed_by))


def _fringe_lines(rig: "optics.Rig") -> list[str]:
    """How the rig codes, and how the camera samples the fringes: the vertical ones where there are both."""
    ways = rig.fringe_directions
    if isinstance(rig.sequence, optics.Sequence):
        coded = f"pitch {rig.pitch('horizontal'):g} / {rig.pitch('vertical'):g} px"
    else:
        crossed = [rig.crossed.title] if rig.crossed else []
        coded = "; ".join([*crossed, *(f"{way} {rig.code(way).title}" for way in rig.directions)])
    if not ways:
        return [f"code            {coded}"]
    periods = " / ".join(f"{rig.periods_in_range(way):.2f} {way}" for way in ways)
    sampled = f"{rig.image_px_per_period(ways[-1]):.1f} image px a period at the standoff"
    return [f"fringes         {coded}; periods in range {periods}", f"sampling        {sampled}"]


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.2f}%"


_ROWS: tuple[tuple[str, Callable[[dict[str, Any]], str]], ...] = (
    ("objects, samples", lambda s: f"{s['objects']}, {s['samples']}"),
    ("cover, mean", lambda s: _share(s["cover_mean"])),
    ("cover, least-most", lambda s: f"{100 * s['cover_min']:.1f}-{100 * s['cover_max']:.1f}%"),
    ("depth range, median", lambda s: f"{s['depth_range_median_mm']:.0f}"),
    ("depth range, largest", lambda s: f"{s['depth_range_max_mm']:.0f}"),
    ("ground-truth error, MAE", lambda s: millimetres(s["gt_mae_mm"])),
    ("  RMSE", lambda s: millimetres(s["gt_rmse_mm"])),
    ("  MAE inside (3 px from edges)", lambda s: millimetres(s["gt_interior_mae_mm"])),
    ("  largest", lambda s: millimetres(s["gt_max_mm"])),
    ("pixels without ground truth", lambda s: _share(s["undecoded_share"])),
)
