"""Tinned goods: rimmed round and rectangular cans. Drawn upright in millimetres at their real size."""

import numpy as np

from fpp_ml_bench.loaders.objects.lettering import text_section, wrapped
from fpp_ml_bench.loaders.objects.solids import (
    Point2,
    Solid,
    cut,
    disc,
    embossed,
    lathe,
    place,
    plate,
    rectangle,
    ring,
    rod,
    softened,
    union,
)
from fpp_ml_bench.loaders.objects.sweeps import curve, loft


def _rimmed(radius: float, height: float, ribs: tuple[float, ...] = ()) -> Solid:
    """Can body with a seamed rim at both ends, a sunk lid and raised ribs at the heights given."""
    rim = radius + 1.4
    wall: list[Point2] = [(rim - 1, 0), (rim, 0.8), (rim, 2.6), (radius, 3.6)]
    for z in ribs:
        wall += [(radius, z - 1.8), (radius + 0.9, z - 0.6), (radius + 0.9, z + 0.6), (radius, z + 1.8)]
    wall += [(radius, height - 3.6), (rim, height - 2.6), (rim, height - 0.8), (rim - 1, height)]
    sunk_lid = rod((0, 0, height - 3), (0, 0, height + 1), radius - 1.2)
    return cut(lathe(wall), sunk_lid)


def _pull_tab(scale: float = 1.0) -> Solid:
    """Ring-pull lying on z = 0, its rivet at the origin and its ring towards -x."""
    tab = (rectangle(22, 15, 7.4, (-9, 0)) - softened(rectangle(10, 9, 4.4, (-13, 0)), 1)).scale((scale, scale))
    return union(plate(tab, 1.6).translate((0, 0, 1.2)), rod((0, 0, -1), (0, 0, 2.6), 3.0 * scale))


def _around(count: int) -> list[Point2]:
    """Unit vectors at ``count`` equal steps round the axis."""
    angle = 2 * np.pi * np.arange(count) / count
    return [(float(c), float(s)) for c, s in zip(np.cos(angle), np.sin(angle), strict=True)]


def master_chef_can() -> Solid:
    """Coffee can, 102 x 139 mm, with an overhanging plastic lid and its name on a label that does not quite close."""
    body = _rimmed(50, 132)
    lid = cut(
        lathe([(52.5, 126), (53, 127), (53, 137), (51.5, 139)]),
        rod((0, 0, 137), (0, 0, 141), 46),
    )
    label = wrapped(rectangle(292, 112), 50, 65, 0.6)
    name = union(
        wrapped(text_section("MASTER", 76), 50.6, 92, 1.0),
        wrapped(text_section("CHEF", 58), 50.6, 70, 1.0),
        wrapped(disc(17), 50.6, 36, 1.0),
    )
    grips = [rod((53 * c, 53 * s, 127.5), (53 * c, 53 * s, 136.5), 0.9) for c, s in _around(60)]
    return union(body, lid, label, name, *grips)


def tomato_soup_can() -> Solid:
    """Soup can, 66 x 101 mm, with ring-pull, two ribs and a label."""
    body = _rimmed(32.5, 101, ribs=(10, 91))
    label = wrapped(rectangle(188, 68), 32.5, 50.5, 0.5)
    name = union(
        wrapped(text_section("TOMATO", 62), 33, 66, 0.9),
        wrapped(text_section("SOUP", 50), 33, 48, 0.9),
        wrapped(disc(8), 33, 29, 1.0),
    )
    return union(body, label, name, _pull_tab().translate((-8, 0, 98)))


def tuna_fish_can() -> Solid:
    """Flat can, 85 x 33 mm, tipped to show its lid with the ring-pull and steps."""
    body = _rimmed(42, 33, ribs=(9, 24))
    steps = union(ring(36, 1.3, 30), ring(30, 1.0, 30))
    name = wrapped(text_section("TUNA", 40), 42, 16.5, 1.0)
    fish_body = plate(disc(10).scale((1.5, 0.75)) + rectangle(9, 9).rotate(45).translate((17, 0)), 2)
    fish = place(fish_body, (12, 0, 30), (0, 0, 90))
    return place(union(body, steps, name, fish, _pull_tab(1.2).translate((-14, 0, 30))), turn=(0, -48, 0))


def potted_meat_can() -> Solid:
    """Rectangular meat tin with round corners, 97 x 50 x 82 mm, a sunk lid with ring-pull."""
    outline = 5.0
    rows = [
        (0, 95, 48, outline), (1, 97.5, 50.5, outline), (3, 97.5, 50.5, outline), (4, 95, 48, outline),
        (78, 95, 48, outline), (79, 97.5, 50.5, outline), (81, 97.5, 50.5, outline), (82, 95, 48, outline),
    ]  # fmt: skip
    lid = loft([(79.5, 92, 45, outline), (84, 92, 45, outline)])
    body = loft(rows)
    label = embossed(body, rectangle(84, 60, 3, (0, 41)), 0.6)
    words = text_section("MEAT", 68).translate((0, 50)) + text_section("POTTED", 56).translate((0, 26))
    tab = place(_pull_tab(1.1), (0, 12, 78.5), (0, 0, 90))
    return place(union(cut(body, lid), label, embossed(body, words, 1.8), tab), turn=(0, 0, 2))


def container_tin() -> Solid:
    """Kitchen canister, 110 x 158 mm: rolled seams, an overlapping domed lid with a knob, a label plate."""
    body = lathe([(53, 0), (54.4, 0.8), (54.4, 2.6), (53, 3.6), (53, 112)])
    dome = curve([(54.6, 122), (52, 127), (40, 132), (22, 135), (7, 136)])
    lid = lathe(np.concatenate([[(54.0, 104.0), (55.4, 104.6), (55.4, 106.4), (54.6, 107.4)], dome, [(5.0, 140.0)]]))
    knob = lathe(curve([(5, 138), (7, 143), (11, 147), (12.5, 152), (9, 157), (1, 158.6)]))
    beads = [ring(53, 1.2, z) for z in (14, 96)]
    plaque = wrapped(rectangle(74, 44, 8), 53, 56, 1.0)
    name = wrapped(text_section("TEA", 52), 54, 56, 1.3)
    return union(body, lid, knob, plaque, name, *beads)
