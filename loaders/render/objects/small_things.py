"""Small things of the desk and the pocket: pens, chalk, spectacles, cells and their case. Millimetres, real size."""

import numpy as np

from fpp_ml_bench.loaders.render.objects.solids import (
    SMALL_SEGMENTS,
    Solid,
    ball,
    block,
    cut,
    facing,
    lathe,
    place,
    plate,
    polygon,
    rectangle,
    ring,
    rod,
    text_section,
    union,
    wrapped,
)
from fpp_ml_bench.loaders.render.objects.sweeps import curve, superellipse, tube


def marker() -> Solid:
    """Felt marker, 18 x 132 mm, its cap off at the writing end: stepped barrel, chisel tip, end plug."""
    barrel = lathe(
        [(7.6, 0), (8.6, 1), (8.6, 3), (9, 4), (9, 84), (8.4, 86), (8.4, 94), (5.6, 100), (5.2, 116), (3.4, 120)]
    )
    tip = cut(rod((0, 0, 118), (0, 0, 131), 2.9, 2.7), place(block(12, 12, 10), (-4, 0, 131), (0, 40, 0)))
    label = wrapped(rectangle(52, 64), 9, 44, 0.3)
    words = wrapped(text_section("MARKER", 54).rotate(90), 9.2, 44, 0.6)
    grooves = [ring(9, 0.45, z) for z in (7, 9, 11, 80)]
    return place(union(cut(barrel, *grooves), tip, label, words), turn=(4, -2, 0))


def pen() -> Solid:
    """Retractable ballpoint, 12 x 145 mm: push button, clip, ribbed rubber grip and a fine point."""
    ribs = [
        (5.2 + 0.6 * proud, 21 + 2.6 * k + at)
        for k in range(11)
        for at, proud in ((0, 0), (0.5, 1), (1.3, 1), (1.8, 0))
    ]
    barrel = lathe(
        [
            (0.7, 0),
            (1.0, 3),
            (1.9, 4),
            (4.6, 17),
            (5.2, 20),
            *ribs,
            (5.2, 50),
            (5.8, 51),
            (5.8, 54),
            (5.3, 55),
            (5.3, 126),
            (4.4, 130),
        ],
        segments=64,
    )
    button = lathe([(3, 128), (3, 140), (2.3, 142)], 0.4, SMALL_SEGMENTS)
    clip = union(
        block(2.2, 4.2, 52, 0.8, (-8.4, 0, 104)), block(5, 4.2, 5, 0.8, (-6.4, 0, 127.5)), ball(2.2, (-7.6, 0, 79))
    )
    return place(union(barrel, button, clip), turn=(4, -2, 0))


def chalk_stick() -> Solid:
    """Stick of chalk, 14 x 84 mm: tapered, one end broken off, the other worn to a slope, a few chips."""
    body = lathe([(6.6, 0), (7.0, 0.6), (5.9, 83), (5.2, 84)], segments=72)
    worn = place(block(20, 20, 8), (-3, 0, 85), (0, -32, 0))
    broken = [
        place(block(18, 18, 8), (x, y, -3.2), turn)
        for x, y, turn in ((4, 2, (14, 22, 0)), (-5, 4, (-20, -16, 0)), (0, -5, (24, 3, 0)))
    ]
    chips = [
        ball(2.2, (8.1 * c, 8.1 * s, z))
        for c, s, z in ((-1, 0.2, 22), (0.6, 0.8, 40), (0.3, -0.95, 61), (-0.7, -0.7, 70))
    ]
    return place(cut(body, worn, *broken, *chips), turn=(5, -3, 0))


def eyeglasses() -> Solid:
    """Spectacles, 140 mm wide, on open temples: rims with lenses, bridge, nose pads, hinges, hooked ear ends."""
    rim = superellipse(56, 46, 2.6, 96)
    parts: list[Solid] = []
    for side in (-1, 1):
        loop = np.stack([rim[:, 0] + side * 35, rim[:, 1], 0 * rim[:, 0]], axis=1)
        parts.append(tube(loop, 2.3, flatten=1.2, closed=True, sides=20))
        parts.append(plate(polygon(rim).translate((side * 35, 0)), 1.6))
        temple = curve(
            [(side * 66, 9, -2), (side * 68, 9, -28), (side * 68, 8, -72), (side * 67, 1, -96), (side * 66, -18, -112)]
        )
        parts.append(tube(temple, 2.0, flatten=1.9, up=(0, 1, 0.2), sides=20))
        parts.append(block(8, 9, 9, 2, (side * 65, 9, -2)))
        parts.append(place(Solid.sphere(4, 32).scale((0.5, 1.3, 0.9)), (side * 9.5, -7, -7), (0, side * 30, 0)))
        parts.append(
            tube(curve([(side * 8.5, 1, 0), (side * 8, -2, -4), (side * 9.5, -7, -7)]), 0.9, up=(1, 0, 0), sides=12)
        )
    parts.append(tube(curve([(-9, 6, 0), (-4, 9.5, 1), (4, 9.5, 1), (9, 6, 0)]), 2.3, flatten=1.2, sides=20))
    return place(facing(union(*parts)), turn=(0, 12, 0))


def battery() -> Solid:
    """Round cell, 26 x 50 mm, tipped to show its positive nub: crimped collar, sleeve with lettering."""
    body = lathe(
        [
            (11.5, 0),
            (12.6, 0.6),
            (12.6, 1.4),
            (13, 1.8),
            (13, 45.4),
            (12.4, 46.2),
            (12.4, 47),
            (10.4, 47.6),
            (10.2, 47),
        ],
        0.2,
    )
    nub = lathe([(4.4, 46), (4.4, 49.6), (3.8, 50.4)], 0.2, SMALL_SEGMENTS)
    collar = union(ring(12.9, 0.45, 36), ring(12.9, 0.45, 34.8), ring(8, 0.5, 47.3))
    words = union(
        wrapped(text_section("+", 9), 13, 41, 0.5), wrapped(text_section("-", 7), 13, 6, 0.5),
        wrapped(text_section("BATTERY", 32), 13, 22, 0.5),
        wrapped(rectangle(30, 1.2), 13, 15, 0.45), wrapped(rectangle(30, 1.2), 13, 29, 0.45),
    )  # fmt: skip
    return place(union(body, nub, collar, words), turn=(0, -3, 0))


def battery_case() -> Solid:
    """Open holder with four cells head to tail, 66 x 60 x 18 mm: springs, contact tabs, ribs and two leads."""
    tray = cut(block(68, 64, 17, 1.2), block(62, 60.5, 17, 0.5, (0, 0, 3)))
    walls = [block(62, 1.4, 8, 0, (0, y, -4)) for y in (-15, 0, 15)]
    cells = []
    for lane, y in enumerate((-22.5, -7.5, 7.5, 22.5)):
        side = 1 if lane % 2 else -1
        cell = place(
            lathe([(6.8, 0), (7.1, 0.4), (7.1, 46.6), (6.4, 47.4), (2.7, 47.5), (2.7, 49.4)], segments=72),
            (-side * 24, y, 1),
            (0, side * 90, 0),
        )
        spring = [place(ring(4.0 - 0.3 * k, 0.7), (-side * (30.4 - 1.6 * k), y, 1), (0, 90, 0)) for k in range(4)]
        stem = rod((-side * 31, y, 1), (-side * 23, y, 1), 3.2)
        plus = place(text_section("+", 5).extrude(1.4), (side * 17, y, 7.4))
        cells += [cell, stem, plus, *spring, block(1.4, 9, 11, 0, (side * 31, y, 2))]
    leads = [tube(curve([(30, y, -4), (37, y, -4), (41, y + 5, -3), (42, 20 + y, 0)]), 1.3, sides=20) for y in (6, 12)]
    clips = [block(8, 4, 5, 1, (x, s * 31, 8)) for x in (-16, 16) for s in (-1, 1)]
    return place(facing(union(tray, *walls, *cells, *leads, *clips)), turn=(0, -1, 2))
