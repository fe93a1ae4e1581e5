"""Bottles, cans, sprayers, tubes and jars: lofted or turned bodies with closures. Upright, in mm,
at real size."""

import numpy as np
from solids import (
    SEGMENTS,
    Point2,
    Solid,
    around,
    ball,
    block,
    curve,
    cut,
    disc,
    embossed,
    facing,
    lathe,
    lettered,
    loft,
    place,
    plate,
    polygon,
    post,
    rectangle,
    ring,
    rod,
    softened,
    stroke,
    text_plate,
    text_section,
    tube,
    union,
    upright,
    wrapped,
)


def ribbed_cap(radius: float, height: float, ribs: int = 36) -> Solid:
    """Screw cap standing on z = 0 with vertical grips."""
    feet = [(radius * c, radius * s) for c, s in around(ribs)]
    grips = [post(1.5, height - 2.5, 0.07 * radius, at=(x, y)) for x, y in feet]
    return union(lathe([(radius, 0), (radius, height - 2), (radius - 2, height)]), *grips)


@upright(1.48, (0, 0, 30))
def mustard_bottle() -> Solid:
    """Oval squeeze bottle, 96 x 58 x 190 mm, with a pointed nozzle."""
    body = loft(
        [
            (0, 84, 46, 2.6),
            (3, 92, 55, 2.6),
            (10, 95, 58, 2.6),
            (60, 95, 58, 2.6),
            (112, 94, 57, 2.5),
            (132, 84, 53, 2.4),
            (146, 62, 46, 2.2),
            (153, 46, 42, 2.0),
            (155, 42, 41, 2.0),
        ],
        smooth=8,
    )
    closure = lathe(
        [(23, 152), (23, 163), *curve([(21, 165), (14, 169), (8, 176), (5.5, 184), (4.2, 192)])]
    )
    grips = [ring(23, 0.8, z) for z in (155, 158, 161)]
    panel = embossed(body, rectangle(72, 84, 14, (0, 66)), 0.8)
    words = (
        text_section("MUSTARD", 62, (0, 80))
        + rectangle(46, 3, 0, (0, 58))
        + rectangle(34, 3, 0, (0, 50))
    )
    return union(body, closure, panel, embossed(body, words, 2.2), *grips)


@upright(1.35, (0, 0, 30))
def bleach_cleanser() -> Solid:
    """Cleanser bottle, 98 x 66 x 250 mm: square shoulders, a waist to hold it by and a ribbed
    cap."""
    body = loft(
        [
            (0, 88, 54, 4),
            (3, 96, 64, 4),
            (10, 98, 66, 4),
            (90, 98, 66, 4),
            (112, 93, 60, 3.6),
            (135, 86, 54, 3.2),
            (158, 86, 54, 3.0),
            (178, 84, 52, 2.8),
            (194, 70, 46, 2.4),
            (206, 46, 38, 2.0),
            (212, 36, 35, 2),
        ],
        smooth=8,
    )
    neck = post(205, 222, 16)
    cap = union(ribbed_cap(20, 22).translate((0, 0, 216)), post(236, 250, 11, 8))
    words = text_section("BLEACH", 74, (0, 70))
    for width, height in ((76, 50), (60, 40), (66, 30)):
        words = words + rectangle(width, 2.6, 0, (0, height))
    return union(body, neck, cap, embossed(body, words, 1.5))


@upright(1.8, (0, -3, -6))
def container_bottle() -> Solid:
    """Canister with a handle through its shoulder, 170 x 105 x 280 mm, and a wide screw cap."""
    body = loft(
        [
            (0, 152, 90, 3.4),
            (4, 164, 101, 3.4),
            (12, 168, 105, 3.4),
            (120, 168, 105, 3.4),
            (165, 166, 102, 3.2),
            (205, 152, 92, 2.8),
            (232, 118, 78, 2.4),
            (248, 76, 62, 2.1),
            (254, 58, 56, 2),
            (262, 56, 56, 2),
        ],
        smooth=8,
    )
    hole = place(
        tube(curve([(-90, 46, 205), (0, 46, 205), (90, 46, 205)], 2), 15.0, 2.1), (0, 0, -18)
    )
    thinner = [
        place(block(40, 60, 120, 18), (s * 56, -0.0 + 62, 190), (0, s * -6, 0)) for s in (-1, 1)
    ]
    cap = union(ribbed_cap(31, 26, 44).translate((0, 0, 258)), ring(31, 2.2, 259))
    panel = embossed(body, rectangle(118, 96, 12, (-4, 78)), 1.0)
    marks = text_section("LITRE", 84, (-4, 100)) + rectangle(90, 7, 3, (-4, 70))
    marks = marks + rectangle(60, 7, 3, (-19, 48))
    for step in range(7):
        marks = marks + rectangle(14 if step % 2 else 9, 2.6, 0, (66, 40 + 18.0 * step))
    drained = cut(union(body, panel, embossed(body, marks, 2.4)), hole, *thinner)
    return union(drained, cap)


@upright(1.6, (0, 0, 1))
def spray_bottle() -> Solid:
    """Trigger sprayer, 78 mm wide at its foot and 275 mm tall, seen from its side at the first
    view."""
    side = [
        (39, 5),
        (39, 60),
        (38, 100),
        (34, 125),
        (30, 140),
        (28.5, 155),
        (25, 172),
        (18, 186),
        (14.5, 192),
    ]
    body = lathe([(31, 0), (37, 1), *curve(side), (14.5, 205)])
    collar = ribbed_cap(19, 20, 30).translate((0, 0, 196))
    head = polygon(
        [
            (-18, 214),
            (18, 214),
            (20, 226),
            (34, 236),
            (36, 262),
            (20, 275),
            (-34, 275),
            (-62, 266),
            (-64, 248),
            (-20, 244),
        ],
        3,
    )
    front, back = (
        curve([(-42, 250), (-38, 232), (-42, 210), (-52, 190)]),
        curve([(-60, 192), (-52, 214), (-49, 232), (-54, 250)]),
    )
    trigger = plate(polygon([*front, *back]), 13)
    tip = rod((-76, 257, 0), (-80, 257, 0), 5)
    nozzle = facing(
        union(rod((-60, 257, 0), (-72, 257, 0), 11), block(8, 24, 24, 1, (-74, 257, 0)), tip)
    )
    grip = [ring(39.2, 0.9, z) for z in (16, 22, 28)]
    words = wrapped(text_section("SPRAY", 56), 38.8, 74, 1.3)
    return union(body, collar, facing(plate(head, 19)), facing(trigger), nozzle, words, *grip)


@upright(4.6)
def vial() -> Solid:
    """Medicine vial, 24 x 58 mm: round shoulder, crimped cap over a rubber stopper, a label."""
    glass = lathe(
        [(10.5, 0), (12, 1.5), (12, 36), (11.3, 39), (9, 42), (7, 44), (6.6, 46), (6.6, 51)], 0.8
    )
    crimp = lathe([(8.5, 49), (9.4, 50), (9.4, 57), (8.6, 58.2)])
    stopper = union(lathe([(6, 57), (6, 59.4), (5, 60.2)]), ring(7.4, 0.5, 58.2))
    label = wrapped(rectangle(62, 22), 12, 20, 0.25)
    words = wrapped(text_section("VIAL", 16), 12.2, 25, 0.35)
    lines = [wrapped(rectangle(15, 1.1), 12.2, z, 0.3) for z in (18.5, 15.5, 12.5)]
    return union(glass, crimp, stopper, label, words, *lines)


@upright(4.5, (0, -2, 0))
def cork() -> Solid:
    """Tapered stopper, 34 mm wide, with lenticels and pits."""
    body = lathe([(11.5, 0), (12.6, 1.2), (16.2, 40.6), (15.2, 42)], segments=SEGMENTS)
    pits = []
    for k in range(90):
        angle, z = 2.39996 * k, 2.5 + 36.5 * ((k * 0.4142136) % 1.0)
        radius = 12.7 + 0.09 * z
        side = angle + 0.09 * (0.6 + 1.9 * ((k * 0.7320508) % 1.0))
        ends = [
            (radius * float(np.cos(a)), radius * float(np.sin(a)), at)
            for a, at in ((angle, z), (side, z + 0.4))
        ]
        pits.append(rod(ends[0], ends[1], 0.4, 0.75, rounded=True))
    holes = [post(40, 44, 0.9, at=(x, y)) for x, y in ((4, 3), (-6, 2), (1, -7), (-3, -3), (9, -4))]
    split = block(10, 0.8, 14, 0, (-14, 4, 36))
    return cut(body, *pits, *holes, split)


def _rimmed(radius: float, height: float, ribs: tuple[float, ...] = ()) -> Solid:
    """Can body with a seamed rim at both ends, a sunk lid and raised ribs at the heights given."""
    rim = radius + 1.4
    wall: list[Point2] = [(rim - 1, 0), (rim, 0.8), (rim, 2.6), (radius, 3.6)]
    for z in ribs:
        wall += [
            (radius, z - 1.8),
            (radius + 0.9, z - 0.6),
            (radius + 0.9, z + 0.6),
            (radius, z + 1.8),
        ]
    wall += [(radius, height - 3.6), (rim, height - 2.6), (rim, height - 0.8), (rim - 1, height)]
    sunk_lid = post(height - 3, height + 1, radius - 1.2)
    return cut(lathe(wall), sunk_lid)


def _pull_tab(scale: float = 1.0) -> Solid:
    """Ring-pull lying on z = 0, its rivet at the origin and its ring towards -x."""
    tab = (rectangle(22, 15, 7.4, (-9, 0)) - softened(rectangle(10, 9, 4.4, (-13, 0)), 1)).scale(
        (scale, scale)
    )
    return union(plate(tab, 1.6).translate((0, 0, 1.2)), post(-1, 2.6, 3.0 * scale))


@upright(1.32)
def master_chef_can() -> Solid:
    """Coffee can, 102 x 139 mm, with an overhanging plastic lid and its name on a label that does
    not quite close."""
    body = _rimmed(50, 132)
    lid = cut(lathe([(52.5, 126), (53, 127), (53, 137), (51.5, 139)]), post(137, 141, 46))
    label = wrapped(rectangle(292, 112), 50, 65, 0.6)
    name = union(
        *lettered(50.6, 1.0, ("MASTER", 76, 92), ("CHEF", 58, 70)), wrapped(disc(17), 50.6, 36, 1.0)
    )
    grips = [post(127.5, 136.5, 0.9, at=(53 * c, 53 * s)) for c, s in around(60)]
    return union(body, lid, label, name, *grips)


@upright(2.25)
def tomato_soup_can() -> Solid:
    """Soup can, 66 x 101 mm, with ring-pull, two ribs and a label."""
    body = _rimmed(32.5, 101, ribs=(10, 91))
    label = wrapped(rectangle(188, 68), 32.5, 50.5, 0.5)
    name = union(
        *lettered(33, 0.9, ("TOMATO", 62, 66), ("SOUP", 50, 48)), wrapped(disc(8), 33, 29, 1.0)
    )
    return union(body, label, name, _pull_tab().translate((-8, 0, 98)))


@upright(3.0, (0, -48, 0))
def tuna_fish_can() -> Solid:
    """Flat can, 85 x 33 mm, tipped to show its lid with the ring-pull and steps."""
    body = _rimmed(42, 33, ribs=(9, 24))
    steps = union(ring(36, 1.3, 30), ring(30, 1.0, 30))
    name = wrapped(text_section("TUNA", 40), 42, 16.5, 1.0)
    fish_body = plate(
        disc(10).scale((1.5, 0.75)) + rectangle(9, 9).rotate(45).translate((17, 0)), 2
    )
    fish = place(fish_body, (12, 0, 30), (0, 0, 90))
    return union(body, steps, name, fish, _pull_tab(1.2).translate((-14, 0, 30)))


@upright(2.65, (0, 0, 2))
def potted_meat_can() -> Solid:
    """Rectangular meat tin with round corners, 97 x 50 x 82 mm, a sunk lid with ring-pull."""
    waist, rim, outline = (95, 48), (97.5, 50.5), 5.0
    levels = (
        (0, waist),
        (1, rim),
        (3, rim),
        (4, waist),
        (78, waist),
        (79, rim),
        (81, rim),
        (82, waist),
    )
    lid = loft([(79.5, 92, 45, outline), (84, 92, 45, outline)])
    body = loft([(height, *size, outline) for height, size in levels])
    label = embossed(body, rectangle(84, 60, 3, (0, 41)), 0.6)
    words = text_section("MEAT", 68, (0, 50)) + text_section("POTTED", 56, (0, 26))
    tab = place(_pull_tab(1.1), (0, 12, 78.5), (0, 0, 90))
    return union(cut(body, lid), label, embossed(body, words, 1.8), tab)


@upright(1.32)
def container_tin() -> Solid:
    """Kitchen canister, 110 x 158 mm: rolled seams, an overlapping domed lid with a knob, a label
    plate."""
    body = lathe([(53, 0), (54.4, 0.8), (54.4, 2.6), (53, 3.6), (53, 112)])
    dome = curve([(54.6, 122), (52, 127), (40, 132), (22, 135), (7, 136)])
    lid = lathe([(54, 104), (55.4, 104.6), (55.4, 106.4), (54.6, 107.4), *dome, (5, 140)])
    knob = lathe(curve([(5, 138), (7, 143), (11, 147), (12.5, 152), (9, 157), (1, 158.6)]))
    beads = [ring(53, 1.2, z) for z in (14, 96)]
    plaque = wrapped(rectangle(74, 44, 8), 53, 56, 1.0)
    name = wrapped(text_section("TEA", 52), 54, 56, 1.3)
    return union(body, lid, knob, plaque, name, *beads)


_BRUSH_MARK = [(-20, -6), (-10, 4), (-2, -4), (8, 5), (20, -2)]


@upright(3.0)
def paint_container_bottle() -> Solid:
    """Craft-paint bottle, 44 x 118 mm, with a flip-top cap and a daub of paint on its label."""
    body = lathe(
        [(19, 0), (21.5, 2), (22, 6), (22, 72), *curve([(21.5, 78), (17, 86), (12, 90), (11, 94)])]
    )
    top = lathe([(12.4, 103), (12.6, 112), (11, 115)])
    cap = union(ribbed_cap(13, 13, 28).translate((0, 0, 91)), top, post(114, 119, 4, 3))
    notch = block(5, 11, 4, 1, (-13.6, 0, 104))
    label = wrapped(rectangle(112, 52), 22, 38, 0.35)
    daub = wrapped(stroke(_BRUSH_MARK, 12).scale((0.66, 0.8)), 22.4, 28, 0.9)
    words = union(*lettered(22.4, 0.7, ("PAINT", 34, 54)), daub)
    return union(body, cut(cap, notch), label, words)


@upright(1.68)
def paint_container_jar() -> Solid:
    """Wide paint jar, 76 x 84 mm, with a ribbed lid and paint running down from under it."""
    body = lathe([(32, 0), (37, 3), (38, 8), (38, 52), (36, 58), (33, 62), (33, 68)], 1.2)
    lid = place(
        union(ribbed_cap(37.5, 17, 60), ring(34, 1.6, 17), ring(22, 1.0, 17)), (0, 0, 65), (0, 0, 7)
    )
    runs = []
    for y, length in ((-14, 30), (-6, 44), (3, 22), (11, 12), (20, 34)):
        x = -float(np.sqrt(36.4**2 - y**2))
        runs.append(rod((x, y, 62), (x, y, 62 - length), 2.4, 3.6, rounded=True))
    hem = tube(
        [(-36.0 * np.cos(a), 36.0 * np.sin(a), 62.5) for a in np.linspace(-0.7, 0.8, 30)], 3.4
    )
    words = wrapped(text_section("PAINT", 44), 38, 14, 1.1)
    return union(body, lid, hem, words, *runs)


@upright(2.05)
def paint_container_spraycan() -> Solid:
    """Spray can, 66 x 195 mm: domed shoulder, valve cup and spray button with its nozzle."""
    dome = curve([(32, 156), (27, 163), (19, 168), (14.5, 169.5)])
    wall = [(31, 0), (33, 1), (33, 3), (32, 5), (32, 150), (33, 152), (33, 154.5)]
    body = lathe([*wall, *dome, (14.5, 173), (11, 173)])
    button = cut(
        lathe([(9, 171), (9, 186), (7.8, 193), (6.5, 195)], 0.8),
        block(10, 30, 10, 2, (5.5, 0, 197)),
    )
    nozzle = union(rod((-6, 0, 187), (-10.5, 0, 187), 3.2), rod((-6, 0, 187), (-11.5, 0, 187), 1.2))
    label = wrapped(rectangle(178, 118), 32, 77, 0.4)
    daub = wrapped(stroke(_BRUSH_MARK, 12).scale((1.2, 1.2)), 32.4, 54, 1.0)
    words = union(*lettered(32.4, 0.9, ("SPRAY", 66, 112), ("PAINT", 66, 94)), daub)
    return union(body, button, nozzle, label, words)


def _tube(
    length: float, width: float, cap_radius: float, cap_height: float, crimp: float = 10.0
) -> Solid:
    """Collapsible tube standing on its cap: round shoulder lofted to a flat, folded and pleated
    end."""
    shoulder = cap_height + 10
    end = shoulder + length
    levels = [
        (shoulder, 0.80 * width, 0.80 * width, 2.0),
        (shoulder + 0.18 * length, 0.82 * width, 0.77 * width, 2.0),
        (shoulder + 0.45 * length, 0.87 * width, 0.62 * width, 2.1),
        (shoulder + 0.75 * length, 0.94 * width, 0.34 * width, 2.2),
        (end - crimp, width, 0.09 * width + 1.2, 2.6),
    ]
    body = loft(levels, smooth=8)
    fold = block(0.08 * width + 2.6, width + 1.5, crimp, 0.8, (0, 0, end - crimp / 2))
    folds = (end - crimp + 1.5 + 2.4 * k for k in range(int(crimp / 2.6)))
    pleats = [block(0.08 * width + 3.8, width + 1.6, 1.1, 0, (0, 0, z)) for z in folds]
    throat = [(cap_radius * 0.6, cap_height - 4), (0.36 * width, shoulder - 2)]
    neck = lathe([*throat, (0.40 * width, shoulder + 0.5), (0.40 * width, shoulder)])
    rim = ring(0.4 * width - 0.6, 1.3, shoulder)
    return union(body, fold, neck, rim, *pleats, ribbed_cap(cap_radius, cap_height, 24))


@upright(4.35, (1, 0, 0), (0, 0, 30))
def paint_container_tube_small() -> Solid:
    """Stubby watercolour tube, 21 x 84 mm."""
    body = _tube(62, 20.5, 7.0, 10, 6)
    words = embossed(body, text_section("RED", 13, (0, 48)), 0.5)
    return union(body, words)


@upright(2.88, (-1, 0, 0), (0, 0, 30))
def paint_container_tube() -> Solid:
    """Oil-paint tube, 30 x 130 mm, rolled up a little at its end."""
    body = _tube(106, 30, 7.5, 13, 8)
    roll = rod((-3.2, -15.6, 126), (-3.2, 15.6, 126), 4.6)
    words = text_section("OIL", 19, (0, 72)) + stroke(_BRUSH_MARK, 9).scale((0.5, 0.6)).translate(
        (0, 50)
    )
    return union(body, roll, embossed(body, words, 0.7))


@upright(1.78, (1, 0, 0), (0, 0, 30))
def paint_container_tube_large() -> Solid:
    """Large acrylic tube, 52 x 192 mm, squeezed at its waist and standing on a wide flip cap."""
    body = _tube(156, 52, 19, 26, 9)
    dent = place(ball(26), (-32, 8, 140))
    hinge = block(6, 12, 8, 1, (18, 0, 24))
    words = (
        text_section("ACRYL", 36, (0, 64))
        + rectangle(32, 3, 0, (0, 82))
        + rectangle(24, 3, 0, (0, 90))
    )
    return union(cut(union(body, embossed(body, words, 1.0)), dent), hinge)


@upright(1.7, (0, -1, 3))
def paint_thinner() -> Solid:
    """Rectangular solvent can, 165 x 100 x 240 mm: seams, sunk top with screw spout and a strap
    handle."""
    wall, seam_size = (163, 98), (166, 101)
    levels = (
        (0, wall),
        (2, seam_size),
        (6, seam_size),
        (7, wall),
        (193, wall),
        (194, seam_size),
        (199, seam_size),
    )
    body = union(loft([(height, *size, 9) for height, size in (*levels, (200, wall))]))
    top = loft([(196, 157, 92, 9), (203, 157, 92, 9)])
    spout = union(post(190, 216, 19, at=(0, 50)), ribbed_cap(22, 20, 36).translate((0, 50, 202)))
    bow = [(16, 196), (12, 224), (-14, 238), (-48, 234), (-64, 214), (-66, 196)]
    strap = tube(curve([(0, y, z) for y, z in bow]), 9, flatten=0.28, up=(0, 0.3, 1))
    words = union(
        text_plate("PAINT", 112, 1.6).translate((0, 46, 0)),
        text_plate("THINNER", 140, 1.6).translate((0, 14, 0)),
        plate(stroke([(-58, -34), (-20, -34), (-20, -58), (-58, -58), (-58, -34)], 4), 3),
        plate(polygon([(-39, -36), (-33, -45), (-35, -55), (-43, -55), (-45, -45)], 1.5), 3),
        *(plate(rectangle(74, 4, 0, (28, y)), 3) for y in (-36, -46, -56)),
    )
    seam = block(3, 8, 190, 1, (49, -30, 100))
    return union(cut(body, top), spout, strap, facing(words).translate((-49.2, 0, 96)), seam)
