"""How numbers, pictures and pages look: one style for all that matplotlib draws, one frame for all
that browsers show.

Lines have colours that colour-blind readers can tell apart (Okabe and Ito, 2008, with grey in place
of yellow). Each quantity has its own colour map, in which equal steps of the quantity look equal.

A page contains its style, script and pictures. Its Content-Security-Policy allows only the style
and the script with the given hashes: the page sends no request, and an injected script can't run.
Text from a submission stays text.
"""

import hashlib
import html
import textwrap
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, wraps
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np

from fpp_ml_bench.files import NAME_LIMIT, printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

FRAME_COLOURS, DEPTH_COLOURS, ERROR_COLOURS = "gray", "viridis", "coolwarm"
SIGMA_COLOURS, HEAT_COLOURS = "magma", "inferno"
"""Colour maps of grey levels, of depth, of a signed error (around 0), of a standard uncertainty or
an absolute error, and of heat maps."""
LINE_COLOURS = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
    "#56b4e9",
    "#8c8c8c",
    "#000000",
)
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


@contextmanager
def own_settings(settings: dict[Any, Any]) -> Iterator[None]:
    """Draw within by matplotlib's defaults and ``settings``: a user's own settings change nothing,
    and are as before afterwards. A dollar sign in a name is no formula."""
    from matplotlib import rc_context, rcParamsDefault

    defaults: dict[Any, Any] = {
        key: value for key, value in rcParamsDefault.items() if not key.startswith("backend")
    }
    with rc_context(defaults | {"text.parse_math": False} | settings):
        yield


def styled(draw: Callable[Arguments, Drawn]) -> Callable[Arguments, Drawn]:
    """A function that draws, in this style, as `own_settings`."""

    @wraps(draw)
    def in_style(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Drawn:
        from matplotlib.rcsetup import cycler

        with own_settings(_STYLE | {"axes.prop_cycle": cycler(color=LINE_COLOURS)}):
            return draw(*args, **kwargs)

    return in_style


def figure(width_in: float, height_in: float, **settings: Any) -> "Figure":
    """An empty figure, of which nothing is cut; ``settings`` of matplotlib's ``Figure``."""
    from matplotlib.figure import Figure

    return Figure(
        figsize=(width_in, height_in), **{"dpi": DPI, "layout": "constrained", **settings}
    )


@styled
def figure_png(drawn: "Figure", reduced: bool = False) -> bytes:
    """A figure as PNG, the same bytes each time; ``reduced`` to 256 colours, a third of the
    size."""
    from matplotlib.ticker import LogFormatterMathtext
    from PIL import Image

    for axes in drawn.axes:
        for axis in (axes.xaxis, axes.yaxis):
            if isinstance(
                axis.get_major_formatter(), LogFormatterMathtext
            ):  # a formula, which is no text here
                axis.set_major_formatter("{x:g}")
                axis.set_minor_formatter("")
    content, smaller = BytesIO(), BytesIO()
    drawn.savefig(content, format="png", facecolor="white", metadata={"Software": None})
    if not reduced:
        return content.getvalue()
    image = (
        Image.open(content)
        .convert("RGB")
        .quantize(256, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    )
    image.save(smaller, format="png", optimize=True)
    return smaller.getvalue()


LINE = {"markersize": 4, "linewidth": 1.2}
_GAP = 4  # px between two pictures
_LETTERS_AN_INCH, _HANDLE_INCHES = 14, 0.65  # of a legend: its letters, and the line before them


@dataclass(frozen=True)
class Picture:
    """A map (H, W) from ``low`` to ``high`` (default: its largest value) in matplotlib's
    ``colours``; NaN is white."""

    image: "NDArray[Any]"
    colours: str = FRAME_COLOURS
    low: float = 0.0
    high: float | None = None

    def rgb(self) -> "NDArray[Any]":
        """Float (H, W, 3) in [0, 1]."""
        from matplotlib import colormaps
        from matplotlib.colors import Normalize

        values = np.ma.masked_invalid(np.asarray(self.image, dtype=float))
        colours = colormaps[self.colours].with_extremes(bad="white")
        shades: NDArray[Any] = colours(Normalize(self.low, self.high, clip=True)(values))
        return shades[..., :3]


def panels(
    titles: Sequence[str], columns: int, width_in: float, height_in: float
) -> tuple[Any, list[Any]]:
    """An empty figure with a panel for each title, in rows of ``columns``, of so many inches each;
    its panels."""
    rows = max(-(-len(titles) // columns), 1)
    drawn = figure(width_in * columns, height_in * rows)
    axes_of = drawn.subplots(rows, columns, squeeze=False)
    for axes in axes_of.flat[len(titles) :]:
        axes.axis("off")
    for axes, title in zip(axes_of.flat, titles, strict=False):
        axes.set_title(title, loc="left")
        axes.tick_params(axis="x", rotation=40)
        axes.grid(axis="y", color=GRID)
    return drawn, list(axes_of.flat[: len(titles)])


def with_legend(drawn: Any, columns: int) -> bytes:
    """A figure with one legend of the lines of all its panels, in lines that fit its columns;
    PNG."""
    handles = {
        label: h
        for axes in drawn.axes
        for h, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    letters = int(_LETTERS_AN_INCH * (drawn.get_figwidth() / columns - _HANDLE_INCHES))
    labels = [textwrap.fill(label, letters) for label in handles]
    drawn.legend(handles.values(), labels, ncols=columns, loc="outside lower center")
    return figure_png(drawn, reduced=True)


@styled
def gallery(
    rows: Mapping[str, Sequence[Picture]], columns: Sequence[str], picture_inches: float = 1.1
) -> bytes:
    """Pictures in named rows and columns, so many inches wide each; PNG."""

    shapes = [picture.image.shape for row in rows.values() for picture in row]
    height, width = (max(lengths) + _GAP for lengths in zip(*shapes, strict=True))
    # One image: fifty small axes take ten times as long to lay out.
    sheet = np.ones((height * len(rows), width * len(columns), 3))
    for down, row in enumerate(rows.values()):
        for across, picture in enumerate(row):
            part = picture.rgb()
            sheet[down * height :, across * width :][: part.shape[0], : part.shape[1]] = part
    size = picture_inches * len(columns), picture_inches * len(rows) * height / width
    drawn = figure(size[0] + 1.2, size[1] + 0.6)
    axes = drawn.subplots()
    axes.imshow(sheet, interpolation="nearest")
    axes.xaxis.tick_top()
    axes.set_xticks(width * (np.arange(len(columns)) + 0.5), columns)
    axes.set_yticks(height * (np.arange(len(rows)) + 0.5), list(rows))
    axes.tick_params(length=0, labelsize=7)
    axes.spines[:].set_visible(False)
    return figure_png(drawn, reduced=True)


def millimetres(value: float | None) -> str:
    """An error in mm to three decimals, in powers of ten where very small or large, a dash for an
    empty pixel set."""
    if value is None:
        return "-"
    if value == 0:
        return "0"
    return f"{value:.3f}" if 5e-4 <= value < 1e6 else f"{value:.2e}"


def percent(share: float | None, decimals: int = 1) -> str:
    """A share as per cent, a dash where there is none."""
    return "-" if share is None else f"{100 * share:.{decimals}f}%"


def three_digits(value: float | None) -> str:
    """A time or another amount to three significant digits, whole from 100 on, a dash when
    unknown."""
    return "-" if value is None else f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def signed(value: float | None, plus: str = "+") -> str:
    """A signed error in mm: `millimetres` with its sign, a dash where there is none."""
    if value is None:
        return "-"
    return ("-" if value < 0 else plus if value > 0 else "") + millimetres(abs(value))


def interval_text(ends: tuple[float, float] | None, between: str = " to ") -> str:
    """The two ends of an interval in mm, a dash where there is none."""
    return "-" if ends is None else between.join(signed(end, plus="") for end in ends)


def escaped(value: object, limit: int = NAME_LIMIT) -> str:
    """``value`` escaped as HTML text or attribute value, at most ``limit`` characters."""
    return html.escape(printable(value, limit), quote=True)


def data_uri(png: bytes) -> str:
    """A PNG as a data URI, which an ``img`` shows without a request."""
    return "data:image/png;base64," + b64encode(png).decode("ascii")


def page(
    package: str,
    template: str,
    title: str,
    style: str = "",
    script: str = "",
    description: str = "",
    **values: Any,
) -> bytes:
    """A whole HTML page, whose body is ``templates/TEMPLATE`` of ``package`` by Jinja2 with
    ``values``, every one of them escaped. A template may include or import those of this package's
    own ``templates`` too. ``title`` and ``description`` are text; ``style`` and ``script`` are our
    own. Filters: ``printable``, ``data_uri``, and the numbers of this module."""
    from markupsafe import Markup

    environment = _environment(package)
    style = (
        Path(__file__).with_name("templates").joinpath("page.css").read_text(encoding="utf-8")
        + style
    )
    own = {
        "body": environment.get_template(template).render(title=title, **values),
        "style": style,
        "script": script,
    }
    frame = environment.get_template("page.html")
    own = {name: Markup(text) for name, text in own.items()}
    return str(frame.render(title=title, description=description, **own)).encode("utf-8")


@cache
def _environment(package: str) -> Any:  # a jinja2.Environment
    import jinja2  # plain `fpp-eval` writes no HTML

    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader(
            [jinja2.PackageLoader(name) for name in (package, "fpp_ml_bench")]
        ),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "printable": printable,
        "data_uri": data_uri,
        "millimetres": millimetres,
        "percent": percent,
        "three_digits": three_digits,
        "source": _source,
    }
    return environment


def _source(text: str) -> str:
    """The source of a Content-Security-Policy that allows exactly ``text``."""
    from markupsafe import Markup

    return Markup(
        f"'sha256-{b64encode(hashlib.sha256(text.encode('utf-8')).digest()).decode('ascii')}'"
    )
