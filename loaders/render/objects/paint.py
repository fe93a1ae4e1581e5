"""Paint containers: bottle, jar, spray can, thinner can and three tubes. Drawn upright in millimetres, real size."""

import numpy as np

from fpp_ml_bench.loaders.render.objects.containers import ribbed_cap
from fpp_ml_bench.loaders.render.objects.solids import (
    Solid,
    ball,
    block,
    cut,
    embossed,
    facing,
    lathe,
    place,
    plate,
    polygon,
    rectangle,
    ring,
    rod,
    stroke,
    text_plate,
    text_section,
    union,
    wrapped,
)
from fpp_ml_bench.loaders.render.objects.sweeps import curve, loft, tube

_BRUSH_MARK = [(-20, -6), (-10, 4), (-2, -4), (8, 5), (20, -2)]


def paint_container_bottle() -> Solid:
    """Craft-paint bottle, 44 x 118 mm, with a flip-top cap and a daub of paint on its label."""
    body = lathe(
        np.concatenate(
            [[(19.0, 0.0), (21.5, 2.0), (22.0, 6.0), (22.0, 72.0)], curve([(21.5, 78), (17, 86), (12, 90), (11, 94)])]
        )
    )
    cap = union(
        ribbed_cap(13, 13, 28).translate((0, 0, 91)),
        lathe([(12.4, 103), (12.6, 112), (11, 115)]),
        rod((0, 0, 114), (0, 0, 119), 4, 3),
    )
    notch = block(5, 11, 4, 1, (-13.6, 0, 104))
    label = wrapped(rectangle(112, 52), 22, 38, 0.35)
    words = union(
        wrapped(text_section("PAINT", 34), 22.4, 54, 0.7),
        wrapped(stroke(_BRUSH_MARK, 12).scale((0.66, 0.8)), 22.4, 28, 0.9),
    )
    return union(body, cut(cap, notch), label, words)


def paint_container_jar() -> Solid:
    """Wide paint jar, 76 x 84 mm, with a ribbed lid and paint running down from under it."""
    body = lathe([(32, 0), (37, 3), (38, 8), (38, 52), (36, 58), (33, 62), (33, 68)], 1.2)
    lid = place(union(ribbed_cap(37.5, 17, 60), ring(34, 1.6, 17), ring(22, 1.0, 17)), (0, 0, 65), (0, 0, 7))
    runs = []
    for y, top, length in ((-14, 62, 30), (-6, 62, 44), (3, 62, 22), (11, 62, 12), (20, 62, 34)):
        x = -float(np.sqrt(36.4**2 - y**2))
        runs.append(rod((x, y, top), (x, y, top - length), 2.4, 3.6, rounded=True))
    hem = tube([(-36.0 * np.cos(a), 36.0 * np.sin(a), 62.5) for a in np.linspace(-0.7, 0.8, 30)], 3.4)
    words = wrapped(text_section("PAINT", 44), 38, 14, 1.1)
    return union(body, lid, hem, words, *runs)


def paint_container_spraycan() -> Solid:
    """Spray can, 66 x 195 mm: domed shoulder, valve cup and spray button with its nozzle."""
    body = lathe(
        np.concatenate([
            [(31, 0), (33, 1), (33, 3), (32, 5), (32, 150), (33, 152), (33, 154.5)],
            curve([(32, 156), (27, 163), (19, 168), (14.5, 169.5)]), [(14.5, 173), (11, 173)],
        ])
    )  # fmt: skip
    button = cut(
        lathe([(9, 171), (9, 186), (7.8, 193), (6.5, 195)], 0.8),
        block(10, 30, 10, 2, (5.5, 0, 197)),
    )
    nozzle = union(rod((-6, 0, 187), (-10.5, 0, 187), 3.2), rod((-6, 0, 187), (-11.5, 0, 187), 1.2))
    label = wrapped(rectangle(178, 118), 32, 77, 0.4)
    words = union(
        wrapped(text_section("SPRAY", 66), 32.4, 112, 0.9),
        wrapped(text_section("PAINT", 66), 32.4, 94, 0.9),
        wrapped(stroke(_BRUSH_MARK, 12).scale((1.2, 1.2)), 32.4, 54, 1.0),
    )
    return union(body, button, nozzle, label, words)


def _tube(length: float, width: float, cap_radius: float, cap_height: float, crimp: float = 10.0) -> Solid:
    """Collapsible tube standing on its cap: round shoulder lofted to a flat, folded and pleated end."""
    shoulder = cap_height + 10
    end = shoulder + length
    levels = [
        (shoulder, 0.80 * width, 0.80 * width, 2.0), (shoulder + 0.18 * length, 0.82 * width, 0.77 * width, 2.0),
        (shoulder + 0.45 * length, 0.87 * width, 0.62 * width, 2.1),
        (shoulder + 0.75 * length, 0.94 * width, 0.34 * width, 2.2),
        (end - crimp, width, 0.09 * width + 1.2, 2.6),
    ]  # fmt: skip
    body = loft(levels, smooth=8)
    fold = block(0.08 * width + 2.6, width + 1.5, crimp, 0.8, (0, 0, end - crimp / 2))
    pleats = [
        block(0.08 * width + 3.8, width + 1.6, 1.1, 0, (0, 0, end - crimp + 1.5 + 2.4 * k))
        for k in range(int(crimp / 2.6))
    ]
    neck = lathe(
        [
            (0.40 * width, shoulder),
            (0.40 * width, shoulder + 0.5),
            (0.36 * width, shoulder - 2),
            (cap_radius * 0.6, cap_height - 4),
        ][::-1]
    )
    rim = ring(0.4 * width - 0.6, 1.3, shoulder)
    return union(body, fold, neck, rim, *pleats, ribbed_cap(cap_radius, cap_height, 24))


def paint_container_tube_small() -> Solid:
    """Stubby watercolour tube, 21 x 84 mm."""
    body = _tube(62, 20.5, 7.0, 10, 6)
    return place(union(body, embossed(body, text_section("RED", 13).translate((0, 48)), 0.5)), turn=(1, 0, 0)).rotate(
        (0, 0, 30)
    )


def paint_container_tube() -> Solid:
    """Oil-paint tube, 30 x 130 mm, rolled up a little at its end."""
    body = _tube(106, 30, 7.5, 13, 8)
    roll = rod((-3.2, -15.6, 126), (-3.2, 15.6, 126), 4.6)
    words = text_section("OIL", 19).translate((0, 72)) + stroke(_BRUSH_MARK, 9).scale((0.5, 0.6)).translate((0, 50))
    return place(union(body, roll, embossed(body, words, 0.7)), turn=(-1, 0, 0)).rotate((0, 0, 30))


def paint_container_tube_large() -> Solid:
    """Large acrylic tube, 52 x 192 mm, squeezed at its waist and standing on a wide flip cap."""
    body = _tube(156, 52, 19, 26, 9)
    dent = place(ball(26), (-32, 8, 140))
    hinge = block(6, 12, 8, 1, (18, 0, 24))
    words = text_section("ACRYL", 36).translate((0, 64)) + rectangle(32, 3, 0, (0, 82)) + rectangle(24, 3, 0, (0, 90))
    return place(union(cut(union(body, embossed(body, words, 1.0)), dent), hinge), turn=(1, 0, 0)).rotate((0, 0, 30))


def paint_thinner() -> Solid:
    """Rectangular solvent can, 165 x 100 x 240 mm: seams, sunk top with screw spout and a strap handle."""
    body = union(
        loft([(0, 163, 98, 9), (2, 166, 101, 9), (6, 166, 101, 9), (7, 163, 98, 9), (193, 163, 98, 9),
              (194, 166, 101, 9), (199, 166, 101, 9), (200, 163, 98, 9)]),
    )  # fmt: skip
    top = loft([(196, 157, 92, 9), (203, 157, 92, 9)])
    spout = union(rod((0, 50, 190), (0, 50, 216), 19), ribbed_cap(22, 20, 36).translate((0, 50, 202)))
    strap = tube(
        curve([(0, 16, 196), (0, 12, 224), (0, -14, 238), (0, -48, 234), (0, -64, 214), (0, -66, 196)]),
        9,
        flatten=0.28,
        up=(0, 0.3, 1),
    )
    words = union(
        text_plate("PAINT", 112, 1.6).translate((0, 46, 0)), text_plate("THINNER", 140, 1.6).translate((0, 14, 0)),
        plate(stroke([(-58, -34), (-20, -34), (-20, -58), (-58, -58), (-58, -34)], 4), 3),
        plate(polygon([(-39, -36), (-33, -45), (-35, -55), (-43, -55), (-45, -45)], 1.5), 3),
        *(plate(rectangle(74, 4, 0, (28, y)), 3) for y in (-36, -46, -56)),
    )  # fmt: skip
    seam = block(3, 8, 190, 1, (49, -30, 100))
    return place(union(cut(body, top), spout, strap, facing(words).translate((-49.2, 0, 96)), seam), turn=(0, -1, 3))
