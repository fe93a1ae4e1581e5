"""``fpp-bench fuse``: an object's views in one point cloud, and the pixels that other views contradict."""

from pathlib import Path

from fpp_ml_bench.baselines import views
from fpp_ml_bench.cli.console import progress_bar, show
from fpp_ml_bench.cli.options import SPLITS, command
from fpp_ml_bench.evaluation import score
from fpp_ml_bench.files import printable
from fpp_ml_bench.loaders import storage
from fpp_ml_bench.options import REQUIRED, argument, option
from fpp_ml_bench.tables import Table


@command(
    """\
fpp-bench predict phase data/full --out predictions
fpp-bench fuse predictions data/full --out fused
fpp-bench fuse predictions data/full --object power_drill --out fused
fpp-bench fuse depth_exact data/full --out fused-exact          what the views can cover at best
"""
)
def fuse(
    *,
    predictions: str = argument(
        "predictions of a split; or depth or depth_exact, the dataset's own (a folder: ./depth)", "PREDICTIONS"
    ),
    dataset: Path = argument("folder of a generated dataset", "DATASET"),
    split: str = option("test", "split of PREDICTIONS (default: test)", choices=SPLITS),
    only: str | None = option(None, "only this object (default: all of the split)", "NAME", flag="--object"),
    cell_mm: float = option(views.CELL_MM, "edge of the cells in which points are averaged (default: 2)", "MM"),
    out: Path = option(
        REQUIRED, "folder for {object}.ply (metres, object coordinates), {object}.png and fusion.json", "DIR"
    ),
) -> None:
    """Put the views of each object into one point cloud by their known placement, and compare them with each other.

    Prints means over objects. Raises FppBenchError for unusable predictions or data."""
    opened = storage.DatasetFolder(dataset)
    name, objects = views.fuse_split(predictions, opened, split, only, cell_mm)
    scores = {}
    with progress_bar("fusing", len(views.views_by_object(opened, split, only)), "objects") as advance:
        for fused in objects:
            views.write_object(out, fused)
            scores[fused.name] = fused.scores
            advance(1)
    views.write_scores(out, name, opened, split, cell_mm, scores)
    _print(name, scores)
    print(f"{out}: {{object}}.ply, {{object}}.png, {views.FUSION_FILE}")


def _print(name: str, scores: "dict[str, views.Row]") -> None:
    """Means over objects: the clouds, the contradicted pixels, the error with and without them."""
    means = views.means(scores)
    objects = f"{len(scores)} object{'' if len(scores) == 1 else 's'}"
    near = f"within {views.WITHIN_MM:g} mm"
    columns = "distance to the surface, mm", f"points {near}", f"surface covered {near}"
    title = f"{printable(name)}: {objects}, mean and 95% interval over objects"
    table = Table("cloud", numbers=columns, title=title)
    for prefix, title in (("one", "one view"), ("all", "all views"), ("kept", "all views, consistent")):
        distance, *shares = (means[f"{prefix}_{key}"] for key in views.CLOUD_SCORES)
        table.add_row(title, _text(*distance), *(_percent(*share) for share in shares))
    show(table)
    wrong, scored, found = (
        sum(int(row[key] or 0) for row in scores.values()) for key in ("wrong_px", "scored_px", "found_px")
    )
    print(f"wrong orders: {wrong:,} of {scored:,} object pixels; other views contradict {found:,} of them")
    print(
        f"contradicted: {_percent(*means['found_share'])} of the wrong orders, {_percent(*means['false_share'])} of "
        "the others"
    )
    print(
        f"object MAE: {_text(*means['mae_mm'])} mm, without contradicted pixels {_text(*means['kept_mae_mm'])} mm "
        f"({_percent(*means['dropped_share'])} dropped)"
    )


def _percent(share: float | None, interval: "score.Interval | None") -> str:
    ends = None if interval is None else (100 * interval[0], 100 * interval[1])
    return _text(None if share is None else 100 * share, ends, "%")


def _text(mean: float | None, interval: "score.Interval | None", unit: str = "") -> str:
    """A mean with its interval, a dash for None."""
    digits = 1 if unit else 2
    ends = "" if interval is None else f" ({interval[0]:.{digits}f} to {interval[1]:.{digits}f})"
    return "-" if mean is None else f"{mean:.{digits}f}{unit}{ends}"
