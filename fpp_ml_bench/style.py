"""How the pictures look: one style for all that matplotlib draws.

Lines have colours that colour-blind readers can tell apart (Okabe and Ito, 2008, with grey in place of yellow). Each
quantity has its own colour map, in which equal steps of the quantity look equal.
"""

from collections.abc import Callable
from functools import wraps
from io import BytesIO
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FRAME_COLOURS, DEPTH_COLOURS, ERROR_COLOURS = "gray", "viridis", "coolwarm"
SIGMA_COLOURS, HEAT_COLOURS = "magma", "inferno"
"""Colour maps of grey levels, of depth, of a signed error (around 0), of a standard uncertainty or an absolute error,
and of heat maps."""
LINE_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c8c8c", "#000000")
"""Colours of lines, in this order."""
INK, SOFT, GRID = "#191c20", "#59616b", "#dfe1e5"
"""Colours of text, of what explains it, and of grids."""
DPI = 120
_STYLE: dict[Any, Any] = {
    "axes.edgecolor": SOFT,
    "axes.titlesize": 10,
    "figure.titlesize": 11,
    "font.size": 9,
    "grid.color": GRID,
    "image.cmap": DEPTH_COLOURS,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
}

Arguments = ParamSpec("Arguments")
Drawn = TypeVar("Drawn")


def styled(draw: Callable[Arguments, Drawn]) -> Callable[Arguments, Drawn]:
    """A function that draws, in this style; matplotlib's own settings stay as they were."""

    @wraps(draw)
    def in_style(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Drawn:
        from matplotlib import rc_context
        from matplotlib.rcsetup import cycler

        with rc_context(_STYLE | {"axes.prop_cycle": cycler(color=LINE_COLOURS)}):
            return draw(*args, **kwargs)

    return in_style


def figure(width_in: float, height_in: float, **settings: Any) -> "Figure":
    """An empty figure, of which nothing is cut; ``settings`` of matplotlib's ``Figure``."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), **{"dpi": DPI, "layout": "constrained", **settings})


def figure_png(drawn: "Figure", reduced: bool = False) -> bytes:
    """A figure as PNG, the same bytes each time; ``reduced`` to 256 colours, a third of the size."""
    from PIL import Image

    content, smaller = BytesIO(), BytesIO()
    drawn.savefig(content, format="png", facecolor="white", metadata={"Software": None})
    if not reduced:
        return content.getvalue()
    image = Image.open(content).convert("RGB").quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    image.save(smaller, format="png", optimize=True)
    return smaller.getvalue()
