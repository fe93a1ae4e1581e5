"""Writing HTML pages in which text from a submission stays text, and which load nothing.

A page contains its style, script and pictures. Its Content-Security-Policy allows only the style and the script with
the given hashes: the page sends no request, and an injected script can't run.
"""

import hashlib
import html
import struct
import zlib
from base64 import b64encode
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.files import NAME_LIMIT, printable

if TYPE_CHECKING:
    import jinja2

_HERE = Path(__file__).resolve().parent


def escaped(value: object, limit: int = NAME_LIMIT) -> str:
    """``value`` escaped as HTML text or attribute value, at most ``limit`` characters."""
    return html.escape(printable(value, limit), quote=True)


@cache
def base_style() -> str:
    """The style that every page shares: colours for light and dark, type, tables, focus."""
    return (_HERE / "page.css").read_text(encoding="utf-8")


def page(title: str, body: str, style: str = "", script: str = "", description: str = "") -> str:
    """A whole HTML page. ``title`` and ``description`` are text; ``body`` is HTML, ``style`` and ``script`` our own."""
    style = base_style() + style
    allowed = ["default-src 'none'", "img-src data:", f"style-src {_source(style)}", "base-uri 'none'"]
    allowed += ["form-action 'none'", *([f"script-src {_source(script)}"] if script else [])]
    meta = f'<meta name="description" content="{escaped(description, 300)}">\n' if description else ""
    code = f"<script>{script}</script>\n" if script else ""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{"; ".join(allowed)}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f'<title>{escaped(title)}</title>\n{meta}<link rel="icon" href="data:,">\n<style>{style}</style>\n</head>\n'
        f'<body>\n<a class="skip" href="#main">Skip to the content</a>\n{body}\n{code}</body>\n</html>\n'
    )


def render(package: str, template: str, **values: object) -> str:
    """HTML from ``templates/TEMPLATE`` of ``package`` by Jinja2, with every value escaped.

    A template may include or import those of this package's own ``templates`` too. Filters: ``printable``, and the
    numbers of `fpp_ml_bench.evaluation.report.numbers`. Wrap only HTML that this package made in ``markupsafe.Markup``.
    """
    return str(_environment(package).get_template(template).render(values))


@cache
def _environment(package: str) -> "jinja2.Environment":
    import jinja2

    from fpp_ml_bench.evaluation.report import numbers

    environment = jinja2.Environment(
        loader=jinja2.ChoiceLoader([jinja2.PackageLoader(p) for p in (package, "fpp_ml_bench.evaluation.report")]),
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True,
        keep_trailing_newline=True,
    )  # fmt: skip
    environment.filters["printable"] = printable
    for name in ("millimetres", "percent", "seconds", "signed", "interval_text"):
        environment.filters[name] = getattr(numbers, name)
    return environment


def _source(text: str) -> str:
    return f"'sha256-{b64encode(hashlib.sha256(text.encode('utf-8')).digest()).decode('ascii')}'"


def data_uri(png: bytes) -> str:
    """A PNG as a data URI, which an ``img`` shows without a request."""
    return "data:image/png;base64," + b64encode(png).decode("ascii")


def palette_png(indices: NDArray[np.uint8], colours: NDArray[np.uint8]) -> bytes:
    """A PNG of ``indices`` (H, W) into ``colours`` (256, 3); index 0 is transparent. The same bytes every time."""
    height, width = indices.shape
    lines = np.zeros((height, width + 1), np.uint8)
    lines[:, 1:] = indices
    parts = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)),
        (b"PLTE", colours.astype(np.uint8).tobytes()),
        (b"tRNS", b"\0"),
        (b"IDAT", zlib.compress(lines.tobytes(), 9)),
        (b"IEND", b""),
    )
    chunks = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in parts
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)
