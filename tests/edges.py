"""How far pixels are from depth edges: what narrow bands are compared with, and where tests find
pixels inside an object."""

import cv2
import numpy as np

from fpp_ml_bench.depth import depth_edges


def edge_distance_px(depth_mm, jump_mm=None):
    """Distance of each pixel to the nearest of `depth_edges`, float32 (H, W), in px; 0 for both
    pixels beside an edge, inf in an image without edges."""
    edge = depth_edges(depth_mm, jump_mm)
    if not edge.any():
        return np.full(depth_mm.shape, np.inf, dtype=np.float32)
    distance = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance, dtype=np.float32)
