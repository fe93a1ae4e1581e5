"""Hand tools: hammer, scissors, clamps, boxcutter, brushes and palette knives. Drawn flat in
millimetres, real size."""

import numpy as np
from solids import (
    Point2,
    Solid,
    around,
    ball,
    block,
    curve,
    cushioned,
    cut,
    disc,
    drawn,
    laid,
    lathe,
    loft,
    place,
    plate,
    polygon,
    post,
    rectangle,
    ring,
    rod,
    skin,
    softened,
    stroke,
    superellipse,
    symmetric,
    tube,
    union,
)


@drawn(1.8, (3, 0, 3))
def hammer() -> Solid:
    """Claw hammer, 330 mm long: turned face, cheek, forked claw, waisted grip with a bulged end."""
    handle = laid(
        loft(
            [
                (0, 26, 34, 2.4),
                (4, 30, 39, 2.4),
                (18, 29, 37, 2.4),
                (60, 25, 30, 2.3),
                (100, 26, 33, 2.3),
                (140, 23, 28, 2.2),
                (200, 18, 23, 2.0),
                (250, 18, 23, 2.0),
                (292, 20, 26, 2.4),
                (312, 20, 26, 2.4),
            ],
            smooth=6,
            sides=64,
        )
    )
    face = place(
        lathe([(14, 0), (17, 3), (17, 15), (13, 21), (12, 40)], 0.5), (64, 292, 0), (0, -90, 0)
    )
    cheek = block(46, 34, 30, 5, (4, 292, 0))
    spine = curve([(-10, 296), (-36, 300), (-62, 291), (-84, 268)])
    claw_wide = np.interp(np.arange(len(spine)), [0, len(spine) - 1], [15.0, 15.5])
    thick = np.interp(np.arange(len(spine)), [0, len(spine) - 1], [12.0, 2.0])
    rings = []
    for k, point in enumerate(spine):
        tangent = spine[min(k + 1, len(spine) - 1)] - spine[max(k - 1, 0)]
        normal = np.array([-tangent[1], tangent[0]]) / np.linalg.norm(tangent)
        section = superellipse(2 * thick[k], 2 * claw_wide[k], 4, 48)
        x, y = (point[k] + normal[k] * section[:, 0] for k in (0, 1))
        rings.append(np.column_stack([x, y, section[:, 1]]))
    wedge = polygon([(0, 2.5), (0, -2.5), (70, -7), (70, 7)])
    fork = place(plate(wedge, 90), (-40, 285, 0), (90, 0, 180))
    claw = cut(skin(np.array(rings)), fork)
    grooves = [
        place(ring(19, 2.0).scale((0.95, 0.8, 1)), (0, y, 0), (-90, 0, 0))
        for y in (34, 48, 62, 76, 90)
    ]
    return union(cut(handle, *grooves), face, cheek, claw)


@drawn(2.6, (3, 0, 2))
def scissors() -> Solid:
    """Household scissors, 205 mm long, a little open: two pointed blades, pivot screw, a round and
    a long bow."""
    blade = polygon([(-4, -20), (9, -20), (10, 10), (7, 70), (1.5, 108), (0, 108), (-6, 20)], 0.6)
    shank = stroke(curve([(2, -16), (2, -32), (7, -46), (12, -56)]), 12)
    halves = []
    for side, reach in ((1, 25.0), (-1, 36.0)):
        bow = np.linspace(0, 2 * np.pi, 72, endpoint=False)
        loop = np.column_stack([18.5 * np.cos(bow) + 13, reach * np.sin(bow) - 50 - reach, 0 * bow])
        ring_bow = tube(loop, 5.2, flatten=1.25, closed=True, sides=24)
        half = union(plate(blade, 3.2), plate(shank, 8), ring_bow).rotate((0, 0, 9))
        halves.append(
            half.translate((0, 0, 1.8))
            if side > 0
            else half.mirror((1, 0, 0)).translate((0, 0, -1.8))
        )
    slot = block(12, 1.4, 2, 0, (0, 0, 7.6)).rotate((0, 0, 35))
    pivot = union(post(-6.5, 6.5, 6), cut(post(5, 7.6, 5), slot))
    return union(*halves, pivot)


@drawn(2.15, (0, 0, 2))
def large_clamp() -> Solid:
    """Spring clamp, 200 mm long: two jaws with pads crossing at a coiled spring, handles with
    sleeves."""
    arm = stroke(curve([(18, -24), (0, 2), (-24, 30), (-34, 54), (-28, 76), (-14, 90)]), 22)
    lever = stroke(curve([(0, 0), (24, -34), (40, -66), (48, -100)]), 26)
    sleeve = stroke(curve([(31, -46), (40, -67), (48, -100)]), 34)
    slot = plate(stroke([(20, -28), (29, -46)], 7), 60)
    half = cut(union(plate(softened(arm + lever, 2), 20), plate(softened(sleeve, 1), 28)), slot)
    pad = union(
        place(block(10, 38, 30, 3), (-6.5, 90, 0), (0, 0, 3)), post(-17, 17, 6, at=(-12, 90))
    )
    ears = [plate(disc(19), 6).translate((0, 0, z)) for z in (-12, 12)]
    pin = post(-20, 20, 7)
    coil = [ring(12.5, 2.8, z) for z in (-16.4, -13.4, 13.4, 16.4)]
    legs = [
        tube(curve([(s * 11, -4, 14), (s * 22, -26, 14), (s * 31, -46, 12)]), 2.8, up=(0, 0, 1))
        for s in (-1, 1)
    ]
    both = union(half, pad, half.mirror((1, 0, 0)), pad.mirror((1, 0, 0)), pin, *ears, *coil, *legs)
    return both


@drawn(2.0, (0, 3, 3))
def clamp() -> Solid:
    """C-clamp, 150 mm tall: ribbed frame, threaded screw with swivel pad and sliding bar."""
    frame = stroke([(40, 62), (-34, 66), (-46, 54), (-46, -40), (-34, -52), (40, -48)], 20)
    frame = softened(frame + disc(14, (40, 62)) + disc(15, (40, -48)), 3)
    rib = stroke([(34, 62), (-33, 65), (-45, 53), (-45, -39), (-33, -51), (30, -48)], 8)
    anvil = rod((40, 44, 0), (40, 56, 0), 13)
    screw = rod((40, -118, 0), (40, 8, 0), 7.5)
    thread = [
        place(ring(7.6, 1.3), (40, y, 0), (90, 0, 4)) for y in np.arange(-96, -2, 3.6).tolist()
    ]
    pad = union(
        ball(9, (40, 8, 0)), rod((40, 8, 0), (40, 18, 0), 10, 15), rod((40, 17, 0), (40, 22, 0), 15)
    )
    boss = rod((40, -66, 0), (40, -34, 0), 14)
    bar = union(
        rod((2, -112, 8), (78, -112, -8), 4.2), ball(6.4, (2, -112, 8)), ball(6.4, (78, -112, -8))
    )
    head = ball(10.5, (40, -112, 0))
    parts = union(plate(frame, 12), plate(rib, 20), anvil, screw, pad, boss, bar, head, *thread)
    return parts


@drawn(2.5, (2, 0, 2))
def boxcutter() -> Solid:
    """Snap-off knife, 190 mm with its blade out: score lines, slider in its slot, ribbed grip, end
    clip."""
    handle = polygon(
        [(-15, -86), (15, -86), (16, -60), (13, -10), (14, 40), (10, 62), (-10, 62), (-14, 40)], 3
    )
    slot = rectangle(8, 104, 3.5, (2, -4))
    body = union(plate(handle, 13, 2.5), plate(rectangle(22, 26, 3, (0, -74)), 15, 2))
    body = cut(body, plate(slot, 8).translate((0, 0, 8)))
    teeth = [block(13, 1.6, 2.4, 0, (2, y, 10)) for y in (15, 19, 23, 27, 31)]
    slider = union(plate(rectangle(13, 26, 3, (2, 22)), 6, 1).translate((0, 0, 7)), *teeth)
    blade = plate(polygon([(-9, 40), (9, 40), (9, 104), (-9, 122)]), 2.0)
    scores = [place(block(26, 1.2, 3, 0), (0, y, 1.6), (0, 0, -35)) for y in (66, 77, 88, 99)]
    backs = [place(solid, (0, 0, 0), (0, 180, 0)).mirror((1, 0, 0)) for solid in scores]
    ribs = [block(35, 2.6, 9, 1, (0, y, 0)) for y in range(-58, -20, 7)]
    grips = [place(post(-20, 20, 5), (17, y, 0)) for y in (-44, -30, -16)]
    return union(cut(union(body, *ribs), *grips), slider, cut(blade, *scores, *backs))


def _handle(profile: list[Point2], flatten: float = 1.0) -> Solid:
    """Turned handle pointing down from the origin (x, y drawn), pressed flat towards the viewer."""
    shape = np.asarray(profile)
    turned = lathe([*(shape[:1] * (0.5, 1)), *curve(shape, 8)], segments=64)
    return turned.rotate((90, 0, 0)).scale((1, 1, flatten))


@drawn(2.35, (3, 0, 3))
def paint_brush() -> Solid:
    """Artist's flat brush, 230 mm: long turned handle, crimped ferrule, bristles coming to a
    rounded edge."""
    handle = _handle(
        [(11.5, 0), (14.0, 22), (13.0, 44), (8.0, 90), (6.4, 130), (5.2, 155), (4.0, 162)]
    )
    ferrule = loft(
        [(-6, 24, 22, 2), (2, 25, 23, 2), (20, 32, 17, 2.4), (38, 36, 14, 2.8)], smooth=4, sides=64
    )
    crimps = [place(ring(12.6, 1.2), (0, y, 0), (90, 0, 0)) for y in (0.5, 5.5)]
    levels = [
        (36, 35, 13, 2.8),
        (55, 41, 13, 2.6),
        (72, 40, 9, 2.4),
        (82, 33, 5, 2.2),
        (87, 22, 2.5, 2),
    ]
    bristles = loft(levels, smooth=5, sides=96)
    spots = [(x, s) for x in range(-15, 16, 5) for s in (-1, 1)]
    furrows = [
        place(block(0.9, 40, 2, 0), (x, 66, s * 5.6), (s * 4, 0, -0.12 * x)) for x, s in spots
    ]
    tuft = cut(laid(union(ferrule, bristles)), *furrows)
    return union(handle, tuft, *crimps)


@drawn(2.1, (4, -2, 4))
def paint_brush_large() -> Solid:
    """Wall brush, 100 mm wide: thick bristles, nailed ferrule, beaver-tail handle with a hanging
    hole."""
    ferrule = block(100, 42, 22, 2.5, (0, 20, 0))
    bands = [block(102, 4, 24, 1.5, (0, y, 0)) for y in (4, 36)]
    nails = [post(-12.2, 12.2, 2.2, at=(x, 20)) for x in (-40, -20, 0, 20, 40)]
    half = [
        (-48, 2),
        (-44, -14),
        (-22, -30),
        (-14, -52),
        (-15, -84),
        (-20, -112),
        (-15, -134),
        (0, -142),
    ]
    handle = cushioned(polygon(symmetric(half)), 14, 5, 19)
    handle = cut(handle, post(-20, 20, 6, at=(0, -126)))
    tuft = laid(
        loft([(38, 97, 20, 7), (60, 100, 22, 6), (92, 102, 16, 6), (104, 100, 6, 6)], smooth=5)
    )
    spots = [(x, s) for x in range(-45, 46, 6) for s in (-1, 1)]
    furrows = [place(block(1.2, 62, 4, 0), (x, 76, s * 11.4), (s * 4, 0, 0)) for x, s in spots]
    return union(ferrule, *bands, *nails, handle, cut(tuft, *furrows))


@drawn(2.15, (2, 0, 2))
def pallet_knife() -> Solid:
    """Trowel-shaped palette knife, 215 mm: leaf blade on a cranked neck, turned handle with a brass
    collar."""
    leaf = polygon(symmetric([(0, 120), (10, 106), (19, 76), (21, 54), (13, 36), (0, 30)]), 0.5)
    neck = tube(
        curve([(0, -6, 0), (0, 8, 1), (0, 20, 9), (0, 32, 16), (0, 46, 17)]),
        3.6,
        flatten=0.8,
        up=(1, 0, 0),
    )
    collar = place(lathe([(8, 0), (9, 3), (8, 9), (6, 11)], segments=48), (0, -11, 0), (-90, 0, 0))
    handle = _handle([(8.5, 8), (11.0, 26), (11.5, 50), (9.0, 76), (10.5, 94), (7.0, 104)])
    return union(plate(leaf, 2.6).translate((0, 0, 17)), neck, collar, handle)


@drawn(1.95, (2, 1, 2))
def pallet_knife_large() -> Solid:
    """Long palette knife, 290 mm: straight round-ended blade, bolster, riveted flat handle."""
    blade = polygon(
        [*symmetric([(12, 20), (17, 90), (18, 150), (14, 166), (0, 174)]), (-9, 0), (9, 0)]
    )
    bolster = block(26, 16, 15, 3, (0, 4, 0))
    half = [(-12, 4), (-15, -30), (-12, -62), (-16, -98), (-10, -116), (0, -120)]
    handle = cushioned(polygon(symmetric(half)), 15, 3.5, 20)
    rivets = [post(-11, 11, 3.6, at=(0, y)) for y in (-20, -56, -92)]
    return union(plate(blade, 3.0), bolster, handle, *rivets)


_TO_LEFT = (0, -90, 0)  # turns a lathe so that its top points to the viewer's left


@drawn(1.72, (0, 0, 1))
def power_drill() -> Solid:
    """Cordless drill, 230 x 215 mm: motor housing with vents, clutch ring, chuck and bit, grip,
    trigger, battery."""
    housing = lathe([(24, 0), *curve([(26, 4), (28, 30), (28, 70), (26.5, 92), (25, 107)])], 1)
    housing = place(housing, (62, 78, 0), _TO_LEFT)
    clutch = place(lathe([(25, 0), (26.5, 3), (26.5, 20), (24, 23)]), (-42, 78, 0), _TO_LEFT)
    knurls = [
        rod((-45, 78 + 26 * s, 26 * c), (-61, 78 + 26 * s, 26 * c), 1.5) for c, s in around(28)
    ]
    chuck = lathe([(22, 0), (22, 16), (20, 17), (20, 20), (21, 21), (20, 32), (10, 44), (6, 46)])
    chuck = place(chuck, (-64, 78, 0), _TO_LEFT)
    flutes = [
        rod((-84, 78 + 21.5 * s, 21.5 * c), (-100, 78 + 20.5 * s, 20.5 * c), 1.8)
        for c, s in around(14)
    ]
    bit_parts = ((-108, -124, 4.5, 4.5), (-122, -158, 3, 3), (-157, -163, 3, 0.4))
    bit = union(*(rod((x, 78, 0), (end, 78, 0), radius, tip) for x, end, radius, tip in bit_parts))
    front = curve([(2, 70), (2, 40), (10, 0), (18, -34), (20, -50)])
    back = curve([(66, -50), (62, -20), (58, 20), (60, 50), (62, 84)])
    grip = cushioned(polygon([*front, *back], 4), 30, 4, 40)
    trigger = union(
        plate(polygon([(4, 50), (-8, 44), (-8, 32), (0, 20), (12, 16), (10, 50)], 2), 16)
    )
    shoe = plate(polygon([(-8, -46), (74, -46), (80, -62), (-16, -62)], 3), 34)
    battery = block(104, 42, 36, 6, (30, -81, 0))
    latch = union(block(14, 12, 40, 3, (-4, -78, 0)), block(108, 3, 38, 1, (30, -70, 0)))
    vents = [block(5, 26, 80, 2, (x, 84, 0)) for x in (22, 31, 40, 49)]
    cap = place(lathe([(27, 0), (27, 6), (20, 12)], 1.5), (60, 78, 0), (0, 90, 0))
    body = cut(union(housing, cap, grip), *(v - block(200, 200, 56, 0, (0, 84, 0)) for v in vents))
    badge = plate(rectangle(38, 11, 4, (-14, 82)), 60)
    switch = post(-24, 24, 5, at=(8, 58))
    parts = union(
        body,
        clutch,
        *knurls,
        cut(chuck, *flutes),
        bit,
        trigger,
        shoe,
        battery,
        latch,
        badge,
        switch,
    )
    return parts


@drawn(1.45, (0, 0, 1))
def spraygun() -> Solid:
    """Gravity-feed spray gun, 250 mm tall: cup on top, air cap with horns, hooked body, trigger,
    grip and hose end."""
    body = place(
        lathe([(15, 0), (17, 4), (17, 60), (15, 84), (17, 88), (17, 96)], 1), (34, 60, 0), _TO_LEFT
    )
    cap = union(
        place(ring(18, 2.4).scale((1, 1, 2.6)), (-66, 60, 0), _TO_LEFT),
        place(lathe([(18, 0), (18, 8), (8, 13), (5, 18)]), (-60, 60, 0), _TO_LEFT),
        *(place(block(16, 9, 11, 2), (-76, 60 + s * 15, 0), (0, 0, s * 24)) for s in (-1, 1)),
    )
    front = curve([(4, 56), (6, 30), (16, -6), (24, -40), (28, -66)])
    back = curve([(58, -66), (54, -36), (46, -4), (42, 30), (56, 52), (60, 66), (48, 74)])
    grip = cushioned(polygon([*front, *back], 3), 18, 4, 25)
    hook = plate(stroke([(-18, 66), (-26, 84), (-38, 86)], 8), 8)
    trigger = plate(stroke(curve([(-34, 66), (-26, 34), (-14, 10), (-12, -12), (-24, -30)]), 9), 13)
    pivot = post(-21, 21, 6, at=(-33, 64))
    nut = place(post(0, 10, 15), (-34, 100, 0), (-90, 0, 0))
    stem = union(rod((-22, 60, 0), (-34, 102, 0), 10), nut)
    cup = lathe([(8, 0), *curve([(16, 2), (30, 14), (39, 34), (41, 60), (41, 92)])])
    lid = lathe([(43, 88), (43.5, 90), (43.5, 100), (30, 106), (8, 107), (8, 113), (5, 114)])
    cup = place(union(cup, lid), (-35, 106, 0), (-90, 0, 0))
    rows = [place(ring(43.3, 1.3), (-35, y, 0), (90, 0, 0)) for y in (197, 201, 205)]
    knob_ends = (
        (30, 60, 58, 60, 9),
        (56, 60, 72, 60, 12),
        (40, 36, 66, 32, 8),
        (62, 33, 76, 31, 10),
    )
    inlet_ends = ((43, -62, 46, -80, 11), (46, -78, 47, -86, 14), (47, -86, 49, -104, 7))
    knobs, inlet = (
        union(*(rod((x, y, 0), (end_x, end_y, 0), radius) for x, y, end_x, end_y, radius in ends))
        for ends in (knob_ends, inlet_ends)
    )
    return union(body, cap, grip, hook, trigger, pivot, stem, cup, knobs, inlet, *rows)
