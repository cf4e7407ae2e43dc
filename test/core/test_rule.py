"""The one budget of the criterion: what coefficients gain on error alone, by simulation of such an error."""

import cv2
import numpy as np
import pytest
from oracle.naive_graph import error_gain

from rcseg_core.decision.rule import error_budget

SHAPE, DRAWS = (40, 56), 1000
PIXELS = SHAPE[0] * SHAPE[1]
#: Terms x^a y^b that a model gains: of a plane, of a quadric on a plane, of a cubic on a quadric.
GRID = [(a, b) for a in range(4) for b in range(4)]
MODELS = {
    3: ([], [(0, 0), (1, 0), (0, 1)]),
    5: ([t for t in GRID if max(t) <= 1], [t for t in GRID if max(t) == 2]),
    7: ([t for t in GRID if max(t) <= 2], [t for t in GRID if max(t) == 3]),
}


def directions(q):
    """(pixels, q) orthonormal directions that the q new terms add to those of the lower model."""
    rows, cols = np.indices(SHAPE).reshape(2, -1)
    x, y = cols / (SHAPE[1] - 1) * 2 - 1, rows / (SHAPE[0] - 1) * 2 - 1
    low, new = MODELS[q]
    table = np.stack([x**a * y**b for a, b in [*low, *new]], axis=1)
    return np.linalg.qr(table)[0][:, len(low) :]


def correlated(rng, blur):
    """Noise of unit variance, and the pixels that make one independent measurement of it."""
    if blur == 0:
        return rng.normal(size=SHAPE), 1.0
    margin = int(np.ceil(4 * blur))
    noise = cv2.GaussianBlur(rng.normal(size=(SHAPE[0] + 2 * margin, SHAPE[1] + 2 * margin)), (0, 0), blur)
    # Gaussian correlation exp(-d^2 / 4 s^2): a single pixel keeps 1 / (4 pi s^2) of the variance
    noise *= np.sqrt(4 * np.pi) * blur
    return noise[margin:-margin, margin:-margin], 4 * np.pi * blur**2


def gains(q, blur, kappa, smooth, seed=0):
    rng = np.random.default_rng(seed)
    axes = directions(q)
    out = np.empty(DRAWS)
    for draw in range(DRAWS):
        noise, _ = correlated(rng, blur)
        out[draw] = np.sum((axes.T @ (noise.ravel() + kappa * smooth(rng, axes))) ** 2)
    return out


def along_the_terms(rng, axes):
    """An error of rms 1 on average that the new terms follow altogether, any of them alike."""
    return axes @ rng.normal(size=axes.shape[1]) * np.sqrt(PIXELS / axes.shape[1])


def waves(rng, axes):
    """An error of rms 1 that bends over the whole image: a few slow waves."""
    rows, cols = np.indices(SHAPE).reshape(2, -1)
    total = np.zeros(PIXELS)
    for _ in range(3):
        u, v = rng.uniform(-0.7, 0.7, 2)
        phase = 2 * np.pi * (u * cols / SHAPE[1] + v * rows / SHAPE[0] + rng.random())
        total += rng.normal() * np.cos(phase)
    return total / np.sqrt(np.mean(total**2))


@pytest.mark.parametrize("smooth", [along_the_terms, waves])
@pytest.mark.parametrize("kappa", [0.0, 0.1, 0.5])
@pytest.mark.parametrize("blur", [0.0, 1.5])
@pytest.mark.parametrize("q", list(MODELS))
def test_error_alone_exceeds_the_budget_in_less_than_one_of_a_hundred_draws(q, blur, kappa, smooth):
    found = gains(q, blur, kappa, smooth)
    m = max(4 * np.pi * blur**2, 1.0)
    assert np.mean(found > error_budget(m, kappa**2, PIXELS, q)) < 0.01
    if (
        smooth is along_the_terms
    ):  # no wider than it must be; cubic terms see a third less of correlated noise
        assert 0.6 < found.mean() / (q * m + PIXELS * kappa**2) < 1.1


@pytest.mark.parametrize("n", [10.0, 1e3, 1e5])
@pytest.mark.parametrize("q", [1, 3, 9, 48])
def test_the_budget_is_a_mean_and_four_deviations(q, n):
    for m, kappa in ((1.0, 0.0), (28.0, 0.0), (1.0, 0.4), (12.0, 0.05)):
        assert error_budget(m, kappa**2, n, q) == pytest.approx(error_gain(m, kappa**2, n, q), rel=1e-12)


def test_what_pixels_do_not_average_away_grows_with_them_and_the_rest_does_not():
    few, many = (error_budget(5.0, 0.0, n, 9) for n in (100.0, 1e6))
    assert few == many
    few, many = (error_budget(0.0, 0.04, n, 9) for n in (100.0, 1e6))
    assert many == pytest.approx(1e4 * few)
