"""Power and air tools: drill and spray gun. Drawn in side view, in millimetres at their real size."""

import numpy as np

from fpp_ml_bench.loaders.objects.solids import (
    Solid,
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
    stroke,
    union,
)
from fpp_ml_bench.loaders.objects.sweeps import curve

_TO_LEFT = (0, -90, 0)  # turns a lathe so that its top points to the viewer's left


def power_drill() -> Solid:
    """Cordless drill, 230 x 215 mm: motor housing with vents, clutch ring, chuck and bit, grip, trigger, battery."""
    housing = place(
        lathe(np.concatenate([[(24.0, 0.0)], curve([(26, 4), (28, 30), (28, 70), (26.5, 92), (25, 107)])]), 1),
        (62, 78, 0),
        _TO_LEFT,
    )
    clutch = place(lathe([(25, 0), (26.5, 3), (26.5, 20), (24, 23)]), (-42, 78, 0), _TO_LEFT)
    knurls = [rod((-45, 78 + 26 * s, 26 * c), (-61, 78 + 26 * s, 26 * c), 1.5) for c, s in _steps(28)]
    chuck = place(
        lathe([(22, 0), (22, 16), (20, 17), (20, 20), (21, 21), (20, 32), (10, 44), (6, 46)]), (-64, 78, 0), _TO_LEFT
    )
    flutes = [rod((-84, 78 + 21.5 * s, 21.5 * c), (-100, 78 + 20.5 * s, 20.5 * c), 1.8) for c, s in _steps(14)]
    bit = union(
        rod((-108, 78, 0), (-124, 78, 0), 4.5),
        rod((-122, 78, 0), (-158, 78, 0), 3),
        rod((-157, 78, 0), (-163, 78, 0), 3, 0.4),
    )
    side = np.concatenate([
        curve([(2, 70), (2, 40), (10, 0), (18, -34), (20, -50)]),
        curve([(66, -50), (62, -20), (58, 20), (60, 50), (62, 84)]),
    ])  # fmt: skip
    grip_outline = polygon(side, 4)
    grip = union(plate(grip_outline, 30), plate(grip_outline.offset(-4), 40))
    trigger = union(plate(polygon([(4, 50), (-8, 44), (-8, 32), (0, 20), (12, 16), (10, 50)], 2), 16))
    shoe = plate(polygon([(-8, -46), (74, -46), (80, -62), (-16, -62)], 3), 34)
    battery = block(104, 42, 36, 6, (30, -81, 0))
    latch = union(block(14, 12, 40, 3, (-4, -78, 0)), block(108, 3, 38, 1, (30, -70, 0)))
    vents = [block(5, 26, 80, 2, (x, 84, 0)) for x in (22, 31, 40, 49)]
    cap = place(lathe([(27, 0), (27, 6), (20, 12)], 1.5), (60, 78, 0), (0, 90, 0))
    body = cut(union(housing, cap, grip), *(v - block(200, 200, 56, 0, (0, 84, 0)) for v in vents))
    badge = plate(rectangle(38, 11, 4, (-14, 82)), 60)
    switch = rod((8, 58, -24), (8, 58, 24), 5)
    parts = union(body, clutch, *knurls, cut(chuck, *flutes), bit, trigger, shoe, battery, latch, badge, switch)
    return place(facing(parts), turn=(0, 0, 1))


def _steps(count: int) -> list[tuple[float, float]]:
    angle = 2 * np.pi * np.arange(count) / count
    return list(zip(np.cos(angle).tolist(), np.sin(angle).tolist(), strict=True))


def spraygun() -> Solid:
    """Gravity-feed spray gun, 250 mm tall: cup on top, air cap with horns, hooked body, trigger, grip and hose end."""
    body = place(lathe([(15, 0), (17, 4), (17, 60), (15, 84), (17, 88), (17, 96)], 1), (34, 60, 0), _TO_LEFT)
    cap = union(
        place(ring(18, 2.4).scale((1, 1, 2.6)), (-66, 60, 0), _TO_LEFT),
        place(lathe([(18, 0), (18, 8), (8, 13), (5, 18)]), (-60, 60, 0), _TO_LEFT),
        *(place(block(16, 9, 11, 2), (-76, 60 + s * 15, 0), (0, 0, s * 24)) for s in (-1, 1)),
    )  # fmt: skip
    grip_outline = polygon(np.concatenate([
        curve([(4, 56), (6, 30), (16, -6), (24, -40), (28, -66)]),
        curve([(58, -66), (54, -36), (46, -4), (42, 30), (56, 52), (60, 66), (48, 74)]),
    ]), 3)  # fmt: skip
    grip = union(plate(grip_outline, 18), plate(grip_outline.offset(-4), 25))
    hook = plate(stroke([(-18, 66), (-26, 84), (-38, 86)], 8), 8)
    trigger = plate(
        stroke(curve([(-34, 66), (-26, 34), (-14, 10), (-12, -12), (-24, -30)]), 9),
        13,
    )
    pivot = rod((-33, 64, -21), (-33, 64, 21), 6)
    stem = union(
        rod((-22, 60, 0), (-34, 102, 0), 10), place(rod((0, 0, 0), (0, 0, 10), 15), (-34, 100, 0), (-90, 0, 0))
    )
    cup = place(
        union(lathe(np.concatenate([[(8.0, 0.0)], curve([(16, 2), (30, 14), (39, 34), (41, 60), (41, 92)])])),
              lathe([(43, 88), (43.5, 90), (43.5, 100), (30, 106), (8, 107), (8, 113), (5, 114)])),
        (-35, 106, 0), (-90, 0, 0),
    )  # fmt: skip
    rows = [place(ring(43.3, 1.3), (-35, y, 0), (90, 0, 0)) for y in (197, 201, 205)]
    knobs = union(
        rod((30, 60, 0), (58, 60, 0), 9),
        rod((56, 60, 0), (72, 60, 0), 12),
        rod((40, 36, 0), (66, 32, 0), 8),
        rod((62, 33, 0), (76, 31, 0), 10),
    )
    inlet = union(
        rod((43, -62, 0), (46, -80, 0), 11), rod((46, -78, 0), (47, -86, 0), 14), rod((47, -86, 0), (49, -104, 0), 7)
    )
    return place(facing(union(body, cap, grip, hook, trigger, pivot, stem, cup, knobs, inlet, *rows)), turn=(0, 0, 1))
