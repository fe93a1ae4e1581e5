"""Least squares for a projector: its thirteen numbers, which of them are free, the solution and its standard errors."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.calibration.depth_views import DepthView
from fpp_ml_bench.constants import MAD_TO_SIGMA
from fpp_ml_bench.errors import CalibrationError
from fpp_ml_bench.optics import distortion_polynomial, rotation_matrix

POSE = frozenset({"turn_x", "turn_y", "turn_z", "t_x", "t_y", "t_z"})
CENTRE, PITCH = frozenset({"c_u", "c_v"}), frozenset({"pitch_u", "pitch_v"})
NAMES = ("turn_x", "turn_y", "turn_z", "t_x", "t_y", "t_z", "focal", "aspect", "c_u", "c_v", "pitch_u", "pitch_v", "k1")
"""``turn`` a rotation vector (rad) applied after the start's rotation, t in m, ``focal`` that of u in px, ``aspect``
that of v over it, c and pitch in px, ``k1`` the first radial term of the lens."""
MOST_CONDITION = 1e7
"""Of the Jacobian with its columns scaled to equal length; the benchmark's objects give some thousands."""
_SMALLEST_PX = 1e-3
_BANDS = 16
_MOST_EVALUATIONS = 100


@dataclass(frozen=True)
class Measured:
    """The pixels of all views: points (n, 3) in m, periods and weights (2, n), and a number for each band of rows of
    each view (n,). Errors of neighbouring pixels go together; those of bands are taken as independent."""

    points_m: NDArray[np.float64]
    periods: NDArray[np.float64]
    weights: NDArray[np.float64]
    bands: NDArray[np.intp]

    def only(self, kept: NDArray[np.bool_]) -> "Measured":
        return Measured(self.points_m[kept], self.periods[:, kept], self.weights[:, kept], self.bands[kept])


def measured_in(views: list[DepthView], most_px: int) -> Measured:
    """What ``views`` measure, thinned evenly to about ``most_px`` pixels."""
    step = max(1, -(-sum(len(view.depth_mm) for view in views) // most_px))
    strength = np.concatenate([view.modulation[:, ::step] for view in views], axis=1)
    counts = [len(view.depth_mm[::step]) for view in views]
    bands = [number * _BANDS + np.arange(count) * _BANDS // max(count, 1) for number, count in enumerate(counts)]
    return Measured(
        np.concatenate([view.points_m[::step] for view in views]),
        np.concatenate([view.periods[:, ::step] for view in views], axis=1),
        strength / np.median(strength, axis=1, keepdims=True),  # the noise of a phase goes as 1 / modulation
        np.concatenate(bands),
    )


@dataclass(frozen=True)
class Projector:
    """``values`` of `NAMES` and their standard errors (0 where not fitted), the start's rotation (3, 3), and the robust
    standard deviation of the residuals in px, weighted."""

    values: dict[str, float]
    start: NDArray[np.float64]
    errors: dict[str, float]
    sigma_px: float = np.inf

    @property
    def rotation(self) -> NDArray[np.float64]:
        x, y, z = (self.values[name] for name in ("turn_x", "turn_y", "turn_z"))
        return rotation_matrix((x, y, z)) @ self.start

    def pair(self, first: str, second: str) -> tuple[float, float]:
        return self.values[first], self.values[second]

    def having(self, **values: float) -> "Projector":
        """The projector with other numbers, not fitted yet."""
        return replace(self, values=self.values | values, errors={}, sigma_px=np.inf)


def projected(points_m: NDArray[np.float64], p: Projector) -> NDArray[np.float64]:
    """Absolute phase / 2 pi of points (n, 3) in the camera's frame, (2, n)."""
    v = p.values
    x, y, z = p.rotation @ points_m.T + np.array([[v["t_x"]], [v["t_y"]], [v["t_z"]]])
    with np.errstate(all="ignore"):
        x, y = distortion_polynomial(x / z, y / z, (v["k1"], 0.0, 0.0, 0.0, 0.0))
    u, w = v["focal"] * x + v["c_u"], v["focal"] * v["aspect"] * y + v["c_v"]
    return np.stack([u / v["pitch_u"], w / v["pitch_v"]])


def refined(measured: Measured, start: Projector, free: frozenset[str]) -> Projector:
    """The projector whose ``free`` numbers fit the phases best (soft L1 loss beyond three robust standard deviations of
    the start), with standard errors that allow for errors shared within a band. Raises `CalibrationError` where the
    numbers can't be told apart."""
    from scipy.optimize import least_squares

    names = [name for name in NAMES if name in free]
    # One unit for both directions: noise is the same in periods, whatever their pitches.
    scale_px = measured.weights * float(np.mean(start.pair("pitch_u", "pitch_v")))

    def residuals_px(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
        tried = start.having(**dict(zip(names, numbers.tolist(), strict=True)))
        difference = (projected(measured.points_m, tried) - measured.periods) * scale_px
        # A step of the search that turns a point behind the projector is refused by its cost.
        return np.nan_to_num(difference, nan=1e6, posinf=1e6, neginf=-1e6).ravel()

    begin = np.array([start.values[name] for name in names])
    knee_px = max(3 * _sigma(residuals_px(begin)), _SMALLEST_PX)
    solution = least_squares(
        residuals_px,
        begin,
        jac="3-point",
        loss="soft_l1",
        f_scale=knee_px,
        x_scale="jac",
        max_nfev=_MOST_EVALUATIONS,
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
    )
    jacobian = solution.jac
    lengths = np.linalg.norm(jacobian, axis=0)
    condition = np.inf if not (lengths > 0).all() else float(np.linalg.cond(np.linalg.qr(jacobian / lengths, mode="r")))
    if condition > MOST_CONDITION:
        raise CalibrationError(
            f"the views don't tell {', '.join(names)} apart (condition {condition:.1g}); give views at more places and "
            "distances, or the pitch"
        )
    # least_squares scales the Jacobian for its loss; with these residuals, their products are the gradient's terms.
    bent = solution.fun * (1 + (solution.fun / knee_px) ** 2) ** 0.25
    terms = (jacobian * bent[:, None]).reshape(2, -1, len(names)).sum(axis=0)
    by_band = np.stack([np.bincount(measured.bands, weights=column) for column in terms.T], axis=1)
    solved = np.linalg.pinv(jacobian / lengths)
    inverse = solved @ solved.T / np.outer(lengths, lengths)
    errors = np.sqrt(np.maximum(np.diag(inverse @ (by_band.T @ by_band) @ inverse), 0.0))
    values = start.values | dict(zip(names, solution.x.tolist(), strict=True))
    return replace(
        start, values=values, errors=dict(zip(names, errors.tolist(), strict=True)), sigma_px=_sigma(solution.fun)
    )


def _sigma(values: NDArray[np.float64]) -> float:
    return MAD_TO_SIGMA * float(np.median(np.abs(values)))
