"""Phase as further input of a network (the paper's further directions): what a fringe measures, pixel by pixel.

A fringe is demodulated by the carrier of a surface at the rig's standoff and a Gaussian window of half a period. That
gives the phase within a period, how strong the fringe is, and the depths of the orders around it, which the calibration
layer computes: the network has to choose one, not to find it.
"""

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor, nn
from torch.nn import functional

from fpp_ml_bench.baselines.phase_route import TAU, CalibrationLayer
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.errors import NetworkError
from fpp_ml_bench.optics import paper_rig

ORDERS = (-1, 0, 1)  # around the standoff's; the paper's range spans 1.9 periods
WINDOW_PERIODS = 0.5  # sigma
WEAKEST = 1e-3  # modulation of a fringe in [0, 1] that has no phase
CHANNELS = 4 + len(ORDERS)


@dataclass(frozen=True)
class _Constants:
    """``layer``, ``carrier_rad`` (H, W), ``standoff_rad`` (H, W), ``kernel`` (n,) and the working ``range_mm``."""

    layer: CalibrationLayer
    carrier_rad: Tensor
    standoff_rad: Tensor
    kernel: Tensor
    range_mm: tuple[float, float]


@lru_cache(maxsize=4)
def _constants(size: int, device: torch.device) -> _Constants:
    rig = paper_rig(size)
    layer = CalibrationLayer.of(rig, "horizontal").tensors(device=device)
    standoff = layer.residual_of_depth(rig.standoff_m * MM_PER_M)
    sigma = WINDOW_PERIODS * rig.image_px_per_period("horizontal")
    half = int(3 * sigma) + 1
    kernel = torch.exp(-0.5 * (torch.arange(-half, half + 1, device=device) / sigma) ** 2)
    return _Constants(layer, layer.infinity_rad + standoff, standoff, kernel / kernel.sum(), rig.working_range_mm)


class PhaseGuide(nn.Module):
    """A fringe (B, 1, S, S) in [0, 1], frame 0 of the paper's rig at any size, to (B, `CHANNELS`, S, S): the fringe,
    cosine and sine of its phase less the standoff's, its modulation, and the depths of `ORDERS`, from 0 at the near to
    1 at the far end of the working range. Nothing is learned. Raises `NetworkError` for an image that is not square."""

    def forward(self, fringe: Tensor) -> Tensor:
        height, width = fringe.shape[-2:]
        if height != width:
            raise NetworkError(f"guided by phase: expected a square image of the paper's rig, got {height} x {width}")
        with torch.no_grad(), torch.autocast(fringe.device.type, enabled=False):
            known, grey = _constants(width, fringe.device), fringe.float()
            parts = [grey * torch.cos(known.carrier_rad), -grey * torch.sin(known.carrier_rad)]
            real, imaginary = (_blurred(part, known.kernel) for part in parts)
            strength = torch.hypot(real, imaginary)
            cosine, sine = (part / strength.clamp_min(WEAKEST) for part in (real, imaginary))
            phase, (near_mm, far_mm) = torch.atan2(imaginary, real), known.range_mm
            depths = [known.layer.depth_of_residual_mm(known.standoff_rad + phase + TAU * order) for order in ORDERS]
            candidates = [((depth - near_mm) / (far_mm - near_mm)).clamp(0, 1) for depth in depths]
            maps = torch.cat([grey, cosine, sine, 4 * strength, *candidates], dim=1)
        return maps.to(fringe.dtype)


def _blurred(image: Tensor, kernel: Tensor) -> Tensor:
    half = len(kernel) // 2
    padded = functional.pad(image, (half, half, half, half), mode="replicate")
    across = functional.conv2d(padded, kernel.view(1, 1, 1, -1))
    return functional.conv2d(across, kernel.view(1, 1, -1, 1))


def re_projection_loss(layer: CalibrationLayer, prediction_mm: Tensor, target_mm: Tensor, nearest_mm: float) -> Tensor:
    """Mean of 1 - cos of the difference of the phases that predicted and true depth (B, 1, H, W) would show, over the
    object (target above 0); 0 without one. It does not see a whole period: as far as a fringe tells. Predictions count
    as ``nearest_mm`` and more, so that they have a phase."""
    mask = target_mm > 0
    predicted = layer.residual_of_depth(prediction_mm.clamp_min(nearest_mm))
    true = layer.residual_of_depth(torch.where(mask, target_mm, nearest_mm))
    return ((1 - torch.cos(predicted - true)) * mask).sum() / mask.sum().clamp_min(1)
