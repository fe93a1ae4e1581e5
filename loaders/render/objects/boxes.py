"""Cartons, books, magazines and timber: things with flat faces. Drawn in millimetres at their real size."""

import numpy as np

from fpp_ml_bench.loaders.render.objects.solids import (
    Solid,
    block,
    curve,
    cut,
    disc,
    facing,
    place,
    plate,
    polygon,
    rectangle,
    rod,
    stroke,
    text_plate,
    union,
)


def _carton(width: float, height: float, depth: float, lines: list[tuple[str, float, float]], *art: Solid) -> Solid:
    """Drawn carton: glued flaps on top and bottom, text lines (words, width, height) on both large faces."""
    front = [text_plate(words, size, 1.8).translate((0, at, depth / 2)) for words, size, at in lines]
    front += [solid.translate((0, 0, depth / 2)) for solid in art]
    frame = plate(rectangle(width - 10, height - 10) - rectangle(width - 14, height - 14), 1.2)
    face = union(*front, frame.translate((0, 0, depth / 2)))
    flaps = [block(width - 1, 1.2, depth * 0.62, 0.5, (0, s * height / 2, depth * 0.16)) for s in (-1, 1)]
    seam = block(1.2, height - 2, depth * 0.5, 0, (width / 2, 0, depth * 0.2))
    return union(block(width, height, depth, 0.8), face, face.rotate((0, 180, 0)), *flaps, seam)


def cracker_box() -> Solid:
    """Cracker carton, 160 x 213 x 60 mm, with its name and three pricked crackers in relief."""
    holes = [(4.5 * i, 4.5 * j) for i in (-2, 0, 2) for j in (-2, 0, 2)]
    pricked = disc(22)
    for hole in holes:
        pricked = pricked - disc(1.6, hole)
    crackers = [plate(pricked.rotate(14 * k), 4).translate((47.0 * k, -35 - 9 * (k % 2), 0)) for k in (-1, 0, 1)]
    return place(facing(_carton(160, 213, 60, [("CRACKERS", 138, 62), ("CRISP", 70, 28)], *crackers)), turn=(0, 0, 3))


def sugar_box() -> Solid:
    """Sugar carton, 89 x 176 x 40 mm, with a pouring flap drawn out at its side."""
    flap = place(plate(polygon([(0, 0), (24, 0), (15, 17), (6, 17)]), 22), (44, 48, 0), (0, 0, -62))
    cubes = [block(17, 17, 5, 1, (x, y, 0)).rotate((0, 0, 4)) for x, y in ((-20, -56), (0, -56), (20, -56), (-10, -37))]
    body = _carton(89, 176, 40, [("SUGAR", 74, 38), ("PURE", 40, 6)], *cubes)
    return place(facing(union(body, flap)), turn=(0, 0, 2))


def pudding_box() -> Solid:
    """Pudding carton, 112 x 90 x 36 mm, with a filled glass in relief."""
    glass = plate(
        polygon(
            [(-16, 20), (16, 20), (11, -4), (3, -8), (3, -16), (11, -20), (-11, -20), (-3, -16), (-3, -8), (-11, -4)]
        ),
        4,
    )
    cream = plate(disc(7, (-7, 20)) + disc(8, (4, 22)) + disc(4, (0, 30)), 5)
    art = [solid.translate((30, -10, 0)) for solid in (glass, cream)]
    body = _carton(112, 90, 36, [("PUDDING", 92, 29), ("MILK", 38, -2)], *art)
    return place(facing(body), turn=(0, -1.5, 3))


def gelatin_box() -> Solid:
    """Gelatin carton, 88 x 73 x 29 mm, with a moulded jelly in relief."""
    mould = plate(polygon([(-24, 0), (24, 0), (20, 9), (11, 20), (-11, 20), (-20, 9)], 3), 5)
    ribs = [plate(stroke([(x, 3), (0.5 * x, 18)], 2.4), 7) for x in (-17, -8.5, 0, 8.5, 17)]
    dish = plate(rectangle(62, 4, 1.9, (0, -2)), 5)
    art = [solid.translate((0, -25, 0)) for solid in (mould, dish, *ribs)]
    body = _carton(88, 73, 29, [("GELATIN", 72, 18)], *art)
    return place(facing(body), turn=(0, -1.5, -3))


def wood_block() -> Solid:
    """Square timber block, 85 x 85 x 200 mm, with drying cracks, grain on its ends and one chamfered corner."""
    body = block(85, 85, 200, 1.5)
    cracks = [
        place(block(10, 1.8, length, 0), (x, y, z), (0, tilt, 0))
        for x, y, z, length, tilt in ((-42, 15, 50, 120, 2), (-42, -21, -48, 105, -2), (42, 6, -20, 150, 2))
    ]
    sides = [
        place(block(1.6, 10, length, 0), (x, y, z)) for x, y, z, length in ((10, 42, 40, 130), (-14, -42, -25, 140))
    ]
    grain = [plate(disc(r) - disc(r - 1.6), 3) for r in (9, 17, 25, 33, 40)]
    ends = [solid.translate((6, -4, s * 100)) for solid in grain for s in (-1, 1)]
    knot = rod((-39, -12, 30), (-46, -12, 30), 9)
    chipped = place(block(20, 20, 40), (-42, 42, 96), (0, 30, 45))
    return place(cut(body, *cracks, *sides, *ends, knot, chipped), turn=(0, -0.4, 2))


def open_book() -> Solid:
    """Open book standing on its lower edge, 2 x 150 x 215 mm: bowed page blocks between boards."""
    spread = 24.0  # degrees by which each leaf turns towards the reader
    leaf = curve([(3, 3), (14, 15), (38, 20), (80, 16), (120, 12), (146, 10)])
    pages = polygon(np.concatenate([leaf, [(146, 0), (3, 0)]]))
    loose = curve([(4, 4), (15, 19), (39, 27), (80, 27), (118, 31), (142, 38)])
    sheet = stroke(loose, 1.0)
    cover = rectangle(155, 3.4, 1.2, (76, -1.6))
    right = union(pages.extrude(205), sheet.extrude(205), cover.extrude(215).translate((0, 0, -5))).rotate(
        (0, 0, spread)
    )
    inked = pages.offset(0.9)
    text = [
        (inked ^ rectangle(width, 60, 0, (28 + width / 2, 0))).extrude(3.4).translate((0, 0, z)).rotate((0, 0, spread))
        for z, width in ((182, 60), *((164 - 11 * k, 98 - 7 * (k % 3)) for k in range(11)), (43, 50))
    ]
    spine = rod((0, -1.5, -5), (0, -1.5, 210), 4)
    left = union(pages.extrude(205), cover.extrude(215).translate((0, 0, -5))).rotate((0, 0, spread)).mirror((1, 0, 0))
    printed = [line.mirror((1, 0, 0)) for line in text]
    ribbon = stroke([(0, 14), (9, 22), (13, 26)], 1.6).extrude(150).translate((0, 0, -22))
    book = union(right, left, spine, ribbon, *printed)
    return place(book, turn=(0, 0, 90)).rotate((0, 14, 0))


def magazine_stack() -> Solid:
    """Ten slightly rotated magazines, 212 x 280 mm, thick and thin, the topmost with its cover curling up."""
    turns = (3, -5, 8, -2, -9, 6, 1, -7, 11, -4)
    thickness = (9, 7, 12, 8, 10, 7, 11, 9, 8, 10)
    shifts = ((0, 0), (5, -4), (-6, 3), (3, 6), (-4, -7), (7, 2), (-3, 5), (4, -3), (-7, -2), (2, 4))
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
    return place(union(*magazines, title, photo, cover), turn=(0, -9, 6))


def wooden_boards() -> Solid:
    """Planks at full size: a low pile running away from the camera and five taller planks leaning back behind it."""
    pile = []
    for layer in range(4):
        for lane in (-1, 1):
            shift, length = 6.0 * ((3 * layer + lane) % 4) - 8, 462 - 12 * ((2 * layer + lane) % 3)
            plank = block(length, 88, 24, 1.5, (shift, lane * 47.0, 12 + 25.0 * layer - 1.0 * layer))
            pile.append(plank.rotate((0, 0, 1.2 * (layer % 3 - 1))))
    leaning = []
    for lane, (height, turn) in enumerate(((470, 1.5), (430, -1.0), (500, 0.5), (455, -1.5), (485, 1.0))):
        plank = cut(block(20, 82, height, 1.5, (0, 0, height / 2)), *_knots(lane, height))
        leaning.append(place(plank, (64, (lane - 2) * 74.0, 0), (turn, 18, 0)))
    return union(*pile, *leaning)


def _knots(seed: int, height: float) -> list[Solid]:
    """Four nail holes through a plank and a shallow knot on each of its faces."""
    spots = [(-20, 30), (20, 30), (-20, height - 30), (20, height - 30)]
    holes = [rod((-20, y, z), (20, y, z), 3.0) for y, z in spots]
    where = [(12 - 11 * (seed % 3), height * (0.38 + 0.09 * (seed % 4))), (-14 + 9 * (seed % 4), height * 0.74)]
    knots = [rod((side * 9.2, y, z), (side * 20, y, z), 9) for (y, z), side in zip(where, (-1, 1), strict=True)]
    return [*holes, *knots]
