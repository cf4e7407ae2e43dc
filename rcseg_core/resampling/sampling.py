"""Inverse depth at places between the pixels of a grid, and the way back.

The nearest pixel's value would be off by half a pixel's slope, a saw-tooth far above the noise of an oblique
plane; a blend of neighbours would float between two surfaces at a step. So the nearest value is moved by a
limited slope: exact on planes, the smoother side's beside a step.
"""

import numpy as np

from rcseg_core.compute.jit import kernel


@kernel
def _slope(before, here, after):  # type: ignore[no-untyped-def]
    """Monotonised central difference (van Leer 1977); 0 stands for an unknown neighbour.

    Exact on planes; beside a step it follows the smoother side, and it never leaves the range of both.
    """
    if before <= 0.0 and after <= 0.0:
        return 0.0
    if before <= 0.0:
        return after - here
    if after <= 0.0:
        return here - before
    a = here - before
    b = after - here
    if a * b <= 0.0:
        return 0.0
    least = min(2.0 * abs(a), 2.0 * abs(b), 0.5 * abs(a + b))
    return least if a > 0.0 else -least


@kernel
def sample_inverse_depth(inverse, rows, cols, shown, source):  # type: ignore[no-untyped-def]
    """Inverse depth at fractional places of the grid: the nearest pixel's, moved by its slope.

    inverse : (H, W) float64, 0 where unknown; rows, cols : (h, w) float64, NaN outside of the grid.
    Out: shown (h, w) float64, 0 where unknown; source (h, w) int64 flat index of the nearest pixel, or -1.
    """
    height, width = inverse.shape
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            shown[i, j] = 0.0
            source[i, j] = -1
            if np.isnan(rows[i, j]) or np.isnan(cols[i, j]):
                continue
            r = min(max(int(np.floor(rows[i, j] + 0.5)), 0), height - 1)
            c = min(max(int(np.floor(cols[i, j] + 0.5)), 0), width - 1)
            source[i, j] = r * width + c
            here = inverse[r, c]
            if here <= 0.0:
                continue
            up = inverse[r - 1, c] if r > 0 else 0.0
            down = inverse[r + 1, c] if r < height - 1 else 0.0
            left = inverse[r, c - 1] if c > 0 else 0.0
            right = inverse[r, c + 1] if c < width - 1 else 0.0
            by_row, by_col = _slope(up, here, down), _slope(left, here, right)
            shown[i, j] = max(here + by_row * (rows[i, j] - r) + by_col * (cols[i, j] - c), 0.0)


@kernel
def find_back(inverse, at_x, at_y, rows, cols, shown, source, back):  # type: ignore[no-untyped-def]
    """The virtual pixel that shows each pixel of the grid.

    The nearest of those that were sampled from it; where none was (the grid is finer there), the one of the
    3x3 about its place that has the most similar inverse depth.

    at_x, at_y : (H, W) float64, virtual column and row of each pixel; the rest as in `sample_inverse_depth`.
    Out: back (H, W) int64 flat index, -1 for pixels without range.
    """
    height, width = inverse.shape
    nearest = np.full((height, width), np.inf)
    back[:, :] = -1
    for i in range(shown.shape[0]):
        for j in range(shown.shape[1]):
            if shown[i, j] <= 0.0:
                continue
            r = source[i, j] // width
            c = source[i, j] - r * width
            far = (rows[i, j] - r) ** 2 + (cols[i, j] - c) ** 2
            if far < nearest[r, c]:
                nearest[r, c] = far
                back[r, c] = i * shown.shape[1] + j
    for r in range(height):
        for c in range(width):
            if inverse[r, c] <= 0.0 or back[r, c] >= 0:
                continue
            y = int(np.floor(at_y[r, c] + 0.5))
            x = int(np.floor(at_x[r, c] + 0.5))
            least = np.inf
            for i in range(max(y - 1, 0), min(y + 2, shown.shape[0])):
                for j in range(max(x - 1, 0), min(x + 2, shown.shape[1])):
                    far = abs(shown[i, j] - inverse[r, c])
                    if shown[i, j] > 0.0 and far < least:
                        least = far
                        back[r, c] = i * shown.shape[1] + j
