"""Surface areas of 14-DOPs (kernels/units/kdop.py) in closed form, for the surface area heuristic."""

import numpy as np

DIAGONALS = np.array([[1.0, 1.0, 1.0], [-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, -1.0]])
Bounds = tuple[np.ndarray, np.ndarray]


def kdop_areas(nodes: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Return the area of both children of KdopNode records, (2, N): 0 for a missing child, inf if not finite. middle: origin of cuts."""
    out = np.empty((2, len(nodes)))
    for i, side in enumerate("01"):
        lo, hi = (nodes[f"{end}_{side}"].astype(np.float64) - middle for end in ("lo", "hi"))
        cut_lo, cut_hi = (nodes[f"cut_{end}_{side}"].astype(np.float64) for end in ("lo", "hi"))
        with np.errstate(invalid="ignore"):
            area = kdop_area(lo, hi, cut_lo, cut_hi)
        out[i] = np.where((lo > hi).any(axis=1), 0.0, np.where(np.isfinite(area), area, np.inf))
    return out


def kdop_area(lo: np.ndarray, hi: np.ndarray, cut_lo: np.ndarray, cut_hi: np.ndarray) -> np.ndarray:
    """Return the surface area (N,) of boxes lo, hi, (N, 3), inside the slabs cut_lo .. cut_hi, (N, 4), along the four DIAGONALS."""
    axes = [(lo[:, i], hi[:, i]) for i in range(3)]
    # A plane outside of the box is moved to the box, because its distance would cancel all digits of an area.
    cuts = [(np.maximum(cut_lo[:, k], np.minimum(sign * lo, sign * hi).sum(axis=1)),
             np.minimum(cut_hi[:, k], np.maximum(sign * lo, sign * hi).sum(axis=1))) for k, sign in enumerate(DIAGONALS)]
    total = np.zeros(len(lo))
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        for x in axes[a]:
            total += box_face(x, axes[b], axes[c], cuts[0], cuts[a + 1], cuts[b + 1], cuts[c + 1])
    total += askew_faces(axes, cuts)
    for a in range(3):  # mirroring axis a makes diagonal a + 1 the first diagonal
        b, c = (a + 1) % 3, (a + 2) % 3
        mirrored, turned = list(axes), list(cuts)
        mirrored[a] = negated(axes[a])
        turned[0], turned[a + 1] = cuts[a + 1], cuts[0]
        turned[b + 1], turned[c + 1] = negated(cuts[c + 1]), negated(cuts[b + 1])
        total += askew_faces(mirrored, turned)
    return total


def negated(bounds: Bounds) -> Bounds:
    return -bounds[1], -bounds[0]


def wedge(t: np.ndarray) -> np.ndarray:
    """Return the area of the triangle y, z >= 0, y + z <= t."""
    t = np.maximum(t, 0.0)
    return 0.5 * t * t


def box_face(x: np.ndarray, y: Bounds, z: Bounds, sum_all: Bounds, minus_x: Bounds, minus_y: Bounds, minus_z: Bounds) -> np.ndarray:
    """Return the area of the box's face at x inside all four slabs. sum_all: bounds of x + y + z; minus_x: of -x + y + z; and so on."""
    up = np.maximum(sum_all[0] - x, minus_x[0] + x), np.minimum(sum_all[1] - x, minus_x[1] + x)  # y + z
    across = np.maximum(minus_y[0] - x, x - minus_z[1]), np.minimum(minus_y[1] - x, x - minus_z[0])  # z - y
    area = (below(y, z, up[1], across[1]) - below(y, z, up[0], across[1])
            - below(y, z, up[1], across[0]) + below(y, z, up[0], across[0]))
    return np.where((up[0] < up[1]) & (across[0] < across[1]), np.maximum(area, 0.0), 0.0)


def below(y: Bounds, z: Bounds, q: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Return the area of the rectangle y, z under a roof: the lines y + z = q and z - y = s, which meet at y = (q - s) / 2."""
    ridge = np.clip(0.5 * (q - s), y[0], y[1])
    height = z[1] - z[0]

    def integral(t: np.ndarray) -> np.ndarray:  # of clip(t, 0, height)
        return np.where(t > height, (t - 0.5 * height) * height, wedge(t))

    rising = integral(s + ridge - z[0]) - integral(s + y[0] - z[0])
    falling = integral(q - ridge - z[0]) - integral(q - y[1] - z[0])
    return rising + falling


def askew_faces(axes: list[Bounds], cuts: list[Bounds]) -> np.ndarray:
    """Return the total area of the two faces perpendicular to the first diagonal. axes: bounds in x, y, z; cuts: along DIAGONALS.

    A face is a hexagon. Its projection along x is a rectangle in y and z, cut by two lines y + z = const.
    """
    (x0, x1), total = axes[0], np.zeros(len(axes[0][0]))
    for end in (0, 1):
        b = cuts[0][end]
        y0, y1 = np.maximum(axes[1][0], 0.5 * (b - cuts[2][1])), np.minimum(axes[1][1], 0.5 * (b - cuts[2][0]))
        z0, z1 = np.maximum(axes[2][0], 0.5 * (b - cuts[3][1])), np.minimum(axes[2][1], 0.5 * (b - cuts[3][0]))
        p, q = np.maximum(b - x1, 0.5 * (cuts[1][0] + b)), np.minimum(b - x0, 0.5 * (cuts[1][1] + b))
        area = sum(sign * (wedge(end - y0 - z0) - wedge(end - y1 - z0) - wedge(end - y0 - z1) + wedge(end - y1 - z1))
                   for sign, end in ((1.0, q), (-1.0, p)))
        total += np.where((y0 < y1) & (z0 < z1) & (p < q), np.sqrt(3.0) * np.maximum(area, 0.0), 0.0)
    return total
