"""Lens models of camera and projector, by name, and which of their intrinsics are free."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.errors import CalibrationError

MODELS: dict[str, tuple[tuple[int, ...], int]] = {
    "none": ((), cv2.CALIB_FIX_K1 + cv2.CALIB_FIX_K2 + cv2.CALIB_FIX_K3 + cv2.CALIB_ZERO_TANGENT_DIST),
    "radial-1": ((0,), cv2.CALIB_FIX_K2 + cv2.CALIB_FIX_K3 + cv2.CALIB_ZERO_TANGENT_DIST),
    "radial-2": ((0, 1), cv2.CALIB_FIX_K3 + cv2.CALIB_ZERO_TANGENT_DIST),
    "radial-3+tangential": ((0, 1, 2, 3, 4), 0),
    "rational": ((0, 1, 2, 3, 4, 5, 6, 7), cv2.CALIB_RATIONAL_MODEL),
}
"""Free coefficients, by their place in OpenCV's (k1, k2, p1, p2, k3, k4, k5, k6), and OpenCV's flags."""


@dataclass(frozen=True)
class Lens:
    """A lens ``model`` of `MODELS`; ``square_pixels``: fx = fy; ``centred``: the principal point is the image's centre,
    ((W - 1) / 2, (H - 1) / 2). Raises `CalibrationError` for an unknown model."""

    model: str = "radial-3+tangential"
    square_pixels: bool = False
    centred: bool = False

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise CalibrationError(f"lens: expected one of {', '.join(MODELS)}, got {self.model!r}")

    def __str__(self) -> str:
        return self.model + ", fx = fy" * self.square_pixels + ", centred" * self.centred

    @property
    def coefficients(self) -> int:
        """Number of OpenCV's coefficients: 5, or 8 of the rational model."""
        return 8 if self.model == "rational" else 5

    @property
    def flags(self) -> int:
        """For cv2.calibrateCamera."""
        square = cv2.CALIB_FIX_ASPECT_RATIO * self.square_pixels
        return MODELS[self.model][1] + square + cv2.CALIB_FIX_PRINCIPAL_POINT * self.centred

    @property
    def free(self) -> NDArray[np.float64]:
        """Matrix (4 + coefficients, f) from the free parameters to (fx, fy, cx, cy, coefficients)."""
        unit = np.eye(4 + self.coefficients)
        focal = [unit[0] + unit[1]] if self.square_pixels else [unit[0], unit[1]]
        centre = [] if self.centred else [unit[2], unit[3]]
        return np.stack([*focal, *centre, *(unit[4 + i] for i in MODELS[self.model][0])], axis=1)
