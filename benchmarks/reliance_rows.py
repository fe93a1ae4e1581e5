"""Put the phase reliance into the leaderboard's rows, for every row whose method can be built on this machine.

    fpp-bench build data/cpu224 --preset full --size 224
    fpp-bench reproduce all --preset cpu --data data/cpu224
    python benchmarks/reliance_rows.py --data data/cpu224 data/full --runs runs/cpu
    fpp-bench leaderboard --readme README.md

A network's row is measured on the data it was scored on, with the weights file whose SHA-256 it names (below ``--runs``
or shipped with the package). A classical or phase row is measured on its own data where given, else on the first
dataset of ``--data``, which the row then names. Rows that have a reliance of the same version, data (these or their
own) and weights are skipped, so an interrupted run continues. Rows of other methods, or of weights that are missing,
are named and skipped. Without ``--data`` nothing is measured, and ``--table`` writes what the rows hold.
"""

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from hashlib import blake2b, sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from fpp_ml_bench.baselines.diagnostics import VIEWS_PER_OBJECT, SceneSet, measure
from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.baselines.networks import (
    TWINS,
    Model,
    NetworkMethod,
    fringe_batch,
    load,
    probed,
    represent,
    torch_threads,
)
from fpp_ml_bench.baselines.registry import load_method, methods
from fpp_ml_bench.baselines.training import shipped_names, weights_path
from fpp_ml_bench.depth import denormalise
from fpp_ml_bench.errors import FppBenchError
from fpp_ml_bench.evaluation.report import millimetres
from fpp_ml_bench.evaluation.result import RELIANCE_VERSION
from fpp_ml_bench.files import write_atomically
from fpp_ml_bench.leaderboard.columns import reliance_interval
from fpp_ml_bench.leaderboard.measured import check_same_method, write_reliance
from fpp_ml_bench.leaderboard.rows import SHIPPED_ROWS, VOUCHED, Entry, read_entry, vouched
from fpp_ml_bench.leaderboard.tables import markdown_rows, markdown_text
from fpp_ml_bench.loaders.storage import DatasetFolder, benchmark_before, benchmark_of
from fpp_ml_bench.optics import Rig

REFUSED = 2


def weights_by_hash(runs: list[Path]) -> dict[str, Path]:
    """Every weights file of the package and below ``runs`` by its SHA-256."""
    files = [weights_path(name) for name in shipped_names()]
    below = [path for folder in runs for path in sorted(folder.glob("**/*.safetensors"))]
    files += [path for path in below if not path.name.startswith("checkpoint")]
    return {sha256(path.read_bytes()).hexdigest(): path for path in files}


class SharedAnswers:
    """A network's answers to an image in every depth range, from a single pass that all rows of the network share."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self._answers: dict[bytes, dict[str | None, NDArray[np.float32]]] = {}

    def answer(self, fringe: NDArray[np.uint8], depth_range: str | None) -> NDArray[np.float32]:
        """As `NetworkMethod.predict` in that depth range."""
        model, key = self.model, blake2b(fringe.tobytes()).digest()
        if key not in self._answers:
            batch = fringe_batch([fringe], model.config.image_size, model.config.name)
            with torch_threads(1), torch.inference_mode(), probed(model.network) as probe:
                values = represent(model.network, batch, model.config.name).float()
                answers: dict[str | None, torch.Tensor] = {"oracle": values}
                if model.config.normalisation != "individual":
                    mm = denormalise(values.numpy(), model.config.normalisation, 0.0, 0.0)
                    answers[None] = torch.from_numpy(mm.astype(np.float32))
                elif model.heads is not None:
                    answers |= {twin: model.heads.depth_mm(values, probe, twin) for twin in TWINS}
            self._answers[key] = {name: answer[0, 0].numpy() for name, answer in answers.items()}
        return self._answers[key][depth_range]


class SharingMethod(NetworkMethod):
    """A `NetworkMethod` that takes its answers from `SharedAnswers`."""

    def __init__(self, shared: SharedAnswers, depth_range: Any, frame: Any) -> None:
        super().__init__(shared.model, depth_range, frame)
        self._shared = shared

    def predict(self, frames: Sequence[NDArray[np.uint8] | None]) -> NDArray[np.float32]:
        fringe = frames[self.frame]
        if fringe is None:
            raise FppBenchError(f"{self.name} needs frame {self.frame}")
        return self._shared.answer(fringe, self.depth_range)


class Materials:
    """Datasets, weights and scenes, each opened once."""

    def __init__(self, data: list[Path], runs: list[Path], views: int) -> None:
        self.scenes = [SceneSet(DatasetFolder(folder), views) for folder in data]
        self.weights = weights_by_hash(runs)
        self._pass: tuple[str, SharedAnswers] | None = None

    def scenes_of(self, entry: Entry, anywhere: bool) -> SceneSet:
        """The scenes of the row's own data; with ``anywhere``, of the first dataset where its own is not given."""
        for scenes in self.scenes:
            if entry.row.dataset.content.items() <= scenes.dataset.content.items():
                return scenes
        if not anywhere:
            raise FppBenchError(f"its data ({entry.row.dataset.identity}) is not among --data")
        return self.scenes[0]

    def method_and_scenes(self, entry: Entry) -> tuple[Method, SceneSet]:
        """The row's method, built again, and the scenes to measure it on. FppBenchError where it can't be built."""
        about = entry.row.submission
        if about.method in methods() and methods()[about.method].trivial:
            raise FppBenchError("a trivial method: it looks at no fringe")
        if about.method in methods():
            scenes = self.scenes_of(entry, anywhere=True)
            return built(entry, scenes.dataset.rig), scenes
        weights_sha256 = about.settings.get("weights_sha256")
        if not isinstance(weights_sha256, str) or weights_sha256 not in self.weights:
            raise FppBenchError("its weights are missing" if weights_sha256 else "not a method of this package")
        scenes = self.scenes_of(entry, anywhere=False)
        if self._pass is None or self._pass[0] != weights_sha256:
            self._pass = weights_sha256, SharedAnswers(load(self.weights[weights_sha256], "cpu"))
        shared, settings = self._pass[1], about.settings
        return SharingMethod(shared, settings.get("depth_range"), settings.get("frame")), scenes


_NO_OPTIONS = {
    "weights_sha256",
    "device",
    "mask_threshold",
    "order_lead",
    "order_by_range",
    "temperature",
    "offset",
    "doubted",
}
"""Settings that describe the weights and are no options of the method; of phase-net ``shading`` is one, too."""


def built(entry: Entry, rig: Rig) -> Method:
    """The method of the package that made the row, by the row's settings, for images of ``rig``."""
    about = entry.row.submission
    described = _NO_OPTIONS | ({"shading"} if about.method == "phase-net" else set())
    options = {key: value for key, value in about.settings.items() if key not in described}
    return load_method(about.method, rig, **options)


def fill(materials: Materials, path: Path, again: bool) -> str:
    """Write the phase reliance into the row at ``path`` unless it is up to date; returns the outcome in words."""
    entry = read_entry(path)
    row_method, scenes = materials.method_and_scenes(entry)
    check_same_method(entry, row_method)
    weights = row_method.settings.get("weights_sha256")
    stored = entry.row.reliance
    if stored is not None and not again:
        before = benchmark_before(stored.dataset_fingerprint)
        known = stored.dataset_fingerprint == scenes.dataset.fingerprint or (
            before is not None and before == benchmark_of(scenes.dataset.content)
        )
        if known and (stored.version, stored.weights_sha256) == (RELIANCE_VERSION, weights):
            return f"{stored.score:.3f}, unchanged"
    started = time.perf_counter()
    reliance, _ = measure(row_method, scenes, weights if isinstance(weights, str) else None)
    before = sha256(path.read_bytes()).hexdigest()
    write_reliance(entry, reliance)
    if before in vouched():  # the same row still, with what was measured of it
        listed, after = VOUCHED.read_text(encoding="utf-8"), sha256(path.read_bytes()).hexdigest()
        write_atomically(VOUCHED, listed.replace(before, after).encode())
    low, high = reliance.interval
    return f"{reliance.score:.3f} ({low} to {high}), {time.perf_counter() - started:.1f} s"


def table(entries: list[Entry]) -> str:
    """Every row that has a phase reliance as Markdown, the highest score first."""
    titles = (
        "Row",
        "Reliance",
        "95% interval",
        "Periods aside",
        "Follows phase",
        "Follows brightness",
        "Change by outline",
        "No fringe inside",
        "No fringe outside",
        "Object MAE, mm",
        "Track",
    )
    measured = [(entry, entry.row.reliance) for entry in entries if entry.row.reliance is not None]
    measured.sort(key=lambda pair: (-pair[1].score, pair[0].name))
    lines = []
    for entry, measured_reliance in measured:
        parts = measured_reliance.parts
        values = (
            parts.follows_phase,
            parts.follows_light,
            parts.change_outline,
            parts.change_no_fringe_inside,
            parts.change_no_fringe_outside,
        )
        cells = [
            entry.name,
            f"{measured_reliance.score:.3f}",
            reliance_interval(entry),
            _two_decimals(measured_reliance.order_free_score),
        ]
        cells += [*map(_two_decimals, values), millimetres(entry.value("object_mae_mm")), entry.row.track]
        lines.append([markdown_text(cell) for cell in cells])
    right = [0 < place < len(titles) - 1 for place in range(len(titles))]
    footer = (
        "Made by `python benchmarks/reliance_rows.py --table docs/tables/reliance.md` from the rows that have a block."
    )
    return "\n".join([*markdown_rows(titles, right, lines), "", footer]) + "\n"


def _two_decimals(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__.split("\n", 1)[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--data", type=Path, nargs="+", default=[], help="dataset folders with all frames")
    parser.add_argument("--runs", type=Path, nargs="+", default=[Path("runs")], help="folders with trained weights")
    parser.add_argument("--rows", type=Path, default=SHIPPED_ROWS, help="folder of the rows")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="only these rows, by file name without .json")
    parser.add_argument("--views", type=int, default=VIEWS_PER_OBJECT, help="samples of each test object")
    parser.add_argument("--table", type=Path, metavar="FILE", help="write the rows' reliance as Markdown here")
    parser.add_argument("--again", action="store_true", help="measure all rows again")
    args = parser.parse_args()
    if not args.data and args.table is None:
        parser.error("expected --data to measure, or --table to write what the rows hold; got neither")
    paths = [path for path in sorted(args.rows.glob("*.json")) if not args.only or path.stem in args.only]
    if args.data:
        materials = Materials(args.data, args.runs, args.views)
        unmeasured = _each(paths, lambda path: fill(materials, path, args.again))
        print(f"{len(paths) - unmeasured} rows have a phase reliance, {unmeasured} do not")
    if args.table is not None:
        write_atomically(args.table, table([read_entry(path) for path in paths]).encode("utf-8"))
    return 0 if paths else REFUSED


def _each(paths: list[Path], work: Callable[[Path], str]) -> int:
    unmeasured = 0
    for path in paths:
        try:
            print(f"{path.stem}: {work(path)}", flush=True)
        except FppBenchError as error:
            unmeasured += 1
            print(f"{path.stem}: skipped, {error}", flush=True)
    return unmeasured


if __name__ == "__main__":
    sys.exit(main())
