"""The registry of coding schemes, by the name that a rig file gives."""

from collections.abc import Mapping
from typing import Any

from fpp_ml_bench.coding.code import Code
from fpp_ml_bench.coding.composite import Composite
from fpp_ml_bench.coding.gray_frames import GrayOnly
from fpp_ml_bench.coding.phase_shift import PhaseShift
from fpp_ml_bench.errors import RigError

SCHEMES: dict[str, type[Code]] = {scheme.scheme: scheme for scheme in (PhaseShift, GrayOnly, Composite)}


def code_from_dict(entries: Mapping[str, Any], length_px: int, where: str) -> Code:
    """The code that a rig file's entry describes, on a pattern ``length_px`` long. Raises `RigError` naming the key."""
    if not isinstance(entries, Mapping):
        raise RigError(f"{where}: expected a mapping with the key scheme, got {entries!r}")
    scheme = entries.get("scheme")
    if not isinstance(scheme, str) or scheme not in SCHEMES:
        raise RigError(f"{where}.scheme: expected {', '.join(SCHEMES)}, got {scheme!r}")
    rest = {key: value for key, value in entries.items() if key != "scheme"}
    try:
        code: Code = SCHEMES[scheme].from_entries(rest, length_px)
        code.check(length_px)
    except RigError as error:
        raise RigError(f"{where}.{error}") from error
    return code
