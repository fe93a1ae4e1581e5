"""Things of the house (bowl, mug, candles, pens, cells) and things with flat faces (cartons, books,
timber). In mm."""

import numpy as np
from solids import (
    SMALL_SEGMENTS,
    Solid,
    angles,
    ball,
    block,
    curve,
    cut,
    disc,
    drawn,
    lathe,
    lettered,
    place,
    plate,
    polygon,
    post,
    rectangle,
    ring,
    rod,
    skin,
    stroke,
    superellipse,
    text_plate,
    text_section,
    tube,
    union,
    upright,
    vessel,
    wrapped,
)


@upright(2.6, (0, -50, 0))
def bowl() -> Solid:
    """Bowl, 160 x 60 mm, with foot, rolled rim and two turned lines inside, tipped so that its
    hollow is seen."""
    body = vessel(
        [(27, 0), (30, 0), *curve([(30, 5), (50, 11), (66, 24), (76, 42), (80, 60)])], 3.2, 0.6
    )
    lines = [ring(r, 0.7, z) for r, z in ((73.6, 44), (70.4, 37.5))]
    return union(body, ring(79.2, 2.4, 59.5), *lines)


@upright(3.2, (0, -30, 0))
def mug() -> Solid:
    """Mug, 82 x 92 mm and its handle, tipped a little to show the hollow."""
    body = vessel([(35, 0), (38, 1.5), (40.5, 10), (41, 40), (41, 92)], 3.6, 1.2)
    ear = curve(
        [
            (0, -38, 76),
            (0, -52, 79),
            (0, -66, 68),
            (0, -69, 50),
            (0, -62, 32),
            (0, -50, 22),
            (0, -37, 19),
        ]
    )
    handle = tube(ear, 5.2, flatten=1.35, up=(1, 0, 0))
    badge = wrapped(
        stroke([(-16, 8), (-8, 18), (0, 10), (8, 18), (16, 8), (0, -14), (-16, 8)], 3.4),
        41,
        46,
        1.2,
    )
    solid = cut(union(body, handle), post(4.5, 88, 37.3))
    return union(solid, badge, ring(39.5, 1.7, 91.5))


@upright(1.85, (0, -10, 0))
def pitcher() -> Solid:
    """Pitcher, 130 x 240 mm: tapered, with a pulled spout, a big handle and ridges round its
    foot."""
    wall = 3.4
    body = vessel(
        [(44, 0), *curve([(48, 2), (52, 60), (57, 130), (60, 190), (62, 238)])], wall, 1.0
    )
    lip, throat = _spout(0.0), _spout(wall)
    bore = lathe([(44, 6), (48.4, 60), (53.4, 130), (56.4, 190), (58.5, 250)])
    ear = [(-56, 214), (-78, 222), (-104, 206), (-110, 160), (-98, 104), (-74, 66), (-50, 56)]
    handle = tube(curve([(0, y, z) for y, z in ear]), 8.0, flatten=1.4, up=(1, 0, 0))
    ridges = [ring(r, 1.3, z) for r, z in ((48.6, 10), (49.2, 17), (49.8, 24), (61.4, 222))]
    heights = enumerate(range(50, 200, 20))
    marks = [
        wrapped(rectangle(14 if k % 2 else 26, 2.4), 48.6 + 0.062 * z, z, 1.4, 24)
        for k, z in heights
    ]
    shell = cut(union(body, lip, handle, *ridges, *marks), throat, bore)
    return shell


def _spout(inset: float) -> Solid:
    """Beak of the pitcher towards +y; drawn ``inset`` mm smaller on every side it is its
    channel."""
    rim = 238.0 + (12 if inset else 0)
    outline = [
        (0, 90 - 2 * inset, rim),
        (-30 + inset, 44, rim),
        (30 - inset, 44, rim),
        (0, 55 - inset, 176 + 2 * inset),
        (-18, 30, rim),
        (18, 30, rim),
    ]
    return Solid.batch_hull([ball(2.5, point) for point in outline]).trim_by_plane((0, 0, -1), -rim)


@upright(1.5, (0, -20, 0))
def cleaning_bucket() -> Solid:
    """Pail, 280 x 250 mm, with bands, ears, and a bail handle with its grip, tipped to show the
    inside."""
    body = vessel([(98, 0), (102, 2), (138, 250)], 3.5, 1.2)
    bands = [ring(137.5, 4, 248), ring(135.2, 2.5, 232), ring(104, 2.5, 18), ring(105.5, 2.0, 28)]
    ears = [rod((0, s * 130, 236), (0, s * 146, 236), 13, 10) for s in (-1, 1)]
    angle = np.linspace(0, np.pi, 41)
    bow = np.column_stack([-118 * np.sin(angle), 146 * np.cos(angle), 236 + 78 * np.sin(angle)])
    bail = tube(bow, 3.6, up=(1, 0, 1))
    grip = rod((-118, -46, 312), (-118, 46, 312), 11)
    words = wrapped(text_section("CLEAN", 150), 120, 130, 2.0)
    rivets = [ball(4.5, (0, s * 147, 236)) for s in (-1, 1)]
    solid = cut(union(body, *bands, *ears), post(8, 252, 97.5, 134.2))
    return union(solid, bail, grip, words, *rivets)


@upright(1.75)
def lighting_candles() -> Solid:
    """Five burning candles of different height and girth, in cups on a narrow holder 250 mm
    long."""
    holder = union(
        block(34, 250, 12, 3, (0, 0, 6)), *(block(44, 14, 8, 2, (0, s * 84, 4)) for s in (-1, 1))
    )
    stands = ((-98, 20, 118), (-53, 22, 182), (0, 26, 226), (52, 23, 160), (98, 19, 92))
    cups = [
        lathe([(16, 8), (radius + 2, 12), (radius + 3, 26)]).translate((0, y, 0))
        for y, radius, _ in stands
    ]
    return union(
        holder,
        *cups,
        *(_candle(radius, height).translate((0, y, 10)) for y, radius, height in stands),
    )


def _candle(radius: float, height: float) -> Solid:
    """Candle with a molten pool, runs of wax, a wick and a flame."""
    pool = lathe(
        [(radius - 7, height - 7), (radius - 3, height - 2), (radius - 3, height + 4)], segments=96
    )
    body = cut(lathe([(radius, 0), (radius, height - 1), (radius - 1, height)], segments=96), pool)
    runs = []
    for k in range(5):
        angle = 1.11 + 1.31 * k + 0.03 * height
        x, y = (radius - 0.4) * float(np.cos(angle)), (radius - 0.4) * float(np.sin(angle))
        runs.append(
            rod((x, y, height - 4), (x, y, height - 16 - 9 * ((k * 3) % 4)), 2.6, 3.4, rounded=True)
        )
    wick = post(height - 8, height + 10, 1.6)
    flame = ((0.6, 4), (4.5, 8), (6.6, 15), (4.6, 25), (0.6, 38))
    flame_side = curve([(radius, height + above) for radius, above in flame], 6)
    return union(body, *runs, wick, lathe(flame_side, segments=SMALL_SEGMENTS))


@upright(2.4, (0, -90, 0), (0, 0, 16), (0, -5, 0))
def duct_tape() -> Solid:
    """Roll of tape, 128 x 50 mm, on a cardboard core, its end lifted; stood on edge with the hole
    to the viewer."""
    turns = lathe([(64, 0), (64, 50)], 0.6)
    core = cut(post(-0.6, 50.6, 41), post(-2, 53, 38))
    rings = [(r, z) for r in range(45, 63, 4) for z in (-0.7, 49.1)]
    windings = [cut(post(z, z + 1.6, r + 0.8), post(-3, 55, r)) for r, z in rings]
    bent = np.linspace(-1.4, 0.15, 24)
    reach = 64.0 + 30 * np.clip(bent + 0.5, 0, 1) ** 2
    end = stroke(np.column_stack([reach * np.cos(bent), reach * np.sin(bent)]), 1.4).extrude(50)
    roll = union(cut(union(turns, end), post(-2, 53, 40)), core, *windings)
    return roll.translate((0, 0, -25))


@upright(3.0, (32, 0, 0), (0, 4, 4))
def banana() -> Solid:
    """Banana, about 190 mm along its bend: five blunt edges, a stalk and a dark tip."""
    bend = np.linspace(np.radians(-38), np.radians(46), 61)
    radius = 112.0
    path = np.column_stack([np.zeros_like(bend), radius * np.sin(bend), -radius * np.cos(bend)])
    along = np.linspace(0, 1, len(bend))
    knots = curve(
        [
            (0, 4.2),
            (0.03, 6.0),
            (0.09, 11.5),
            (0.22, 16.4),
            (0.45, 18.4),
            (0.66, 16.6),
            (0.8, 11.5),
            (0.88, 6.2),
            (0.95, 4.4),
            (1.0, 5.4),
        ]
    )
    girth = np.interp(along, knots[:, 0], knots[:, 1])
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.broadcast_to(np.array([1.0, 0.0, 0.0]), path.shape)
    above = np.cross(tangent, across)
    angle = angles(80)
    reach = girth[:, None] * (1 + 0.055 * np.cos(5 * angle + 0.6))[None, :]
    rings = path[:, None, :] + (reach * np.cos(angle))[:, :, None] * across[:, None, :]
    rings = rings + (reach * np.sin(angle))[:, :, None] * above[:, None, :]
    tip = rod(tuple(path[0]), tuple(path[0] + 0.6 * (path[0] - path[2])), 3.4, 2.8)
    return union(skin(rings), tip)


@upright(4.0, (4, -2, 0))
def marker() -> Solid:
    """Felt marker, 18 x 132 mm, its cap off at the writing end: stepped barrel, chisel tip, end
    plug."""
    side = [
        (7.6, 0),
        (8.6, 1),
        (8.6, 3),
        (9, 4),
        (9, 84),
        (8.4, 86),
        (8.4, 94),
        (5.6, 100),
        (5.2, 116),
        (3.4, 120),
    ]
    barrel = lathe(side)
    tip = cut(post(118, 131, 2.9, 2.7), place(block(12, 12, 10), (-4, 0, 131), (0, 40, 0)))
    label = wrapped(rectangle(52, 64), 9, 44, 0.3)
    words = wrapped(text_section("MARKER", 54).rotate(90), 9.2, 44, 0.6)
    grooves = [ring(9, 0.45, z) for z in (7, 9, 11, 80)]
    return union(cut(barrel, *grooves), tip, label, words)


@upright(4.2, (4, -2, 0))
def pen() -> Solid:
    """Retractable ballpoint, 12 x 145 mm: push button, clip, ribbed rubber grip and a fine
    point."""
    rib = ((0, 0), (0.5, 1), (1.3, 1), (1.8, 0))
    ribs = [(5.2 + 0.6 * proud, 21 + 2.6 * k + at) for k in range(11) for at, proud in rib]
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
    foot = block(5, 4.2, 5, 0.8, (-6.4, 0, 127.5))
    clip = union(block(2.2, 4.2, 52, 0.8, (-8.4, 0, 104)), foot, ball(2.2, (-7.6, 0, 79)))
    return union(barrel, button, clip)


@upright(4.9, (5, -3, 0))
def chalk_stick() -> Solid:
    """Stick of chalk, 14 x 84 mm: tapered, one end broken off, the other worn to a slope, a few
    chips."""
    body = lathe([(6.6, 0), (7.0, 0.6), (5.9, 83), (5.2, 84)], segments=72)
    worn = place(block(20, 20, 8), (-3, 0, 85), (0, -32, 0))
    breaks = ((4, 2, (14, 22, 0)), (-5, 4, (-20, -16, 0)), (0, -5, (24, 3, 0)))
    broken = [place(block(18, 18, 8), (x, y, -3.2), turn) for x, y, turn in breaks]
    places = ((-1, 0.2, 22), (0.6, 0.8, 40), (0.3, -0.95, 61), (-0.7, -0.7, 70))
    chips = [ball(2.2, (8.1 * c, 8.1 * s, z)) for c, s, z in places]
    return cut(body, worn, *broken, *chips)


@drawn(2.55, (0, 12, 0))
def eyeglasses() -> Solid:
    """Spectacles, 140 mm wide, on open temples: rims with lenses, bridge, nose pads, hinges, hooked
    ear ends."""
    rim = superellipse(56, 46, 2.6, 96)
    parts: list[Solid] = []
    for side in (-1, 1):
        loop = np.column_stack([rim[:, 0] + side * 35, rim[:, 1], 0 * rim[:, 0]])
        temple = [(66, 9, -2), (68, 9, -28), (68, 8, -72), (67, 1, -96), (66, -18, -112)]
        arm = [(8.5, 1, 0), (8, -2, -4), (9.5, -7, -7)]
        parts += [
            tube(loop, 2.3, flatten=1.2, closed=True, sides=20),
            plate(polygon(rim).translate((side * 35, 0)), 1.6),
            tube(
                curve([(side * x, y, z) for x, y, z in temple]),
                2.0,
                flatten=1.9,
                up=(0, 1, 0.2),
                sides=20,
            ),
            block(8, 9, 9, 2, (side * 65, 9, -2)),
            place(
                Solid.sphere(4, 32).scale((0.5, 1.3, 0.9)), (side * 9.5, -7, -7), (0, side * 30, 0)
            ),
            tube(curve([(side * x, y, z) for x, y, z in arm]), 0.9, up=(1, 0, 0), sides=12),
        ]
    parts.append(
        tube(curve([(-9, 6, 0), (-4, 9.5, 1), (4, 9.5, 1), (9, 6, 0)]), 2.3, flatten=1.2, sides=20)
    )
    return union(*parts)


@upright(4.9, (0, -3, 0))
def battery() -> Solid:
    """Round cell, 26 x 50 mm, tipped to show its positive nub: crimped collar, sleeve with
    lettering."""
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
    lines = [wrapped(rectangle(30, 1.2), 13, z, 0.45) for z in (15, 29)]
    words = union(*lettered(13, 0.5, ("+", 9, 41), ("-", 7, 6), ("BATTERY", 32, 22)), *lines)
    return union(body, nub, collar, words)


@drawn(4.2, (0, -1, 2))
def battery_case() -> Solid:
    """Open holder with four cells head to tail, 66 x 60 x 18 mm: springs, contact tabs, ribs and
    two leads."""
    tray = cut(block(68, 64, 17, 1.2), block(62, 60.5, 17, 0.5, (0, 0, 3)))
    walls = [block(62, 1.4, 8, 0, (0, y, -4)) for y in (-15, 0, 15)]
    cells = []
    for lane, y in enumerate((-22.5, -7.5, 7.5, 22.5)):
        side = 1 if lane % 2 else -1
        cell = lathe(
            [(6.8, 0), (7.1, 0.4), (7.1, 46.6), (6.4, 47.4), (2.7, 47.5), (2.7, 49.4)], segments=72
        )
        cell = place(cell, (-side * 24, y, 1), (0, side * 90, 0))
        spring = [
            place(ring(4.0 - 0.3 * k, 0.7), (-side * (30.4 - 1.6 * k), y, 1), (0, 90, 0))
            for k in range(4)
        ]
        stem = rod((-side * 31, y, 1), (-side * 23, y, 1), 3.2)
        plus = place(text_section("+", 5).extrude(1.4), (side * 17, y, 7.4))
        cells += [cell, stem, plus, *spring, block(1.4, 9, 11, 0, (side * 31, y, 2))]
    leads = [
        tube(curve([(30, y, -4), (37, y, -4), (41, y + 5, -3), (42, 20 + y, 0)]), 1.3, sides=20)
        for y in (6, 12)
    ]
    clips = [block(8, 4, 5, 1, (x, s * 31, 8)) for x in (-16, 16) for s in (-1, 1)]
    return union(tray, *walls, *cells, *leads, *clips)


def _carton(
    width: float, height: float, depth: float, lines: list[tuple[str, float, float]], *art: Solid
) -> Solid:
    """Drawn carton: glued flaps on top and bottom, text lines (words, width, height) on both large
    faces."""
    front = [
        text_plate(words, size, 1.8).translate((0, at, depth / 2)) for words, size, at in lines
    ]
    front += [solid.translate((0, 0, depth / 2)) for solid in art]
    frame = plate(rectangle(width - 10, height - 10) - rectangle(width - 14, height - 14), 1.2)
    face = union(*front, frame.translate((0, 0, depth / 2)))
    flaps = [
        block(width - 1, 1.2, depth * 0.62, 0.5, (0, s * height / 2, depth * 0.16)) for s in (-1, 1)
    ]
    seam = block(1.2, height - 2, depth * 0.5, 0, (width / 2, 0, depth * 0.2))
    return union(block(width, height, depth, 0.8), face, face.rotate((0, 180, 0)), *flaps, seam)


@drawn(1.75, (0, 0, 3))
def cracker_box() -> Solid:
    """Cracker carton, 160 x 213 x 60 mm, with its name and three pricked crackers in relief."""
    pricked = disc(22)
    for hole in ((4.5 * i, 4.5 * j) for i in (-2, 0, 2) for j in (-2, 0, 2)):
        pricked = pricked - disc(1.6, hole)
    crackers = [
        plate(pricked.rotate(14 * k), 4).translate((47.0 * k, -35 - 9 * (k % 2), 0))
        for k in (-1, 0, 1)
    ]
    return _carton(160, 213, 60, [("CRACKERS", 138, 62), ("CRISP", 70, 28)], *crackers)


@drawn(2.1, (0, 0, 2))
def sugar_box() -> Solid:
    """Sugar carton, 89 x 176 x 40 mm, with a pouring flap drawn out at its side."""
    flap = place(plate(polygon([(0, 0), (24, 0), (15, 17), (6, 17)]), 22), (44, 48, 0), (0, 0, -62))
    cubes = [
        block(17, 17, 5, 1, (x, y, 0)).rotate((0, 0, 4))
        for x, y in ((-20, -56), (0, -56), (20, -56), (-10, -37))
    ]
    body = _carton(89, 176, 40, [("SUGAR", 74, 38), ("PURE", 40, 6)], *cubes)
    return union(body, flap)


@drawn(2.7, (0, -1.5, 3))
def pudding_box() -> Solid:
    """Pudding carton, 112 x 90 x 36 mm, with a filled glass in relief."""
    half = [(16, 20), (11, -4), (3, -8), (3, -16), (11, -20)]
    glass = plate(polygon([(-16, 20), *half, *((-x, y) for x, y in half[:0:-1])]), 4)
    cream = plate(disc(7, (-7, 20)) + disc(8, (4, 22)) + disc(4, (0, 30)), 5)
    art = [solid.translate((30, -10, 0)) for solid in (glass, cream)]
    body = _carton(112, 90, 36, [("PUDDING", 92, 29), ("MILK", 38, -2)], *art)
    return body


@drawn(3.3, (0, -1.5, -3))
def gelatin_box() -> Solid:
    """Gelatin carton, 88 x 73 x 29 mm, with a moulded jelly in relief."""
    mould = plate(polygon([(-24, 0), (24, 0), (20, 9), (11, 20), (-11, 20), (-20, 9)], 3), 5)
    ribs = [plate(stroke([(x, 3), (0.5 * x, 18)], 2.4), 7) for x in (-17, -8.5, 0, 8.5, 17)]
    dish = plate(rectangle(62, 4, 1.9, (0, -2)), 5)
    art = [solid.translate((0, -25, 0)) for solid in (mould, dish, *ribs)]
    body = _carton(88, 73, 29, [("GELATIN", 72, 18)], *art)
    return body


@upright(2.1, (0, -0.4, 2))
def wood_block() -> Solid:
    """Square timber block, 85 x 85 x 200 mm, with drying cracks, grain on its ends and one
    chamfered corner."""
    body = block(85, 85, 200, 1.5)
    lines = ((-42, 15, 50, 120, 2), (-42, -21, -48, 105, -2), (42, 6, -20, 150, 2))
    cracks = [
        place(block(10, 1.8, length, 0), (x, y, z), (0, tilt, 0)) for x, y, z, length, tilt in lines
    ]
    sides = [
        place(block(1.6, 10, length, 0), at)
        for at, length in (((10, 42, 40), 130), ((-14, -42, -25), 140))
    ]
    grain = [plate(disc(r) - disc(r - 1.6), 3) for r in (9, 17, 25, 33, 40)]
    ends = [solid.translate((6, -4, s * 100)) for solid in grain for s in (-1, 1)]
    knot = rod((-39, -12, 30), (-46, -12, 30), 9)
    chipped = place(block(20, 20, 40), (-42, 42, 96), (0, 30, 45))
    return cut(body, *cracks, *sides, *ends, knot, chipped)


@upright(1.65, (0, 0, 90), (0, 14, 0))
def open_book() -> Solid:
    """Open book standing on its lower edge, 2 x 150 x 215 mm: bowed page blocks between boards."""
    spread = 24.0  # degrees by which each leaf turns towards the reader
    leaf = curve([(3, 3), (14, 15), (38, 20), (80, 16), (120, 12), (146, 10)])
    pages = polygon([*leaf, (146, 0), (3, 0)])
    sheet = stroke(curve([(4, 4), (15, 19), (39, 27), (80, 27), (118, 31), (142, 38)]), 1.0)
    cover = rectangle(155, 3.4, 1.2, (76, -1.6)).extrude(215).translate((0, 0, -5))
    right = union(pages.extrude(205), sheet.extrude(205), cover).rotate((0, 0, spread))
    inked = pages.offset(0.9)
    lines = ((182, 60), *((164 - 11 * k, 98 - 7 * (k % 3)) for k in range(11)), (43, 50))
    drawn = [(z, inked ^ rectangle(width, 60, 0, (28 + width / 2, 0))) for z, width in lines]
    text = [line.extrude(3.4).translate((0, 0, z)).rotate((0, 0, spread)) for z, line in drawn]
    spine = post(-5, 210, 4, at=(0, -1.5))
    left = union(pages.extrude(205), cover).rotate((0, 0, spread)).mirror((1, 0, 0))
    printed = [line.mirror((1, 0, 0)) for line in text]
    ribbon = stroke([(0, 14), (9, 22), (13, 26)], 1.6).extrude(150).translate((0, 0, -22))
    book = union(right, left, spine, ribbon, *printed)
    return book


@upright(1.27, (0, -9, 6))
def magazine_stack() -> Solid:
    """Ten slightly rotated magazines, 212 x 280 mm, thick and thin, the topmost with its cover
    curling up."""
    turns = (3, -5, 8, -2, -9, 6, 1, -7, 11, -4)
    thickness = (9, 7, 12, 8, 10, 7, 11, 9, 8, 10)
    shifts = (
        (0, 0),
        (5, -4),
        (-6, 3),
        (3, 6),
        (-4, -7),
        (7, 2),
        (-3, 5),
        (4, -3),
        (-7, -2),
        (2, 4),
    )
    magazines, base = [], 0.0
    for turn, thick, (dx, dy) in zip(turns, thickness, shifts, strict=True):
        pages = block(206, 276, thick - 1.6, 0, (1, 0, thick / 2))
        covers = [block(212, 280, 0.8, 0, (0, 0, z)) for z in (0.4, thick - 0.4)]
        spine = block(3, 280, thick, 0, (-104.5, 0, thick / 2))
        magazines.append(place(union(pages, spine, *covers), (dx, dy, base), (0, 0, turn)))
        base += thick - 0.3  # pressed together: the stack is one body
    title = place(text_plate("MAGAZINE", 170, 1.2), (-62, 4, base), (0, 0, -94))
    photo = place(block(110, 150, 2.0, 0), (22, 8, base), (0, 0, -4))
    curl = curve([(-40, 0), (20, 1), (70, 8), (104, 26), (112, 36)])
    cover = place(stroke(curl, 1.4).extrude(280), (2, 144, base), (90, 0, -4))
    return union(*magazines, title, photo, cover)


@upright(1.0)
def wooden_boards() -> Solid:
    """Planks at full size: a low pile running away from the camera and five taller planks leaning
    back behind it."""
    pile = []
    for layer in range(4):
        for lane in (-1, 1):
            shift, length = 6.0 * ((3 * layer + lane) % 4) - 8, 462 - 12 * ((2 * layer + lane) % 3)
            plank = block(
                length, 88, 24, 1.5, (shift, lane * 47.0, 12 + 25.0 * layer - 1.0 * layer)
            )
            pile.append(plank.rotate((0, 0, 1.2 * (layer % 3 - 1))))
    leaning = []
    for lane, (height, turn) in enumerate(
        ((470, 1.5), (430, -1.0), (500, 0.5), (455, -1.5), (485, 1.0))
    ):
        plank = cut(block(20, 82, height, 1.5, (0, 0, height / 2)), *_knots(lane, height))
        leaning.append(place(plank, (64, (lane - 2) * 74.0, 0), (turn, 18, 0)))
    return union(*pile, *leaning)


def _knots(seed: int, height: float) -> list[Solid]:
    """Four nail holes through a plank and a shallow knot on each of its faces."""
    spots = [(-20, 30), (20, 30), (-20, height - 30), (20, height - 30)]
    holes = [rod((-20, y, z), (20, y, z), 3.0) for y, z in spots]
    where = [
        (12 - 11 * (seed % 3), height * (0.38 + 0.09 * (seed % 4))),
        (-14 + 9 * (seed % 4), height * 0.74),
    ]
    knots = [
        rod((side * 9.2, y, z), (side * 20, y, z), 9)
        for (y, z), side in zip(where, (-1, 1), strict=True)
    ]
    return [*holes, *knots]
