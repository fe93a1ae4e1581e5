"""The calibration layer as a torch module: the same lines on tensors, with nothing to learn."""

import numpy as np
import torch
from torch import Tensor, nn

from fpp_ml_bench.baselines.phase_route.calibration_layer import CalibrationLayer
from fpp_ml_bench.optics import Direction, Rig


class TorchCalibrationLayer(nn.Module):
    """(wrapped phase rad, fringe order) -> depth in mm, (..., H, W) each, for one rig and fringe direction.

    Its maps are buffers that move with the module; gradients flow through depth to the phase. ``dtype`` float32 keeps a
    micrometre (the residual phase is never a difference of large numbers); float64 equals the NumPy layer to 1e-6 mm.
    Depth is not bounded: only the choice of the order respects the working range.
    """

    def __init__(self, rig: Rig, direction: Direction, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        self._constants = CalibrationLayer.of(rig, direction)
        for number, values in enumerate(self._constants.maps):
            self.register_buffer(f"map_{number}", torch.from_numpy(np.array(values)).to(dtype), persistent=False)

    def layer(self) -> CalibrationLayer:
        """The layer on this module's tensors."""
        return self._constants.with_maps(self.buffers())

    def residual_phase(self, phase_rad: Tensor, order: Tensor) -> Tensor:
        """psi in rad; see `CalibrationLayer.residual_phase`."""
        return self.layer().residual_phase(phase_rad, order)

    def forward(self, phase_rad: Tensor, order: Tensor) -> Tensor:
        """Depth in mm."""
        return self.layer().depth_mm(phase_rad, order)
