"""What the figures of a pair of carriers rest on. Imports nothing heavy: the command's help shows the defaults."""

from dataclasses import dataclass

SIGMA_PERIOD_PX = 20.0
"""Image px of the period at which a phase error is stated."""


@dataclass(frozen=True)
class Assumptions:
    """What the figures of a pair rest on.

    ``image_px``: shortest and longest period in the image; the longest also of the beats of the two carriers, since a
    window must tell their spectra from each other and from the mean light. ``phase_sigma``: error in rad of a phase
    from a single frame, at a period of `SIGMA_PERIOD_PX` in the image and in proportion to it, since the spectra of
    edges and texture fall with the frequency; it decides orders. ``blur_px``: sigma of the projector's blur, projector
    px, which takes modulation from fine periods. ``noise_grey``: the camera's noise, which alone decides the depth
    noise on smooth surfaces, with ``white_grey``, the grey level of white at the near end (falling with the square of
    the distance), and a Gaussian window of ``window_px`` (sigma, image px). ``surfaces_mm``: where surfaces are
    expected, None for anywhere in the range; a rival may be anywhere in it. ``wrong_share``: the share of wrong orders
    that may be left to the neighbours.
    """

    image_px: tuple[float, float] = (12.0, 40.0)
    phase_sigma: float = 0.2
    blur_px: float = 1.0
    noise_grey: float = 1.0
    white_grey: float = 180.0
    window_px: float = 6.0
    surfaces_mm: tuple[float, float] | None = None
    wrong_share: float = 0.0002
