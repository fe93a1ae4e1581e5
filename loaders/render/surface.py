"""How a surface returns light: a matte part, and a microfacet lobe beside it.

``f = (1 - gloss) albedo / pi + gloss D G / (4 cos_l cos_v)`` with the GGX distribution D and Smith's G (Walter et al.
2007, Microfacet Models for Refraction, equations 33 and 34), alpha the square of the roughness: a blend of a diffuse
surface and a rough mirror, as Mitsuba's ``blendbsdf`` of ``diffuse`` and ``roughconductor`` is.
"""

from math import pi

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]


def reflectance(
    cos_light: Values,
    cos_view: Values,
    cos_half: Values,
    albedo: Values | float,
    gloss: Values | float,
    roughness: float,
) -> Values:
    """pi f for unit cosines (n,) between the normal and light, view and the direction half-way; float64 (n,).

    Times the irradiance it is what a matte surface of that albedo would send: 1 for a white one.
    """
    matte = (1.0 - gloss) * albedo
    if not np.any(gloss):
        return matte + np.zeros_like(cos_light)
    squared = roughness**4
    ground = np.clip(cos_half, 0.0, 1.0) ** 2 * (squared - 1.0) + 1.0
    facets = squared / (pi * ground * ground)
    light, view = np.clip(cos_light, 1e-6, 1.0), np.clip(cos_view, 1e-6, 1.0)
    return matte + gloss * pi * facets * _unhidden(light, squared) * _unhidden(view, squared) / (4.0 * light * view)


def _unhidden(cosine: Values, squared: float) -> Values:
    """Smith's share of facets that are seen from an angle."""
    tangent = (1.0 - cosine * cosine) / (cosine * cosine)
    return 2.0 / (1.0 + np.sqrt(1.0 + squared * tangent))
