"""The calibration layer as a torch module: the same lines on tensors, with nothing to learn.

Its maps are buffers that move with the module; gradients flow through depth to the phase.
"""

import numpy as np
import torch
from torch import Tensor, nn

from fpp_ml_bench.baselines.phase_route.calibration_layer import CalibrationLayer, Lens
from fpp_ml_bench.optics import Direction, Rig


class TorchCalibrationLayer(nn.Module):
    """(wrapped phase rad, fringe order) -> depth in mm, (..., H, W) each, for one rig and fringe direction.

    ``dtype`` float32 keeps a micrometre (the residual phase is never a difference of large numbers); float64 equals the
    NumPy layer to 1e-6 mm. Depth is not bounded: only the choice of the order respects the working range.
    """

    def __init__(self, rig: Rig, direction: Direction, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        layer = CalibrationLayer.of(rig, direction)
        maps = [layer.infinity_rad, layer.infinity_order, layer.gain, layer.forward]
        names = ["infinity_rad", "infinity_order", "gain", "forward_part"]
        if layer.lens is not None:
            maps += layer.lens.rays
            names += ["ray_0", "ray_1", "ray_2"]
        for name, values in zip(names, maps, strict=True):
            self.register_buffer(name, torch.from_numpy(np.array(values)).to(dtype), persistent=False)
        self._layer = layer

    def layer(self) -> CalibrationLayer:
        """The layer on this module's tensors."""
        numbers, lens = self._layer, self._layer.lens
        if lens is not None:
            rays = (self.get_buffer("ray_0"), self.get_buffer("ray_1"), self.get_buffer("ray_2"))
            lens = Lens(rays, lens.t, lens.axis, lens.coefficients)
        maps = (self.get_buffer(name) for name in ("infinity_rad", "infinity_order", "gain", "forward_part"))
        return CalibrationLayer(*maps, numbers.back_m, numbers.rad_per_unit, lens)  # type: ignore[arg-type, call-arg]

    def residual_phase(self, phase_rad: Tensor, order: Tensor) -> Tensor:
        """psi in rad; see `CalibrationLayer.residual_phase`."""
        return self.layer().residual_phase(phase_rad, order)

    def forward(self, phase_rad: Tensor, order: Tensor) -> Tensor:
        """Depth in mm."""
        return self.layer().depth_mm(phase_rad, order)
