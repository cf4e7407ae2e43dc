"""Least median of squares by trying every minimal subset (section 5; Rousseeuw & Leroy 1987).

Slow and plain on purpose; imports nothing of the product.
"""

import itertools

import numpy as np


def exhaustive(x, y, values):
    """The plane through three samples with the least median of joint squared residuals.

    values : (n, C). Returns (median, (3, C) coefficients of 1, x, y). Subsets that span no area are left out.
    """
    table = np.stack([np.ones_like(x), x, y], 1)
    best = (np.inf, None)
    for subset in itertools.combinations(range(len(x)), 3):
        square = table[list(subset)]
        if abs(np.linalg.det(square)) < 2:
            continue
        coef = np.linalg.solve(square, values[list(subset)])
        residuals = ((values - table @ coef) ** 2).sum(axis=1)
        median = np.sort(residuals)[len(x) // 2]
        if median < best[0]:
            best = (median, coef)
    return best
