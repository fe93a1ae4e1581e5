"""The probes by name, in the order of the report; a probe's module is imported on first use."""

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
    """``names`` without repeats, in the order of the report; all probes if empty. Raises `DiagnosisError` for an
    unknown name."""
    for name in names:
        if name not in PROBES:
            from difflib import get_close_matches

            suggestions = get_close_matches(name, PROBES, n=1)
            hint = f"did you mean {suggestions[0]!r}? " if suggestions else ""
            raise DiagnosisError(f"unknown probe {name!r}; {hint}there are {', '.join(PROBES)}")
    return tuple(name for name in PROBES if not names or name in names)


def probe(name: str) -> "Probe":
    """The probe ``name``. Raises `DiagnosisError` for an unknown name."""
    checked_names([name])
    module, cls = PROBES[name]
    instance: Probe = getattr(import_module(f"fpp_ml_bench.baselines.diagnostics.{module}"), cls)()
    return instance
