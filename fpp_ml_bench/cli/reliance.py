"""``fpp-bench reliance``: how far a method's predictions follow the fringe's phase, as a score from 0 to 1."""

from pathlib import Path

from rich.text import Text

from fpp_ml_bench.baselines import diagnostics
from fpp_ml_bench.cli.console import progress_bar, show
from fpp_ml_bench.cli.methods import MethodCommand, MethodSettings
from fpp_ml_bench.cli.options import command, value
from fpp_ml_bench.evaluation import result
from fpp_ml_bench.leaderboard.measured import check_same_method, write_reliance
from fpp_ml_bench.leaderboard.rows import read_entry
from fpp_ml_bench.loaders import storage
from fpp_ml_bench.options import argument, option
from fpp_ml_bench.tables import Table


@command(
    """\
fpp-bench reliance classical data/cpu224
fpp-bench reliance phase data/cpu224 --direction vertical
fpp-bench reliance unet-individual-rmse data/cpu224 --range oracle --into result.json
""",
    MethodCommand,
)
def reliance(
    *,
    chosen: MethodSettings,
    dataset: Path = argument("dataset folder; scenes are made from its test objects", "DATASET"),
    views: int = option(
        2,
        "samples of each test object, 1 to 6 (default: 2)",
        "N",
        parse=value("1 to 6, an object has six views", int, lambda views: 1 <= views <= 6),
    ),
    into: Path | None = option(
        None, "write the score into this result or leaderboard row of the same method (.json)", "FILE"
    ),
    json: Path | None = option(None, "write the score and its parts to this file; - is standard output", "FILE"),
) -> None:
    """Measure phase reliance: does the predicted depth follow the fringe's phase, or the object's outline?

    A file that can't take the score raises FppBenchError before measuring."""
    opened = storage.DatasetFolder(dataset)
    method = chosen.load(opened)
    entry = None if into is None else read_entry(into)
    if entry is not None:
        check_same_method(entry, method)
    scene_set = diagnostics.SceneSet(opened, views)
    found = method.get("weights_sha256")
    sha256 = found if isinstance(found, str) else None
    with progress_bar(f"reliance of {chosen.name}", len(scene_set.samples), "samples") as advance:
        # Called before each sample, so the first call is for none.
        measured, _ = diagnostics.measure(method, scene_set, sha256, lambda done, total, sample: advance(min(done, 1)))
    if json is not None:
        result.write_json(measured.model_dump(mode="json"), json)
    if entry is not None:
        write_reliance(entry, measured)
    moved = [value for key, value in measured.parts if not key.startswith("answered")]
    if any(moved):
        show(_table(method.title, measured))
    else:
        print(
            f"{method.title}: gives the same answer whatever phase, light and outline of {measured.samples} samples "
            "are, so it reads nothing of them. Phase reliance 0."
        )


def _table(title: str, reliance: "result.Reliance") -> Table:
    heading = Text(f"{title}: {reliance.samples} samples of {reliance.objects} objects")
    table = Table("", numbers=("value",), title=heading)
    low, high = reliance.interval
    interval = "" if low is None or high is None else f" ({low:.2f} to {high:.2f})"
    table.add_row("phase reliance, 0 to 1", f"{reliance.score:.3f}{interval}")
    if reliance.order_free_score is not None:
        table.add_row("  whole periods aside", f"{reliance.order_free_score:.3f}")
    for key, words in result.PART_TITLES.items():
        value = getattr(reliance.parts, key)
        if value is not None:
            table.add_row(words, f"{value:.3f}")
    return table
