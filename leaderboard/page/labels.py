"""Labels beside the marks of a picture: a name where there is room, else a number that a key below explains."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from fpp_ml_bench.evaluation.report import escaped

Box = tuple[float, float, float, float]
"""Left, top, right, bottom in px."""

_CHARACTER_PX, _LINE_PX, _BASELINE_PX = 6.7, 15.0, 11.5
"""Of sans-serif type at 12 px; wider than most fonts, so that a name that fits here fits everywhere."""
_NUMBER_GAPS_PX = (3.0, 12.0, 22.0, 34.0, 48.0)
"""From the mark to its number; from the second on a thin line joins them."""
_DIRECTIONS = 16


@dataclass(frozen=True)
class Mark:
    """A mark of radius ``r`` at (``x``, ``y``) px. ``number`` is explained by ``name`` in the key; ``slug`` is the
    name of its row's page, empty without a row."""

    name: str
    number: int
    slug: str
    x: float
    y: float
    r: float

    @property
    def box(self) -> Box:
        return self.x - self.r, self.y - self.r, self.x + self.r, self.y + self.r


@dataclass(frozen=True)
class Label:
    """``text`` in ``box``, the name or the number of ``mark``."""

    mark: Mark
    text: str
    box: Box
    anchor: str
    is_number: bool = False

    def svg(self) -> str:
        """The text, and for a number away from its mark the line that joins them."""
        row = f' data-row="{self.mark.slug}"' if self.mark.slug else ""
        x = {"start": self.box[0], "end": self.box[2], "middle": (self.box[0] + self.box[2]) / 2}[self.anchor]
        text = (
            f'<text class="name"{row} x="{x:.1f}" y="{self.box[1] + _BASELINE_PX:.1f}" text-anchor="{self.anchor}">'
            f"{escaped(self.text)}</text>"
        )
        return self._leader(row) + text

    def _leader(self, row: str) -> str:
        mark, (left, top, right, bottom) = self.mark, self.box
        x, y = min(max(mark.x, left), right), min(max(mark.y, top + 2), bottom - 2)
        distance = math.hypot(x - mark.x, y - mark.y)
        if distance - mark.r < _NUMBER_GAPS_PX[1] / 2 or not self.is_number:
            return ""
        share = mark.r / distance
        start_x, start_y = mark.x + share * (x - mark.x), mark.y + share * (y - mark.y)
        return f'<path class="leader"{row} d="M{start_x:.1f} {start_y:.1f}L{x:.1f} {y:.1f}"/>'


def place_labels(
    marks: Sequence[Mark], lines: Sequence[Box], inside: Box, obstacles: Sequence[Box] = (), names: bool = True
) -> list[Label]:
    """A label for each of ``marks`` that has room, the first of ``marks`` first.

    No label covers a mark, one of ``obstacles`` or another label, or leaves ``inside``. A name does not cover ``lines``
    either. A mark without room for its name, and every mark with ``names`` False, gets its number, where possible clear
    of ``lines``.
    """
    taken: list[Box] = [*(mark.box for mark in marks), *obstacles]
    labels = []
    for mark in marks:
        label = None
        if names:
            label = _first_free(_name_places(mark), [*taken, *lines], inside)
        label = label or _first_free(_number_places(mark), [*taken, *lines], inside)
        label = label or _first_free(_number_places(mark), taken, inside)
        if label is not None:
            labels.append(label)
            taken.append(label.box)
    return labels


def key_list(labels: Sequence[Label], css_class: str = "") -> str:
    """HTML of the key: a line for each number in the picture; nothing where every mark has its name."""
    numbered = sorted({(label.mark.number, label.mark.name) for label in labels if label.is_number})
    items = "".join(f'<li value="{number}">{escaped(name)}</li>' for number, name in numbered)
    return f'<ol class="key {css_class}">{items}</ol>' if items else ""


def _first_free(places: Sequence[Label], taken: Sequence[Box], inside: Box) -> Label | None:
    for label in places:
        if _within(label.box, inside) and not any(_overlap(label.box, box) for box in taken):
            return label
    return None


def _name_places(mark: Mark) -> list[Label]:
    """The name beside, above and below the mark, the best place first."""
    wide, gap = _CHARACTER_PX * len(mark.name), mark.r + 5
    level, above, below = mark.y - _LINE_PX / 2, mark.y - mark.r - _LINE_PX - 2, mark.y + mark.r + 2
    corners = [(mark.x + 4, above, "start"), (mark.x + 4, below, "start")]
    corners += [(mark.x - 4 - wide, above, "end"), (mark.x - 4 - wide, below, "end")]
    places = [(mark.x + gap, level, "start"), (mark.x - gap - wide, level, "end"), *corners]
    places += [(mark.x - wide / 2, above, "middle"), (mark.x - wide / 2, below, "middle")]
    return [Label(mark, mark.name, (x, y, x + wide, y + _LINE_PX), anchor) for x, y, anchor in places]


def _number_places(mark: Mark) -> list[Label]:
    """The number around the mark, near places first, the upper right first."""
    text = str(mark.number)
    half_width, half_height = _CHARACTER_PX * len(text) / 2 + 2, _LINE_PX / 2
    places = []
    for gap in _NUMBER_GAPS_PX:
        for step in range(_DIRECTIONS):
            turn = math.tau * (step / _DIRECTIONS - 1 / 8)
            x = mark.x + (mark.r + gap + half_width) * math.cos(turn)
            y = mark.y + (mark.r + gap + half_height) * math.sin(turn)
            box = (x - half_width, y - half_height, x + half_width, y + half_height)
            places.append(Label(mark, text, box, "middle", is_number=True))
    return places


def _within(box: Box, inside: Box) -> bool:
    return box[0] >= inside[0] and box[1] >= inside[1] and box[2] <= inside[2] and box[3] <= inside[3]


def _overlap(first: Box, second: Box) -> bool:
    return first[0] < second[2] and second[0] < first[2] and first[1] < second[3] and second[1] < first[3]
