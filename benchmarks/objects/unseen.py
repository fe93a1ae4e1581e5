"""The 20 objects of the set ``unseen``, of other kinds than the benchmark's 50: grooves and dishes
that light themselves up, thin, tall and stepped parts, and families given by a formula. In mm, as
large as they are in the scene.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from manifold3d import CrossSection, Manifold, OpType
from solids import (
    Solid,
    angles,
    around,
    block,
    curve,
    cut,
    disc,
    drawn,
    lathe,
    on_grid,
    place,
    plate,
    polygon,
    post,
    rectangle,
    rod,
    skin,
    tube,
    union,
    upright,
)

_ADD = OpType.Add
_TO_CAMERA = (0, -90, 0)  # turns a lathe so that its top points to the camera of the first view


@upright(1.0, (0, 0, 90), (18, 4, 0))
def v_groove() -> Solid:
    """A block with a groove of 90 degrees and one of 60 beside it, 380 x 300 mm."""
    outline = polygon(
        [
            (-190, 0),
            (190, 0),
            (190, 160),
            (165, 160),
            (110, 65),
            (55, 160),
            (30, 160),
            (-65, 65),
            (-160, 160),
            (-190, 160),
        ]
    )
    return outline.extrude(300)


@upright(1.0, _TO_CAMERA, (0, 6, 9))
def concave_dish() -> Solid:
    """A deep paraboloid with a flat rim, 400 mm across, open to the first view."""
    radius = np.linspace(14, 176, 24)
    front = np.column_stack([radius, radius * radius / 190])
    profile = [*(front - (0, 11))[:-1], (178, 152), (204, 152), (204, 163.5), *front[::-1]]
    return lathe(profile)


@upright(1.0, (3, 4, 0))
def hinged_leaves() -> Solid:
    """Two boards at 70 degrees, like a book that stands open, and the rod that they turn about."""
    leaves = [
        place(block(12, width, 330, 2, (0, side * width / 2, 0)), turn=(0, 0, side * 55))
        for side, width in ((1, 250), (-1, 210))
    ]
    return union(*leaves, post(-165, 165, 11))


@upright(1.0, (6, -4, 0))
def step_wedge() -> Solid:
    """Eight steps of 12 to 40 mm, 300 mm wide."""
    rises = np.cumsum([12, 40, 16, 36, 20, 32, 24, 28]).tolist()
    steps = [
        block(rise, 300, 44, 0, (-rise / 2, 0, 44 * (3.5 - k))) for k, rise in enumerate(rises)
    ]
    return union(*steps, block(40, 300, 352, 0, (18, 0, 0)))


@upright(1.0, (2, 3, 20))
def stair_tower() -> Solid:
    """Twelve sectors that climb 38 mm each about a column."""
    treads = []
    for k in range(12):
        turn = 2 * np.pi * (k + np.linspace(0, 1.02, 6)) / 12
        arc = np.column_stack([np.cos(turn), np.sin(turn)]) * 130
        treads.append(polygon([(0, 0), *arc]).extrude(60 + 38 * k))
    return union(*treads, lathe([(38, 0), (38, 560), (20, 590)]))


@drawn(1.0, (0, 5, 0))
def thin_fin() -> Solid:
    """A bent sheet 5 mm thick with a swept outline, on a foot."""
    outline = polygon(
        [
            *curve([(-160, -170), (-110, -40), (-20, 90), (90, 190)]),
            (170, 190),
            (150, 20),
            (130, -170),
        ]
    )
    sheet = _bent(plate(outline, 5), lambda x, y: 55 * (x / 160) ** 2 - 30 * (y / 180) ** 2)
    return union(sheet, block(311, 91, 83, 6, (-4, -163, 3)))


@upright(1.0)
def wire_loop() -> Solid:
    """A closed wire, 20 mm thick, that swings to and fro in three directions."""
    turn = angles(360)
    path = np.column_stack(
        [120 * np.sin(2 * turn + 0.4), 190 * np.sin(3 * turn), 250 * np.cos(turn)]
    )
    return tube(path, 10, up=(1, 0.3, 0.2), closed=True, sides=20)


@upright(1.0, (1, 2, 20))
def tall_column() -> Solid:
    """A fluted column on a square base, 660 mm."""
    shaft = lathe(
        [(66, 0), (66, 12), (58, 24), (56, 60), (48, 560), (56, 576), (70, 596), (70, 610)], 2
    )
    flutes = [
        rod((60 * x, 60 * y, 64), (52 * x, 52 * y, 548), 8, rounded=True) for x, y in around(16)
    ]
    ends = [block(150, 150, 30, 3, (0, 0, -14)), block(160, 160, 24, 3, (0, 0, 620))]
    return union(cut(shaft, *flutes), *ends)


@drawn(1.0, (9, 12, 0))
def gear() -> Solid:
    """A gear of 18 teeth with a hub, six lightening holes and a keyway, 390 mm across."""
    tooth = polygon([(150, -22), (174, -18), (194, -9), (194, 9), (174, 18), (150, 22)])
    wheel = CrossSection.batch_boolean(
        [disc(160), *(tooth.rotate(20 * k) for k in range(18))], _ADD
    )
    body = cut(plate(wheel, 56), *(post(-40, 40, 30, at=(98 * x, 98 * y)) for x, y in around(6)))
    hub = lathe([(62, -46), (62, 40), (54, 48)], 1)
    bore = union(post(-80, 80, 26), block(16, 66, 160, 0, (0, 0, 0)))
    return cut(union(body, hub), bore)


@upright(1.0)
def turbine_blade() -> Solid:
    """A twisted and tapered aerofoil on a root with three ribs, 560 mm."""
    along = np.concatenate([np.linspace(0, 1, 40), np.linspace(1, 0, 40)[1:-1]])
    side = np.concatenate([np.ones(40), -np.ones(38)])
    thickness = 5 * (
        0.2969 * np.sqrt(along)
        - 0.126 * along
        - 0.3516 * along**2
        + 0.2843 * along**3
        - 0.1036 * along**4
    )
    camber = 0.55 * along * (1 - along)
    rings = []
    for share in np.linspace(0, 1, 36).tolist():
        chord, turn = 210 - 70 * share, np.radians(30 + 50 * share)
        x, y = (along - 0.4) * chord, (camber + side * thickness * (0.17 - 0.07 * share)) * chord
        level = np.full(len(along), 480 * share)
        rings.append(
            np.column_stack(
                [np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y, level]
            )
        )
    root = [
        block(width, 180, 30, 6, (0, 0, -8 - 26 * k)) for k, width in enumerate((230, 205, 180))
    ]
    return union(skin(np.array(rings)), *root)


@upright(1.0)
def blob() -> Solid:
    """A smooth body like a bust: the level set of a sum of eight fading bumps."""
    bumps = (
        (0, 0, 150, 150),
        (-55, 0, 130, 95),
        (-70, 0, 175, 60),
        (0, 0, 40, 110),
        (0, 110, -80, 150),
        (0, -110, -80, 150),
        (-40, 30, -100, 150),
        (30, 0, -110, 170),
    )

    def height(x: float, y: float, z: float) -> float:
        total = -0.35
        for a, b, c, reach in bumps:
            left = 1 - ((x - a) * (x - a) + (y - b) * (y - b) + (z - c) * (z - c)) / (reach * reach)
            if left > 0:
                total += left * left * left
        return total

    body = Manifold.level_set(height, [-200, -290, -230, 200, 290, 300], 11, 0.0, 1e-9)
    return cut(body, block(600, 600, 200, 0, (0, 0, -280)))


@drawn(1.0, (8, 0, 5))
def saddle() -> Solid:
    """A hyperbolic paraboloid 14 mm thick, 380 x 360 mm."""
    sheet = _bent(block(380, 360, 14), lambda x, y: 75 * (x * x - y * y) / 190**2)
    return sheet


@drawn(1.0, (3, 5, 0))
def wave_plate() -> Solid:
    """A corrugated sheet: waves of 95 mm at a slant, with lower ones across."""
    sheet = _bent(
        block(360, 380, 16),
        lambda x, y: 22 * np.sin(2 * np.pi * (x + 0.35 * y) / 95) + 9 * np.sin(2 * np.pi * y / 210),
    )
    return sheet


@upright(1.0)
def sphere_pair() -> Solid:
    """Two balls that touch, and a third behind them."""
    centres = ((0, -92, -30, 112), (-30, 98, 20, 78), (40, 30, 130, 72))
    rods = [rod(first[:3], second[:3], 22) for first, second in pairwise(centres)]
    return union(
        *(Manifold.sphere(radius, 96).translate((x, y, z)) for x, y, z, radius in centres), *rods
    )


@upright(1.0, (7, -10, 0))
def cone_stack() -> Solid:
    """Five cones on top of each other, each smaller, like a fir."""
    profile = [(60, 0), (60, 30)]
    for k in range(5):
        profile += [(170 - 30 * k, 40 + 84 * k), (62 - 12 * k, 124 + 84 * k)]
    return lathe([*profile[:-1], (3, 500)], 1)


@upright(1.0, (28, 22, 15))
def hollow_cube() -> Solid:
    """The frame of a cube of 280 mm, and the sphere that its beams hold."""
    windows = [block(400, 200, 200), block(200, 400, 200), block(200, 200, 400)]
    beams = [
        rod(tuple(-100.0 * np.array(way)), tuple(100.0 * np.array(way)), 16)
        for way in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
    ]
    body = union(cut(block(280, 280, 280, 6), *windows), *beams, Manifold.sphere(70, 64))
    return body


@drawn(1.0, (6, 0, 4))
def perforated_plate() -> Solid:
    """A bent plate with 42 round holes of growing radius."""
    holes = [
        disc(8 + 1.1 * (i + j), (54 * i - 162, 58 * j - 145)) for i in range(7) for j in range(6)
    ]
    section = rectangle(400, 360, 20) - CrossSection.batch_boolean(holes, _ADD)
    return _bent(plate(section, 16), lambda x, y: -50 * (x / 200) ** 2)


@upright(1.0, (0, 10, 14))
def torus_knot() -> Solid:
    """A trefoil knot of a bar 56 mm thick."""
    turn = angles(300)
    ring = 118 + 58 * np.cos(3 * turn)
    path = np.column_stack(
        [85 * np.sin(3 * turn), ring * np.cos(2 * turn), ring * np.sin(2 * turn)]
    )
    return tube(path, 28, up=(1, 0, 0), closed=True, sides=40)


@upright(1.0, (15, 0, 30))
def spiral_shell() -> Solid:
    """A horn that winds out of its tip in two and a half turns, each wider."""
    share = np.linspace(0, 1, 150)
    turn, growth = 2 * np.pi * 2.5 * share, 0.16 * 6.25**share
    path = np.column_stack(
        [190 * growth * np.cos(turn), 190 * growth * np.sin(turn), 330 * (1 - growth)]
    )
    return tube(path, 84 * growth, sides=48)


@drawn(1.0, (5, 7, 4))
def honeycomb() -> Solid:
    """A plate of 31 hexagonal cells, 55 mm deep, closed at the back."""
    cell = CrossSection.circle(36, 6)
    steps = [
        (i, j)
        for i in range(-3, 4)
        for j in range(-3, 4)
        if abs(i + j) <= 3 and not abs(i) == abs(j) == 3
    ]
    spots = [(60 * i, 69.282 * (j + i / 2)) for i, j in steps]
    outline = CrossSection.batch_boolean(
        [CrossSection.circle(47, 6).translate(spot) for spot in spots], _ADD
    )
    cells = [cell.extrude(100).translate((*spot, -20)) for spot in spots]
    return cut(plate(outline, 64), *cells)


def _bent(sheet: Solid, height: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Solid:
    """A drawn sheet moved towards the viewer by ``height`` (x, y) mm."""

    def lift(points: np.ndarray) -> np.ndarray:
        return points + np.column_stack(
            [np.zeros((len(points), 2)), height(points[:, 0], points[:, 1])]
        )

    return on_grid(sheet).refine_to_length(8).warp_batch(lift)
