"""Raised lettering: capital letters of 5 x 7 cells, flat or wrapped round an upright cylinder.

A carton is told from another by what is printed on it; an object without colour carries its name in relief instead.
Lengths in millimetres. Source: own.
"""

import numpy as np
from manifold3d import CrossSection, OpType

from fpp_ml_bench.loaders.objects.solids import Section, Solid

_GLYPHS = {
    "A": "01110 10001 10001 11111 10001 10001 10001",
    "B": "11110 10001 10001 11110 10001 10001 11110",
    "C": "01111 10000 10000 10000 10000 10000 01111",
    "D": "11110 10001 10001 10001 10001 10001 11110",
    "E": "11111 10000 10000 11110 10000 10000 11111",
    "F": "11111 10000 10000 11110 10000 10000 10000",
    "G": "01111 10000 10000 10011 10001 10001 01111",
    "H": "10001 10001 10001 11111 10001 10001 10001",
    "I": "01110 00100 00100 00100 00100 00100 01110",
    "J": "00111 00010 00010 00010 00010 10010 01100",
    "K": "10001 10010 10100 11000 10100 10010 10001",
    "L": "10000 10000 10000 10000 10000 10000 11111",
    "M": "10001 11011 10101 10101 10001 10001 10001",
    "N": "10001 11001 10101 10101 10011 10001 10001",
    "O": "01110 10001 10001 10001 10001 10001 01110",
    "P": "11110 10001 10001 11110 10000 10000 10000",
    "R": "11110 10001 10001 11110 10100 10010 10001",
    "S": "01111 10000 10000 01110 00001 00001 11110",
    "T": "11111 00100 00100 00100 00100 00100 00100",
    "U": "10001 10001 10001 10001 10001 10001 01110",
    "V": "10001 10001 10001 10001 01010 01010 00100",
    "Y": "10001 10001 01010 00100 00100 00100 00100",
    "Z": "11111 00001 00010 00100 01000 10000 11111",
    "+": "00000 00100 00100 11111 00100 00100 00000",
    "-": "00000 00000 00000 11111 00000 00000 00000",
    " ": "00000 00000 00000 00000 00000 00000 00000",
}
_ROWS, _ADVANCE = 7, 6


def text_section(text: str, width: float) -> Section:
    """The text as a flat section, ``width`` mm wide, centred at the origin; cells overlap a little where they meet."""
    runs = []
    for place, letter in enumerate(text):
        for row, cells in enumerate(_GLYPHS[letter].split()):
            for column, cell in enumerate(cells):
                if cell == "1":
                    corner = (place * _ADVANCE + column - 0.05, _ROWS - 1 - row - 0.05)
                    runs.append(CrossSection.square((1.1, 1.1)).translate(corner))
    section = CrossSection.batch_boolean(runs, OpType.Add)
    cells_wide = len(text) * _ADVANCE - 1
    scale = width / cells_wide
    return section.translate((-cells_wide / 2, -_ROWS / 2)).scale((scale, scale))


def text_plate(text: str, width: float, relief: float) -> Solid:
    """Drawn text rising ``relief`` mm above z = 0 and reaching as deep below it, to be joined to a face."""
    return text_section(text, width).extrude(2 * relief).translate((0, 0, -relief))


def wrapped(section: Section, radius: float, height: float, relief: float, turn: float = 0.0) -> Solid:
    """A flat section bent round an upright cylinder, centred at ``height`` on its front, ``relief`` mm proud of it."""
    sunk = 2.0 * relief + 0.5
    flat = section.extrude(sunk + relief).translate((0, 0, -sunk)).refine_to_length(max(radius / 12, 1.5))

    def bend(points: np.ndarray) -> np.ndarray:
        angle = points[:, 0] / radius
        reach = radius + points[:, 2]
        return np.stack([-reach * np.cos(angle), -reach * np.sin(angle), points[:, 1] + height], axis=1)

    return flat.warp_batch(bend).rotate((0, 0, turn))
