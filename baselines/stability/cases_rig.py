"""Rig files: nearly singular intrinsics, rotations off orthonormal, lenses without an inverse at the corner."""

from fpp_ml_bench.baselines.stability import rig_checks as check
from fpp_ml_bench.baselines.stability.case import Case, family


def cases() -> list[Case]:
    """The cases of this group."""
    group = "rig"
    return [
        *family(
            group, "intrinsic matrix", check.intrinsics,
            {"centre_px": (479.5,), "focal_px": (2e3, 1.0, 1e-3, 1e-6, 1e-8, 1e-12, 1e-300, 5e-324, 1e8, 1e12, 1e300)},
            computes="pixel to ray and back", reference="the pixel",
            predicts="3 u (|u - c| + |c|) + u |u|; refused from a condition number of 2^26 on, half of the digits",
            unit="px", expects=lambda focal_px, centre_px: "number" if 1e-3 <= focal_px <= 1e8 else "either",
        ),
        *family(
            group, "far principal point", check.intrinsics, {"focal_px": (2e3,), "centre_px": (1e3, 1e6, 1e12, 1e16)},
            computes="pixel to ray and back", reference="the pixel",
            predicts="3 u (|u - c| + |c|) + u |u|; refused from a condition number of 2^26 on",
            unit="px", expects=lambda focal_px, centre_px: "number" if centre_px <= 1e6 else "either",
        ),
        *family(
            group, "rotation off orthonormal", check.off_orthonormal,
            {"kind": ("scaled", "sheared"), "off": (0.0, 1e-9, 1e-7, 9.9e-7, 1.1e-6, 1e-4, 1e-2)},
            computes="depth through this matrix", reference="depth through the rotation, 1800 mm",
            predicts="2 |R R^T - I| kappa + round-off; over 1e-6 a rig is refused", unit="relative",
            expects=lambda kind, off: "number" if off < 1e-6 else "refusal",
        ),
        *family(
            group, "rotation vector", check.rotation_vector,
            {"angle_rad": (0.0, 1e-300, 1e-12, 1e-4, 1.0, 3.141592653589793, 6.283185307179586, 1e3, 1e8, 1e12, 1e15)},
            computes="rotation matrix by Rodrigues' formula", reference="the same formula in 50 digits",
            predicts="8 u (1 + angle): the angle carries its own rounding; refused where that is over 1e-6",
            unit="1", expects=lambda angle_rad: "number" if angle_rad <= 1e8 else "either",
        ),
        *family(
            group, "lens inverse, k1", check.lens_inverse,
            {"k1": (-0.1, -0.3, -1.0, -5.0, 0.5, 5.0, 100.0), "k2": (0.0,), "k3": (0.0,)},
            computes="ideal radius of distorted ones up to 1.6", reference="bisection in 50 digits below the fold",
            predicts="32 u / slope of the model: a residual of some roundings; masked where no point maps there",
            unit="1",
        ),
        *family(
            group, "lens inverse, several terms", check.lens_inverse,
            {"k1": (-0.8, 0.6), "k2": (0.9, -1.5), "k3": (-0.3, 2.0)},
            computes="ideal radius of distorted ones up to 1.6", reference="bisection in 50 digits below the fold",
            predicts="32 u / slope of the model: a residual of some roundings; masked where no point maps there",
            unit="1",
        ),
        *family(
            group, "tangential lens", check.tangential, {"p1": (0.001, 0.01, 0.05, 0.1, 0.3)},
            computes="ideal points of a grid under tangential distortion", unit="1",
            reference="Newton continuation from the axis in 200 steps; another branch is no answer",
            predicts="32 u / least slope of the model there: a residual of some roundings", expects="either",
        ),
        *family(
            group, "lens without inverse at the corner", check.folding_camera, {"k1": (-0.1, -0.5, -2.0, -10.0)},
            computes="decoded depth where the lens model has no inverse", reference="there is none",
            predicts="must be masked", unit="mm", expects="either",
        ),
        *family(
            group, "impossible rig", check.bad_file,
            {"change": ("mirror", "zero baseline", "NaN in rotation", "infinite focal length", "zero focal length",
                        "zero matrix", "rank 2")},
            computes="a rig from a file", reference="there is no such rig", predicts="must be refused", unit="1",
            expects="refusal",
        ),
        *family(
            group, "file round trip", check.file_round_trip, {"suffix": (".yaml", ".json")},
            computes="a rig of awkward numbers, written and read", reference="the rig", predicts="exact", unit="bits",
        ),
    ]  # fmt: skip
