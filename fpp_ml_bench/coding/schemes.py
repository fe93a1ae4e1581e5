"""The registry of coding schemes, by the name that a rig file gives."""

from fpp_ml_bench.coding.code import Code
from fpp_ml_bench.coding.composite import Composite
from fpp_ml_bench.coding.gray_frames import GrayOnly
from fpp_ml_bench.coding.phase_shift import PhaseShift

SCHEMES: dict[str, type[Code]] = {scheme.scheme: scheme for scheme in (PhaseShift, GrayOnly, Composite)}
