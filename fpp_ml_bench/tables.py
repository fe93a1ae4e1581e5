"""One table for the terminal, Markdown and HTML pages. In the terminal names and numbers stay
whole; where a table is too wide, columns are left out."""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console, ConsoleOptions, RenderResult
from rich.measure import Measurement
from rich.table import Table as RichTable
from rich.text import Text

from fpp_ml_bench.files import printable

if TYPE_CHECKING:
    from rich.progress import TextColumn

_UNLIMITED = 1_000_000
_PLAIN = frozenset(" -,+()/%=.")


class Table(RichTable):
    """A rich table of columns of text titled ``texts``, then of ``numbers``, which are aligned to
    the right. The first ``names`` columns say what each row is. Names and numbers are never wrapped
    or cut; other text is wrapped between words.

    Where the terminal is too narrow, columns are left out: those titled ``first_out``, in this
    order, then from the right, all but the last of them. A name is wrapped where even that does not
    fit beside it. A line below the table lists what is left out and how to see it: in a wider
    terminal, or ``elsewhere``, such as ``--json FILE``."""

    def __init__(
        self,
        *texts: str,
        numbers: Iterable[str] = (),
        names: int = 1,
        first_out: Sequence[str] = (),
        elsewhere: str = "",
        **options: Any,
    ) -> None:
        super().__init__(*texts, title_justify="left", caption_justify="left", **options)
        for title in numbers:
            self.add_column(title, justify="right")
        self.names, self.first_out, self.elsewhere = names, first_out, elsewhere

    @classmethod
    def of(
        cls,
        title: str,
        rows: Sequence[Mapping[str, str]],
        words: Collection[int] = (0, 1),
        **look: Any,
    ) -> Self:
        """A table of ``rows`` of cells by the titles of their columns, of which those numbered
        ``words`` are text. No cell is markup."""
        table = cls(title=Text(title), **look)
        for number, name in enumerate(rows[0] if rows else ()):
            table.add_column(Text(name), justify="left" if number in words else "right")
        for row in rows:
            table.add_row(*map(Text, row.values()))
        return table

    @property
    def titles(self) -> list[str]:
        """The titles of the columns."""
        return [" ".join(str(column.header).split()) for column in self.columns]

    @property
    def texts(self) -> list[tuple[str, ...]]:
        """The cells of each row."""
        return list(zip(*(map(str, column.cells) for column in self.columns), strict=True))

    def markdown(self) -> list[str]:
        """Lines of a Markdown table, without its title."""
        rules = (" ---: " if column.justify == "right" else " --- " for column in self.columns)
        lines = ["| " + " | ".join(self.titles) + " |", "|" + "|".join(rules) + "|"]
        return lines + ["| " + " | ".join(map(markdown_text, cells)) + " |" for cells in self.texts]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        measured = [self._widths(console, options, number) for number in range(len(self.columns))]
        widths = {number: least for number, (least, _) in enumerate(measured)}

        def room() -> int:
            """Characters left of the terminal's width: a column takes two spaces and a border
            beside its text."""
            return options.max_width - sum(width + 3 for width in widths.values()) - 1

        left_out = []
        for number in self._order()[:-1]:
            if room() < 0:
                left_out.append(number)
                del widths[number]
        while room() < 0 and max(widths.values()) > 1:
            widths[max(widths, key=lambda number: widths[number])] -= 1
        for number in widths:
            least, whole = measured[number]
            widths[number] += min(whole - least, max(room(), 0))
        fitted = copy(self)
        fitted.columns = [
            replace(self.columns[n], width=width, overflow="fold") for n, width in widths.items()
        ]
        yield from RichTable.__rich_console__(fitted, console, options)
        if left_out:
            titles = "; ".join(
                " ".join(str(self.columns[number].header).split()) for number in sorted(left_out)
            )
            also = f", and so does {self.elsewhere}" if self.elsewhere else ""
            yield Text(
                f"Left out at {options.max_width} columns: {titles}. A wider terminal shows "
                f"them{also}."
            )

    def _widths(self, console: Console, options: ConsoleOptions, number: int) -> tuple[int, int]:
        """The least width of a column's text, in characters, and the width at which nothing in it
        is wrapped."""
        column, unlimited = self.columns[number], options.update(width=_UNLIMITED)
        title, *cells = (
            Measurement.get(console, unlimited, text) for text in (column.header, *column.cells)
        )
        stays_whole = number < self.names or column.justify == "right"
        least = max(
            1, title.minimum, *(cell.maximum if stays_whole else cell.minimum for cell in cells)
        )
        return least, max(least, title.maximum, *(cell.maximum for cell in cells))

    def _order(self) -> list[int]:
        """The columns of values in the order in which they are left out."""
        numbers = range(len(self.columns) - 1, self.names - 1, -1)
        titles = [str(self.columns[number].header) for number in numbers]
        first = [numbers[titles.index(title)] for title in self.first_out if title in titles]
        return first + [number for number in numbers if number not in first]


def words(form: str) -> "TextColumn":
    """A column of a progress bar: a format of its task. What it holds is no markup."""
    from rich.progress import TextColumn

    return TextColumn(form, markup=False)


def markdown_text(text: str) -> str:
    """``text`` as Markdown that shows exactly this text: punctuation that could be markup becomes a
    character entity. Entities are never structure (CommonMark 6.2): no pipe ends a table cell, no
    tag, link, code or mention begins."""
    safe = "".join(
        c if not c.isascii() or c.isalnum() or c in _PLAIN else f"&#{ord(c)};"
        for c in printable(text)
    )
    return re.sub(r"(?i)(www)\.", r"\1&#46;", safe)  # GitHub links bare www. names too
