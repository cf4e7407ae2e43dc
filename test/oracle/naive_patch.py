"""Bezier patches, least squares and their errors by direct sums over pixels (eq. 8-15, 18-21).

Slow and plain on purpose; imports nothing of the product. Boxes are (row_min, col_min, row_max, col_max).
"""

import math

import numpy as np


def bernstein(k, m, t):
    """Eq. (9)."""
    return math.factorial(k) / (math.factorial(k - m) * math.factorial(m)) * t**m * (1 - t) ** (k - m)


def evaluate(control, u, v):
    """Eq. (8) for one channel: control (k+1, k+1), first index along u."""
    k = len(control) - 1
    total = 0.0
    for i in range(k + 1):
        for j in range(k + 1):
            total += control[i][j] * bernstein(k, i, u) * bernstein(k, j, v)
    return total


def local(rows, cols, box):
    """(u, v) of pixels on the region's own box."""
    row_min, col_min, row_max, col_max = box
    u = (np.asarray(cols, float) - col_min) / max(col_max - col_min, 1)
    v = (np.asarray(rows, float) - row_min) / max(row_max - row_min, 1)
    return u, v


def design(k, u, v):
    """L^T of eq. (12): one row a pixel, one column B_i(u) B_j(v), j fastest."""
    table = np.empty((len(u), (k + 1) ** 2))
    for n in range(len(u)):
        for i in range(k + 1):
            for j in range(k + 1):
                table[n, i * (k + 1) + j] = bernstein(k, i, u[n]) * bernstein(k, j, v[n])
    return table


def fit(k, rows, cols, values, box):
    """Eq. (12)-(13) by numpy's least squares on the pixels; control points (k+1, k+1) of one channel."""
    u, v = local(rows, cols, box)
    return np.linalg.lstsq(design(k, u, v), np.asarray(values, float), rcond=None)[0].reshape(k + 1, k + 1)


def residual_covariance(k, rows, cols, values, controls, box):
    """Eq. (14) over n - p for channels at once: mean products of the residuals; values (n, C)."""
    u, v = local(rows, cols, box)
    table = design(k, u, v)
    rest = values - np.stack([table @ control.ravel() for control in controls], 1)
    return rest.T @ rest / (len(rows) - (k + 1) ** 2)


def standard_errors(k, rows, cols, sigma2, box):
    """Root of eq. (15) with n - p: the textbook's sigma^2 diag (X^T X)^-1."""
    u, v = local(rows, cols, box)
    table = design(k, u, v)
    return np.sqrt(sigma2 * np.diag(np.linalg.inv(table.T @ table))).reshape(k + 1, k + 1)


def monomials(x, y, exponents):
    return np.stack([x**a * y**b for a, b in exponents], 1)


def rss_of_fit(x, y, values, exponents):
    """Residual sum of squares of the best polynomial with these terms; values (n,) or (n, C)."""
    table = monomials(x, y, exponents)
    coef = np.linalg.lstsq(table, values, rcond=None)[0]
    return float(((values - table @ coef) ** 2).sum())


def rise(x, y, values, own, exponents, joint):
    """How much more the model fitted to all pixels costs the pixels in `own` than their own model does.

    own : (n,) bool mask; joint : pixels that the common model is fitted to, (n,) bool.
    """
    table = monomials(x, y, exponents)
    common = np.linalg.lstsq(table[joint], values[joint], rcond=None)[0]
    alone = np.linalg.lstsq(table[own], values[own], rcond=None)[0]
    return float(((values - table @ common)[own] ** 2).sum() - ((values - table @ alone)[own] ** 2).sum())


def c_ib(x_b, y_b, values_b, x_i, y_i, values_i, n_range, degree, beta, half_x, half_y):
    """Eq. (21) pixel by pixel with p = (k+1)^2; values are whitened, range channels first.

    The local domain of Tr R^-1 is region b's box scaled to [-1, 1]; its centre is the origin of x and y.
    """
    exponents = [(a, b) for a in range(degree + 1) for b in range(degree + 1)]
    p = len(exponents)
    table_b, table_i = monomials(x_b, y_b, exponents), monomials(x_i, y_i, exponents)
    scaled = monomials(x_b / half_x, y_b / half_y, exponents)
    trace = float(np.trace(np.linalg.inv(scaled.T @ scaled)))
    total = 0.0
    for channels in (range(n_range), range(n_range, values_b.shape[1])):
        variance_b = 0.0
        for c in channels:
            coef = np.linalg.lstsq(table_b, values_b[:, c], rcond=None)[0]
            total += float(((values_i[:, c] - table_i @ coef) ** 2).sum())  # eq. (18)
            variance_b += float(((values_b[:, c] - table_b @ coef) ** 2).sum()) / (len(x_b) - p)
        total += variance_b * trace / (beta**2 * (len(x_b) - p))
    return total
