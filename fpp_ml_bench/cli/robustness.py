"""``fpp-bench robustness``: how a method's error grows when the scene is disturbed, axis by axis."""

import re
from pathlib import Path
from typing import Literal, NamedTuple

from fpp_ml_bench.baselines.registry import find
from fpp_ml_bench.baselines.robustness.axes import CACHE, CLEAN, SETS, Condition, severity_means
from fpp_ml_bench.baselines.robustness.run import Setup, View, write_page
from fpp_ml_bench.baselines.robustness.run import measure as measure_robustness
from fpp_ml_bench.baselines.robustness.run import robustness as robustness_block
from fpp_ml_bench.cli.console import progress_bar, show
from fpp_ml_bench.cli.methods import MethodCommand, MethodSettings
from fpp_ml_bench.cli.options import Pool, command, names
from fpp_ml_bench.constants import FULL_SIZE
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.leaderboard.rows import check_same_method, read_entry, write_block
from fpp_ml_bench.loaders.render.builder import assembly_of
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.storage.manifest import Manifest
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.optics.sequence import AnySequence
from fpp_ml_bench.options import REQUIRED, option
from fpp_ml_bench.remote import RemoteFolder, place, working_copy
from fpp_ml_bench.style import millimetres, percent
from fpp_ml_bench.tables import Table


@command(
    """\
fpp-bench robustness phase --quick --out robustness                    a look, some minutes
fpp-bench robustness phase --out robustness                            the test set, resumable axis by axis
fpp-bench robustness classical --steps 6 --set unseen --axes motion,gloss --out robustness-unseen
fpp-bench robustness phase-net --out robustness --into leaderboard/rows/phase-net-horizontal.json
fpp-bench robustness unet-global-rmse --size 224 --out robustness-224
fpp-bench robustness phase --out s3://bucket/robustness --cluster ray://head:10001
""",
    MethodCommand,
)
def robust(
    *,
    chosen: MethodSettings,
    pool: Pool,
    out: Path | RemoteFolder = option(
        REQUIRED,
        "folder of measurements: each method has its own below it, and one page shows all; or a URL",
        "DIR",
        parse=place,
    ),
    axes: tuple[str, ...] = option((), "only these axes (default: all that apply to the method)", "A,B", parse=names),
    objects: Literal["test", "unseen"] = option("test", "objects (default: test)", flag="--set"),
    size: int = option(FULL_SIZE, f"image size (default: {FULL_SIZE})", "PX"),
    quick: bool = option(False, "one view of each object and three severities, for a look"),
    into: Path | None = option(
        None, "write the block into this result or row of the same method (.json); needs all axes", "FILE"
    ),
    cache: Path | None = option(
        None, "rendered frames, at most 10 GB (default: the user's cache folder; with --cluster none)", "DIR"
    ),
    no_cache: bool = option(False, "render every frame anew, keep none"),
) -> None:
    """Measure what breaks a method: scenes disturbed axis by axis, at five severities each, in the image formation.

    A file that can't take the block raises FppBenchError before measuring."""
    workers = pool.processes
    if into is not None and (axes or quick):
        raise PredictionError("--into: needs all axes and severities; leave out --axes and --quick")
    settings = Condition(CLEAN, 0, SETS[objects], size, find(chosen.name).method.scenes_rig).settings
    method = chosen.load(Scenes.of(settings), warn=False)
    entry = None if into is None else read_entry(into)
    if entry is not None:
        check_same_method(entry, method)
    setup = Setup(method, objects, size, quick)
    # The nodes of a cluster have folders of their own, which nobody would keep small.
    cache = None if no_cache else cache or (None if pool.cluster else CACHE)
    views = sum(len(c.objects) * len(setup.views) for axis in setup.axes(axes) for c in setup.conditions(axis))
    with working_copy(out) as (below, save):
        folder = below / slug(setup)
        with progress_bar(f"{chosen.name}, {objects}", views, "views") as advance:
            rows = measure_robustness(setup, folder, axes, workers, cache, advance, pool.cluster, save)
        page = f"{out}/{write_page(below).name}"
    if entry is not None:
        write_block(entry, robustness_block(setup, rows))
    show(_table(setup, rows))
    print(f"{page}: curves of all methods measured there")


class Scenes(NamedTuple):
    """What a method is chosen for, in place of a dataset: the scenes are rendered when they are needed."""

    path: Path
    rig: Rig
    size: tuple[int, int]
    sequence: AnySequence
    manifest: Manifest

    @classmethod
    def of(cls, settings: BuildSettings) -> "Scenes":
        """The scenes that ``settings`` would build."""
        rig, manifest = settings.rig, assembly_of(settings).manifest
        return cls(Path("the robustness scenes"), rig, manifest.size, rig.sequence, manifest)


def slug(setup: Setup) -> str:
    """Name of a measurement's folder."""
    plain = re.sub(r"[^a-z0-9]+", "-", setup.method.title.casefold()).strip("-")[:80]
    return f"{plain}-{setup.set_name}-{setup.size}{'-quick' if setup.quick else ''}"


def _table(setup: Setup, rows: dict[str, list[View]]) -> Table:
    """Errors by axis, clean and at each severity; shares at the last severity."""
    severities = (0, *setup.severities)
    columns = [f"severity {severity}" if severity else "clean" for severity in severities]
    columns += ["wrong orders", "unanswered", "confident errors"]
    table = Table("axis", numbers=columns, title=f"{setup.method.title}: object MAE in mm")
    for axis, found in rows.items():
        means = severity_means(found)
        last = means[max(means)]
        cells = [millimetres(means[severity]["mae_mm"]) if severity in means else "" for severity in severities]
        shares = [percent(last[key]) for key in ("wrong_share", "unanswered_share", "confident_share")]
        table.add_row(axis, *cells, *shares)
    return table
