"""Which triangle a ray meets: a depth buffer for the camera's rays, a box tree for any other;
compiled, in float64.

The signs of three edge functions, ``d . (a x b)`` for the edge from a to b seen from the ray's
origin, decide: triangles that share an edge have exactly opposite values for it, so no ray passes
between them. Without fastmath and fused multiply-add every processor gives the same answer (see
`fpp_ml_bench.machine`).
"""

import numpy as np

from fpp_ml_bench.machine import njit

SLACK = 1e-9
"""Boxes are widened by this, in m or normalised units: far above float64's rounding, far below a
pixel."""
NARROWED_FROM_PX = 8
"""From this width on the columns of a row that a triangle can cover are computed, and not just
tried."""
_NEAR_M = 1e-6
"""Distance in front of the camera, in m, below which a triangle's image has no bounds, and all rays
are tried."""


@njit
def rasterise(  # type: ignore[no-untyped-def]
    corners, normals, offsets, x, y, columns, rows, left, top, wanted, depth_m, triangle
):
    """Nearest triangle of each pixel in a window, and its depth. Fills ``depth_m`` (inf before) and
    ``triangle`` (-1).

    ``corners`` (F, 3, 3) in m, camera at the origin; unit ``normals`` (F, 3) and plane ``offsets``
    (F,); rays ``x`` and ``y`` (H, W), of which the window starts at column ``left`` and row
    ``top``. ``columns`` (2, W): the greatest x up to each column, and the least x from it on;
    ``rows`` (2, H): the same of y. Only the rays ``wanted`` bool (H, W).
    """
    height, width = depth_m.shape
    reach_x = max(abs(columns[0, -1]), abs(columns[1, 0]))
    reach_y = max(abs(rows[0, -1]), abs(rows[1, 0]))
    for f in range(corners.shape[0]):
        a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
        # Edge functions: e_k = gx[k] x + gy[k] y + gz[k].
        gx0, gy0, gz0 = (
            b[1] * c[2] - b[2] * c[1],
            b[2] * c[0] - b[0] * c[2],
            b[0] * c[1] - b[1] * c[0],
        )
        gx1, gy1, gz1 = (
            c[1] * a[2] - c[2] * a[1],
            c[2] * a[0] - c[0] * a[2],
            c[0] * a[1] - c[1] * a[0],
        )
        gx2, gy2, gz2 = (
            a[1] * b[2] - a[2] * b[1],
            a[2] * b[0] - a[0] * b[2],
            a[0] * b[1] - a[1] * b[0],
        )
        nearest, farthest = min(a[2], b[2], c[2]), max(a[2], b[2], c[2])
        if farthest <= 0.0:
            continue
        first_row, last_row, first, last = 0, height - 1, 0, width - 1
        bounded = nearest > _NEAR_M
        if bounded:
            xa, xb, xc = a[0] / a[2], b[0] / b[2], c[0] / c[2]
            ya, yb, yc = a[1] / a[2], b[1] / b[2], c[1] / c[2]
            first = max(np.searchsorted(columns[0], min(xa, xb, xc) - SLACK) - left, 0)
            last = min(np.searchsorted(columns[1], max(xa, xb, xc) + SLACK) - left, width - 1)
            first_row = max(np.searchsorted(rows[0], min(ya, yb, yc) - SLACK) - top, 0)
            last_row = min(np.searchsorted(rows[1], max(ya, yb, yc) + SLACK) - top, height - 1)
        nx, ny, nz, offset = normals[f, 0], normals[f, 1], normals[f, 2], offsets[f]
        turn = gx0 * a[0] + gy0 * a[1] + gz0 * a[2]
        size = abs(gx0 * a[0]) + abs(gy0 * a[1]) + abs(gz0 * a[2])
        # The sign of a triangle seen edge-on is noise, so nothing is left out by it.
        narrowed = bounded and last - first >= NARROWED_FROM_PX and abs(turn) > 1e-12 * size
        for row in range(first_row, last_row + 1):
            begin, end = first, last
            if narrowed:
                low, high = -np.inf, np.inf
                y_low, y_high = rows[1, top + row], rows[0, top + row]
                for k in range(3):
                    gx, gy, gz = (
                        (gx0, gy0, gz0)
                        if k == 0
                        else ((gx1, gy1, gz1) if k == 1 else (gx2, gy2, gz2))
                    )
                    if turn < 0.0:
                        gx, gy, gz = -gx, -gy, -gz
                    rest = max(gy * y_low, gy * y_high) + gz
                    rest += 1e-14 * (abs(gx) * reach_x + abs(gy) * reach_y + abs(gz))
                    if gx > 0.0:
                        low = max(low, -rest / gx)
                    elif gx < 0.0:
                        high = min(high, -rest / gx)
                    elif rest < 0.0:
                        high = -np.inf
                begin = max(first, np.searchsorted(columns[0], low - SLACK) - left)
                end = min(last, np.searchsorted(columns[1], high + SLACK) - left)
            for column in range(begin, end + 1):
                if not wanted[top + row, left + column]:
                    continue
                dx, dy = x[top + row, left + column], y[top + row, left + column]
                e0 = gx0 * dx + gy0 * dy + gz0
                e1 = gx1 * dx + gy1 * dy + gz1
                e2 = gx2 * dx + gy2 * dy + gz2
                inside = (e0 >= 0.0) & (e1 >= 0.0) & (e2 >= 0.0)
                inside |= (e0 <= 0.0) & (e1 <= 0.0) & (e2 <= 0.0)
                if inside:
                    depth = offset / (nx * dx + ny * dy + nz)
                    # A triangle that is seen edge-on has no depth of its own there, but it is
                    # bounded.
                    depth = min(max(depth, nearest), farthest) if np.isfinite(depth) else nearest
                    if 0.0 < depth < depth_m[row, column]:
                        depth_m[row, column] = depth
                        triangle[row, column] = f


@njit
def build_tree(corners, order, starts, boxes):  # type: ignore[no-untyped-def]
    """An implicit binary tree over triangles ``corners`` (F, 3, 3): fills ``order``, ``starts`` and
    ``boxes``.

    Node k of ``boxes`` (2 L, 6), least x, y, z and greatest, has the children 2 k and 2 k + 1; the
    root is 1 and the L leaves, a power of two, come last. Leaf j holds the triangles
    ``order[starts[j]:starts[j + 1]]``. Every node is halved at the median of its triangles' centres
    along its longest side.
    """
    count, leaves = corners.shape[0], boxes.shape[0] // 2
    centres = np.empty((count, 3))
    for f in range(count):
        order[f] = f
        for axis in range(3):
            centres[f, axis] = corners[f, 0, axis] + corners[f, 1, axis] + corners[f, 2, axis]
    for leaf in range(leaves + 1):
        starts[leaf] = leaf * count // leaves
    span = leaves
    while span > 1:
        for leaf in range(0, leaves, span):
            part = order[starts[leaf] : starts[leaf + span]]
            longest, axis = -1.0, 0
            for k in range(3):
                low, high = np.inf, -np.inf
                for f in part:
                    low, high = min(low, centres[f, k]), max(high, centres[f, k])
                if high - low > longest:
                    longest, axis = high - low, k
            along = np.empty(part.size)
            for i in range(part.size):
                along[i] = centres[part[i], axis]
            part[:] = part[np.argsort(along)]
        span //= 2
    boxes[:, :3], boxes[:, 3:] = np.inf, -np.inf
    for leaf in range(leaves):
        for f in order[starts[leaf] : starts[leaf + 1]]:
            for axis in range(3):
                for k in range(3):
                    node = leaves + leaf
                    boxes[node, axis] = min(boxes[node, axis], corners[f, k, axis] - SLACK)
                    boxes[node, 3 + axis] = max(boxes[node, 3 + axis], corners[f, k, axis] + SLACK)
    for node in range(leaves - 1, 0, -1):
        for axis in range(3):
            boxes[node, axis] = min(boxes[2 * node, axis], boxes[2 * node + 1, axis])
            boxes[node, 3 + axis] = max(boxes[2 * node, 3 + axis], boxes[2 * node + 1, 3 + axis])


@njit
def nearest_hit(corners, starts, boxes, origins, targets, any_suffices, along, triangle):  # type: ignore[no-untyped-def]
    """The nearest triangle between each origin and its target, both (n, 3): fills ``triangle``
    int32 (n,), -1 for none, and ``along`` float64 (n,), its place as a share of the way, 1 for
    none. With ``any_suffices`` any triangle will do.

    ``corners`` in the order of the tree (`build_tree`), which ``triangle`` counts in. The boxes
    only save work: they are wider than what they hold, so the answer is that of all triangles; of
    two at the same place the earlier one.
    """
    leaves = boxes.shape[0] // 2
    stack = np.empty(64, np.int64)
    for i in range(origins.shape[0]):
        ox, oy, oz = origins[i, 0], origins[i, 1], origins[i, 2]
        dx, dy, dz = targets[i, 0] - ox, targets[i, 1] - oy, targets[i, 2] - oz
        ix, iy, iz = 1.0 / dx, 1.0 / dy, 1.0 / dz
        best, seen = 1.0, -1
        size = 1
        stack[0] = 1
        while size > 0 and not (any_suffices and seen >= 0):
            size -= 1
            node = stack[size]
            near, far = 0.0, best
            # NaN (0 times inf: the ray runs in the plane of a side) leaves both bounds as they are.
            s, t = (boxes[node, 0] - ox) * ix, (boxes[node, 3] - ox) * ix
            near, far = max(near, min(s, t)), min(far, max(s, t))
            s, t = (boxes[node, 1] - oy) * iy, (boxes[node, 4] - oy) * iy
            near, far = max(near, min(s, t)), min(far, max(s, t))
            s, t = (boxes[node, 2] - oz) * iz, (boxes[node, 5] - oz) * iz
            near, far = max(near, min(s, t)), min(far, max(s, t))
            if near > far or boxes[node, 0] > boxes[node, 3]:
                continue
            if node < leaves:
                stack[size], stack[size + 1] = 2 * node, 2 * node + 1
                size += 2
                continue
            for f in range(starts[node - leaves], starts[node - leaves + 1]):
                ax, ay, az = corners[f, 0, 0] - ox, corners[f, 0, 1] - oy, corners[f, 0, 2] - oz
                bx, by, bz = corners[f, 1, 0] - ox, corners[f, 1, 1] - oy, corners[f, 1, 2] - oz
                cx, cy, cz = corners[f, 2, 0] - ox, corners[f, 2, 1] - oy, corners[f, 2, 2] - oz
                e0 = dx * (by * cz - bz * cy) + dy * (bz * cx - bx * cz) + dz * (bx * cy - by * cx)
                e1 = dx * (cy * az - cz * ay) + dy * (cz * ax - cx * az) + dz * (cx * ay - cy * ax)
                e2 = dx * (ay * bz - az * by) + dy * (az * bx - ax * bz) + dz * (ax * by - ay * bx)
                inside = (e0 >= 0.0) & (e1 >= 0.0) & (e2 >= 0.0)
                inside |= (e0 <= 0.0) & (e1 <= 0.0) & (e2 <= 0.0)
                if not inside:
                    continue
                ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
                nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
                share = (nx * ax + ny * ay + nz * az) / (nx * dx + ny * dy + nz * dz)
                if 0.0 < share < best or (share == best and seen > f):
                    best, seen = share, f
        along[i], triangle[i] = best, seen
