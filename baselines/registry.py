"""STAND-IN, to be replaced by the leader's `registry` of method classes, which has the same functions: `methods`,
`find` and `load_method`. The table of variants below belongs into the classes."""

import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, make_dataclass
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any, NamedTuple

from fpp_ml_bench import baselines
from fpp_ml_bench.baselines import method as by_name
from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.baselines.trivial import TRIVIAL
from fpp_ml_bench.coding import PhaseShift
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.loaders.storage import DatasetFolder
from fpp_ml_bench.optics import DIRECTIONS, Rig
from fpp_ml_bench.optics import Sequence as FrameSequence

Options = list[dict[str, Any]]


def _classical(rig: Rig) -> Options:
    if not isinstance(rig.sequence, FrameSequence):
        return [{}] if rig.directions else []
    steps = [n for n in (3, 4, 6, 9) if n < rig.sequence.steps]
    both: Options = [{"steps": n} for n in (*steps, rig.sequence.steps)]
    return [*both, {"steps": 3, "direction": "horizontal"}, {"steps": 3, "fewest": True}]


def _phase(rig: Rig) -> Options:
    if not rig.fringe_directions:
        return []
    few: Options = [{"frames": 1}, {"frames": 3}] if rig.sequence.steps >= 3 else [{"frames": 1}]
    return [*few, {"error_mm": 3.0}] if isinstance(rig.sequence, FrameSequence) else few


def _crossed(rig: Rig) -> bool:
    return bool(rig.sequence.crossed_frames) or rig.fringe_directions == DIRECTIONS


VARIANTS: dict[str, Callable[[Rig], Options]] = {
    "classical": _classical,
    "classical-net": lambda rig: [{}] if all(isinstance(rig.code(way), PhaseShift) for way in rig.directions) else [],
    "phase": _phase,
    "phase-net": lambda rig: [{"albedo": "one"}, {"albedo": "any"}] if rig.fringe_directions else [],
    "crossed": lambda rig: [{}, {"frames": 3}][: 1 + (len(rig.sequence.crossed_frames) > 2)] if _crossed(rig) else [],
    "crossed-net": lambda rig: [{}] if _crossed(rig) else [],
    "constant": lambda rig: [{}, {"at": "training-mean"}],
}


@dataclass(frozen=True)
class StandIn:
    """What a method's class will be."""

    name: str
    make: Callable[..., Method]
    Options: type
    trivial: bool = False
    own: type[Method] | None = None

    def variants(self, rig: Rig) -> Sequence[dict[str, Any]]:
        return getattr(self.own, "variants", VARIANTS.get(self.name, lambda rig: [{}]))(rig)


class Found(NamedTuple):
    method: Any
    options: dict[str, Any]


def methods() -> dict[str, Any]:
    classes = {
        "classical": baselines.ClassicalMethod,
        "constant": baselines.ConstantMethod,
        "nearest": baselines.NearestMethod,
    }
    names = {}
    for name, make in by_name.METHODS.items():
        parameters = inspect.signature(classes[name]).parameters if name in classes else ()
        names[name] = StandIn(name, make, make_dataclass("Options", parameters), name in TRIVIAL)
    return names


def find(name: str | Path) -> Found:
    text = str(name)
    if ".py:" in text:
        path, _, of_class = text.rpartition(":")
        spec = spec_from_file_location(Path(path).stem, path)
        if spec is None or spec.loader is None or not Path(path).is_file():
            raise PredictionError(f"{path}: no such file; expected FILE.py:NAME")
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
        own = getattr(module, of_class)
        return Found(StandIn(own.name, own, make_dataclass("Options", ()), own=own), {})
    if text in methods():
        return Found(methods()[text], {})
    path = by_name.known_weights(name)

    def network(rig: Rig, **options: Any) -> Method:
        made = by_name.load_method(path, rig, **options)
        if (config := made.weights_config) and config.image_size != (size := (rig.camera.height, rig.camera.width)):
            raise PredictionError(f"{path}: was trained at {config.image_size} px, these images have {size} px")
        return made

    return Found(StandIn("network", network, make_dataclass("Options", ("threads",))), {})


def load_method(name: str | Path, source: DatasetFolder | Rig, **options: Any) -> Method:
    rig = source if isinstance(source, Rig) else source.rig
    if str(name) == "nearest" and isinstance(source, DatasetFolder):
        options = {"training": source, **options}
    method: Method = find(name).method.make(rig, **options)
    return method
