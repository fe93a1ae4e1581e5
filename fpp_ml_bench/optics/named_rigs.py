"""The rigs that this package names: the paper's, and the same with crossed fringes."""

from collections.abc import Callable
from functools import partial

from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.constants import FULL_SIZE
from fpp_ml_bench.optics.pinhole import Pinhole
from fpp_ml_bench.optics.rig import Rig

FIRST_SHIFTED_DEG = ((0.0, 0.0), (120.0, 0.0), (240.0, 0.0))
"""Phase shifts of three crossed frames: the first is the single shot; the three together shift the
first carrier and keep the second still, so that the first is also measured pixel by pixel, and
their mean holds the second."""
CROSSED = {
    "crossed-18": Crossed((18.0, 18.0), (144.6, 54.6), shifts_deg=FIRST_SHIFTED_DEG),
    "crossed-12": Crossed((12.0, 12.0), (140.0, 50.0), shifts_deg=FIRST_SHIFTED_DEG),
    "crossed-10": Crossed((10.0, 10.0), (138.1, 48.1), shifts_deg=FIRST_SHIFTED_DEG),
}
"""Crossed fringes by the name of the rig that shows them. The first carrier is turned a little from
across the epipolar lines, where its phase changes fastest with depth, and the second is square to
it. The nearest rival is 0.97, 1.22 and 1.03 rad away (with 18 px 1.73 but for the ends of the
range). With 18 px the background is 0.86 rad and more from every depth in range; with 12 and 10 px
it looks like one of them in a part of the image, where its brightness alone tells it
(docs/results/crossed.md)."""
DEFAULT_CROSSED = "crossed-12"


def paper_rig(size: int = FULL_SIZE) -> Rig:
    """The paper's rig (Table 1 and the public simulator's coordinates), its camera image ``size``
    px square."""
    focal = (
        FULL_SIZE * 50 / 20.9995
    )  # 50 cm focal length, 20.9995 cm horizontal aperture, square pixels
    centre = (FULL_SIZE - 1) / 2
    camera = Pinhole(FULL_SIZE, FULL_SIZE, focal, focal, centre, centre)
    projector = Pinhole(912, 1140, 1824.0, 1824.0, 911 / 2, 1139 / 2)
    rig = Rig(
        camera, projector, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.125, -0.1, 0.0)
    )
    return rig if size == FULL_SIZE else rig.scaled(size)


def crossed_rig(size: int = FULL_SIZE, name: str = DEFAULT_CROSSED) -> Rig:
    """The paper's rig with the frames of `CROSSED` before its own, from which the ground truth is
    decoded."""
    return paper_rig(size).with_crossed(CROSSED[name])


NAMED_RIGS: dict[str, Callable[..., Rig]] = {
    "paper": paper_rig,
    "crossed": crossed_rig,
    **{name: partial(crossed_rig, name=name) for name in CROSSED},
}
"""By the name that a command takes in place of a rig file; ``crossed`` is `DEFAULT_CROSSED`."""
