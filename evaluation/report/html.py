"""Writing HTML pages in which text from a submission stays text, and which load nothing; how numbers are written. A
page contains its style, script and pictures. Its Content-Security-Policy allows only the style and the script with the
given hashes: the page sends no request, and an injected script can't run."""

import hashlib
import html
from base64 import b64encode
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

from fpp_ml_bench.evaluation.metrics import METRICS, UNCERTAINTY
from fpp_ml_bench.files import NAME_LIMIT, printable


def millimetres(value: float | None) -> str:
    """An error in mm to three decimals, in powers of ten where very small or large, a dash for an empty pixel set."""
    if value is None:
        return "-"
    if value == 0:
        return "0"
    return f"{value:.3f}" if 5e-4 <= value < 1e6 else f"{value:.2e}"


def percent(share: float | None) -> str:
    """A share as per cent with one decimal, a dash where there is none."""
    return "-" if share is None else f"{100 * share:.1f}%"


def seconds(value: float | None) -> str:
    """A time in seconds to three significant digits, a dash when unknown."""
    return "-" if value is None else f"{value:.3g}"


def signed(value: float | None, plus: str = "+") -> str:
    """A signed error in mm: `millimetres` with its sign, a dash where there is none."""
    if value is None:
        return "-"
    return ("-" if value < 0 else plus if value > 0 else "") + millimetres(abs(value))


_WRITERS: dict[str, Callable[[float | None], str]] = {
    "mm": millimetres,
    "signed mm": signed,
    "share": percent,
    "ratio": percent,
    "nats": partial(signed, plus=""),
}


def score_text(key: str, value: float | None) -> str:
    """A value of the metric ``key`` as its unit is written: mm, or per cent for a share."""
    return _WRITERS[(METRICS.get(key) or UNCERTAINTY[key]).unit](value)


def interval_text(ends: tuple[float, float] | None, between: str = " to ") -> str:
    """The two ends of an interval in mm, a dash where there is none."""
    return "-" if ends is None else between.join(signed(end, plus="") for end in ends)


def escaped(value: object, limit: int = NAME_LIMIT) -> str:
    """``value`` escaped as HTML text or attribute value, at most ``limit`` characters."""
    return html.escape(printable(value, limit), quote=True)


def data_uri(png: bytes) -> str:
    """A PNG as a data URI, which an ``img`` shows without a request."""
    return "data:image/png;base64," + b64encode(png).decode("ascii")


def page(title: str, body: str, style: str = "", script: str = "", description: str = "") -> str:
    """A whole HTML page. ``title`` and ``description`` are text; ``body`` is HTML, ``style`` and ``script`` our own."""
    import markupsafe

    own = {"body": body, "style": _base_style() + style, "script": script}
    own = {name: markupsafe.Markup(text) for name, text in own.items()}
    return render(__package__, "page.html", title=title, description=description, **own)


@cache
def _base_style() -> str:
    """The style that every page shares: colours for light and dark, type, tables, focus."""
    return Path(__file__).with_name("page.css").read_text(encoding="utf-8")


def render(package: str, template: str, **values: object) -> str:
    """HTML from ``templates/TEMPLATE`` of ``package`` by Jinja2, with every value escaped. A template may include or
    import those of this package's own ``templates`` too. Filters: ``printable``, and the numbers of this module. Wrap
    only HTML that this package made in ``markupsafe.Markup``."""
    return _environment(package).get_template(template).render(values)


@cache
def _environment(package: str) -> Any:  # a jinja2.Environment
    import jinja2  # plain `fpp-eval` writes no HTML

    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(p) for p in (package, __package__)]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {
        "printable": printable,
        "millimetres": millimetres,
        "percent": percent,
        "seconds": seconds,
        "signed": signed,
        "interval_text": partial(interval_text, between=".."),
        "source": _source,
    }
    return environment


def _source(text: str) -> str:
    """The source of a Content-Security-Policy that allows exactly ``text``."""
    import markupsafe

    return markupsafe.Markup(f"'sha256-{b64encode(hashlib.sha256(text.encode('utf-8')).digest()).decode('ascii')}'")
