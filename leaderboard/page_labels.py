"""Names beside the marks of a picture, where there is room for them."""

from collections.abc import Sequence
from dataclasses import dataclass

from fpp_ml_bench.evaluation.report_html import escaped

Box = tuple[float, float, float, float]
"""Left, top, right, bottom in px."""

_CHARACTER_PX, _LINE_PX = 6.7, 15.0
"""Of sans-serif type at 12 px; wider than most, so that a name that fits here fits everywhere."""

_SHORTEST = 26
"""Characters that a name keeps however narrow the picture: fewer would tell nothing."""


@dataclass(frozen=True)
class Named:
    """A mark of radius ``r`` at (``x``, ``y``) px that wants its name beside it; ``slug`` is its row, if it has one."""

    name: str
    slug: str
    x: float
    y: float
    r: float


def label_texts(marks: Sequence[Named], lines: Sequence[Box], inside: Box, others: Sequence[Box] = ()) -> list[str]:
    """An SVG text for each mark that finds room, the first of ``marks`` first.

    No name covers a mark, one of ``others``, another name, or leaves ``inside``; nor one of ``lines``, unless there is
    no other place.
    """
    taken: list[Box] = [(m.x - m.r, m.y - m.r, m.x + m.r, m.y + m.r) for m in marks]
    taken += others
    longest = max(_SHORTEST, int(0.42 * (inside[2] - inside[0]) / _CHARACTER_PX))
    parts = []
    for mark in marks:
        text = shortened(mark.name, longest)
        wide = _CHARACTER_PX * len(text)
        free = [
            (box, anchor)
            for box, anchor in _places(mark, wide)
            if _within(box, inside) and not any(_overlap(box, other) for other in taken)
        ]
        clear = [place for place in free if not any(_overlap(place[0], line) for line in lines)]
        if not free:
            continue
        box, anchor = (clear or free)[0]
        taken.append(box)
        x = {"start": box[0], "end": box[2], "middle": (box[0] + box[2]) / 2}[anchor]
        row = f' data-row="{mark.slug}"' if mark.slug else ""
        parts.append(
            f'<text class="name"{row} x="{x:.1f}" y="{box[1] + 11.5:.1f}" text-anchor="{anchor}">{escaped(text)}</text>'
        )
    return parts


def shortened(text: str, longest: int) -> str:
    """``text``, or its beginning and its end around an ellipsis: names of one family differ in either."""
    if len(text) <= longest:
        return text
    tail = longest // 2
    return f"{text[: longest - 1 - tail].rstrip()}…{text[-tail:].lstrip()}"


def _places(mark: Named, wide: float) -> list[tuple[Box, str]]:
    """Boxes beside, above and below the mark, the best first."""
    gap = mark.r + 5
    level, above, below = mark.y - _LINE_PX / 2, mark.y - mark.r - _LINE_PX - 2, mark.y + mark.r + 2
    right, left = mark.x + gap, mark.x - gap - wide
    corners = [(mark.x + 4, above), (mark.x + 4, below), (mark.x - 4 - wide, above), (mark.x - 4 - wide, below)]
    found = [(right, level, "start"), (left, level, "end")]
    found += [(x, y, "start" if x > mark.x else "end") for x, y in corners]
    found += [(mark.x - wide / 2, above, "middle"), (mark.x - wide / 2, below, "middle")]
    return [((x, y, x + wide, y + _LINE_PX), anchor) for x, y, anchor in found]


def _within(box: Box, inside: Box) -> bool:
    return box[0] >= inside[0] and box[1] >= inside[1] and box[2] <= inside[2] and box[3] <= inside[3]


def _overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]
