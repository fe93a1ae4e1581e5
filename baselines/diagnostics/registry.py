"""The probes by name, in the order of the report; a probe's module is imported when it is asked for."""

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING

from fpp_ml_bench.errors import DiagnosisError

if TYPE_CHECKING:
    from fpp_ml_bench.baselines.diagnostics.probe import Probe

PROBES: dict[str, tuple[str, str]] = {
    "linear": ("linear", "LinearProbing"),
    "grad-cam": ("grad_cam", "GradCam"),
    "flat-plane": ("flat_plane", "FlatPlane"),
    "counterfactual": ("counterfactual", "Counterfactual"),
    "theory": ("theory", "Theory"),
}
"""Module below this package and class in it, which is made without arguments."""


def checked_names(names: Sequence[str]) -> tuple[str, ...]:
    """``names``, each once, in the order of the report; all of them for none. Raises `DiagnosisError` for one that
    there is not."""
    for name in names:
        if name not in PROBES:
            from difflib import get_close_matches

            near = get_close_matches(name, PROBES, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise DiagnosisError(f"unknown probe {name!r}; {hint}there are {', '.join(PROBES)}")
    return tuple(name for name in PROBES if not names or name in names)


def probe(name: str) -> "Probe":
    """Probe ``name``. Raises `DiagnosisError` for one that there is not."""
    checked_names([name])
    module, cls = PROBES[name]
    made: Probe = getattr(import_module(f"fpp_ml_bench.baselines.diagnostics.{module}"), cls)()
    return made
