"""Which pixels can still be within the working range, judged from the projector coordinate of one direction.

With both directions, a pixel gets a depth only where the two agree to ``max_disagreement_px`` across the epipolar line
and the depth is in range. The measured coordinate then lies within the interval that the range covers on its axis, or
outside by no more than the disagreement can shift it: the residuals (r_u, r_v) of the weighted fit satisfy
``w_u r_u e_u + w_v r_v e_v = 0`` for an epipolar direction e, so a distance d from the line means
``|r_u| <= d |e| / |e_v|`` for any weights (and likewise for v). A pixel farther outside gets no depth, whatever the
second direction measures, so the second direction's frames need not be read there. Own derivation.
"""

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.acceleration import numba_enabled
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.decode_blocks import DirectionPlan, Limits
from fpp_ml_bench.pinhole import Maps
from fpp_ml_bench.rig import Rig
from fpp_ml_bench.triangulation import rotated_ray

SLACK_PX = 1e-3
"""Allowance for rounding: coordinates and residuals are exact to about 1e-9 px."""


def reach_is_bounded(rig: Rig) -> bool:
    """Whether `within_reach` can rule pixels out: the bound holds for projectors without distortion."""
    return not rig.projector.is_distorted


def within_reach(
    coordinate_px: NDArray[np.float64], rays: Maps, plan: DirectionPlan, rig: Rig, limits: Limits
) -> NDArray[np.bool_]:
    """Pixels that may still get a depth from both directions; bool (n,).

    ``coordinate_px`` (n,) of the direction of ``plan``, ``rays`` the pixels' normalised (x, y), (n,) each. Pixels that
    can't be ruled out are True, those with NaN rays too.
    """
    axis = 0 if plan.direction == "vertical" else 1
    near_m, far_m = (limit / MM_PER_M for limit in rig.working_range_mm)
    if numba_enabled():
        from fpp_ml_bench.decode_kernels import reach

        device, reached = rig.projector, np.empty(len(coordinate_px), dtype=np.bool_)
        reach(
            *rays, coordinate_px, rig.R, rig.t, axis, (device.fx, device.fy), (device.cx, device.cy), (near_m, far_m),
            float(limits.max_disagreement_px), SLACK_PX, reached,
        )  # fmt: skip
        return reached
    rotated = [rotated_ray(rays, rig, i) for i in range(3)]
    with np.errstate(all="ignore"):
        projections = [_projected(rotated, depth_m, rig) for depth_m in (near_m, far_m)]
        along, across = (projections[1][i] - projections[0][i] for i in (axis, 1 - axis))
        margin = limits.max_disagreement_px * np.sqrt(along * along + across * across) / np.abs(across) + SLACK_PX
        low = np.minimum(projections[0][axis], projections[1][axis]) - margin
        high = np.maximum(projections[0][axis], projections[1][axis]) + margin
        ahead = (near_m * rotated[2] + rig.t[2] > 0) & (far_m * rotated[2] + rig.t[2] > 0)
        return ~(((coordinate_px < low) | (coordinate_px > high)) & ahead)


def _projected(rotated: list[NDArray[np.float64]], depth_m: float, rig: Rig) -> list[NDArray[np.float64]]:
    """Projector px (u, v) of the rays' points at depth ``depth_m``."""
    device, forward = rig.projector, depth_m * rotated[2] + rig.t[2]
    return [
        focal * (depth_m * rotated[i] + rig.t[i]) / forward + centre
        for i, (focal, centre) in enumerate(((device.fx, device.cx), (device.fy, device.cy)))
    ]
