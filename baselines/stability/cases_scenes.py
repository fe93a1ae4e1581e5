"""Scenes: edge-on walls, needles, broken meshes, one and ten million triangles, the camera inside the object."""

from fpp_ml_bench.baselines.stability import scenes_checks as check
from fpp_ml_bench.baselines.stability.case import Case, family


def cases() -> list[Case]:
    """The cases of this group."""
    group = "scenes"
    return [
        *family(
            group, "wall edge-on", check.edge_on, {"off_deg": (90.0, 30.0, 5.0, 1.0, 0.3, 0.1, 0.01, 1e-4, 0.0)},
            computes="depth of a wall at this angle to the line of sight",
            reference="ray and plane in 80-bit arithmetic",
            predicts="264 u kappa, kappa = sum |n d| over |n . d|; never beyond the wall's own extent", unit="m",
            expects=lambda off_deg: "number" if off_deg >= 1 else "either",
        ),
        *family(
            group, "needle", check.needle,
            {"centre_px": (0.0, 0.3), "width_px": (2.5, 1.0, 0.9, 0.5, 0.1, 0.01)},
            computes="pixels of an upright strip at 1.8 m, and their depth", reference="the columns that it covers",
            predicts="exact where no edge is within 1e-9 px of a centre; depth 64 u", unit="px, m",
        ),
        *family(
            group, "broken mesh", check.broken,
            {"kind": ("degenerate triangles", "collinear triangles", "flipped triangles", "every triangle twice",
                      "non-manifold fin", "loose vertices", "open back")},
            computes="outline, depth and normals of a ball with this defect", reference="the ball without it",
            predicts="same outline; depth 64 u x 1.8 m x condition of the most oblique facet", unit="m",
        ),
        *family(
            group, "no solid triangle", check.nothing_solid, {},
            computes="a mesh of triangles without area", reference="there is no surface", predicts="must be refused",
            unit="m", expects="refusal",
        ),
        *family(
            group, "number of triangles", check.triangles, {"count": (1.0, 1e2, 1e4, 1e6, 1e7)},
            computes="depth of a paraboloid of this number of triangles", reference="the paraboloid, closed form",
            predicts="chord error 1.3 step^2 / 2 and 64 u x 1.8 m; one triangle: 64 u", unit="m",
            heavy=lambda count: count > 1e6,
        ),
        *family(
            group, "camera inside the object", check.camera_inside, {"turn_deg": (0.0, 45.0, 10.0, 89.9)},
            computes="depth of the walls of a 2 m box around the camera", reference="1 / max |d|, closed form",
            predicts="64 u", unit="m",
        ),
        *family(
            group, "misplaced object", check.placed_around, {"name": ("around the camera", "too large", "shifted out")},
            computes="placing an object that does not fit range and image", reference="there is no such sample",
            predicts="must be refused", unit="m", expects="refusal",
        ),
        *family(
            group, "behind the camera", check.behind_camera, {},
            computes="pixels of a wall behind the camera", reference="none", predicts="must see nothing", unit="m",
            expects="refusal",
        ),
        *family(
            group, "light at distance 0", check.light_at_projector, {},
            computes="light on a point in the projector's centre", reference="finite and not negative",
            predicts="must be finite", unit="grey",
        ),
    ]  # fmt: skip
