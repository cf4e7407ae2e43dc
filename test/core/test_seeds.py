"""Initial partition: least median of squares against every minimal subset, where windows lie (section 5)."""

from itertools import pairwise

import numpy as np
import pytest
from crafted import crafted_signals
from oracle import naive_lms
from scipy.stats import chi2

from rcseg_core.config import SeedsConfig
from rcseg_core.partition.seeds import first_state, fit_plane, initial_partition, joint_residuals, lms_inliers

CHANNELS = 4
HALF, CUT = chi2.ppf(0.5, CHANNELS), chi2.ppf(0.975, CHANNELS)


def window(seed, size=7, outliers=0.4, noise=1.0, far=60.0):
    """Samples of one window on a plane in four channels, a share of them far off; and which are good."""
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[:size, :size] - size // 2
    x, y = cols.ravel().astype(float), rows.ravel().astype(float)
    coef = rng.normal(0, 2, (3, CHANNELS))
    values = np.stack([np.ones_like(x), x, y], 1) @ coef + noise * rng.normal(size=(x.size, CHANNELS))
    bad = np.zeros(x.size, bool)
    bad[rng.choice(x.size, int(outliers * x.size), replace=False)] = True
    values[bad] += (
        far * rng.choice([-1, 1], (bad.sum(), CHANNELS)) * rng.uniform(0.5, 1.5, (bad.sum(), CHANNELS))
    )
    return np.column_stack([x, y, values]), bad, coef


def run_lms(samples, subsets=72, state=12345):
    n = len(samples)
    coef, trial = np.zeros((2, CHANNELS, 3))
    use = np.zeros(n, bool)
    inliers = lms_inliers(
        samples.T.copy(), n, 1, 1.0, 1.0, HALF, CUT, subsets, np.uint64(state), coef, trial, np.empty(n), use
    )
    assert inliers == use.sum()
    return use, coef


def test_fit_plane_is_least_squares_on_the_used_samples():
    samples, bad, _ = window(1)
    coef = np.empty((CHANNELS, 3))
    assert fit_plane(samples.T.copy(), ~bad, len(samples), coef)
    table = np.column_stack([np.ones(len(samples)), samples[:, :2]])[~bad]
    wanted = np.linalg.lstsq(table, samples[~bad, 2:], rcond=None)[0]
    np.testing.assert_allclose(coef, wanted.T, rtol=1e-9, atol=1e-9)


def test_fit_plane_refuses_a_line():
    samples, _, _ = window(1)
    use = samples[:, 1] == 0
    assert not fit_plane(samples.T.copy(), use, len(samples), np.empty((CHANNELS, 3)))
    use[:] = False
    use[:2] = True
    assert not fit_plane(samples.T.copy(), use, len(samples), np.empty((CHANNELS, 3)))


def test_joint_residuals_weigh_range_and_colour_apart():
    samples, _, coef = window(2)
    out = np.empty(len(samples))
    joint_residuals(samples.T.copy(), len(samples), coef.T.copy(), 1, 0.5, 2.0, out)
    rest = samples[:, 2:] - np.column_stack([np.ones(len(samples)), samples[:, :2]]) @ coef
    np.testing.assert_allclose(out, 0.5 * rest[:, 0] ** 2 + 2.0 * (rest[:, 1:] ** 2).sum(axis=1))


@pytest.mark.parametrize("seed", range(25))
def test_lms_finds_the_inliers_among_40_percent_outliers(seed):
    samples, bad, _ = window(seed, size=9)
    use, _ = run_lms(samples)
    assert not (use & bad).any(), "an outlier of 30 sigmas and more got in"
    # the cut keeps 97.5 % of what follows the plane exactly; the minimal plane itself is noisy
    assert use[~bad].mean() > 0.6


@pytest.mark.parametrize("seed", range(4))
def test_72_subsets_come_near_to_all_subsets(seed):
    samples, _, _ = window(seed, size=5)
    median, _ = naive_lms.exhaustive(samples[:, 0], samples[:, 1], samples[:, 2:])
    _, coef = run_lms(samples)
    table = np.column_stack([np.ones(len(samples)), samples[:, :2]])
    residuals = ((samples[:, 2:] - table @ coef.T) ** 2).sum(axis=1)
    ours = np.sort(residuals)[len(samples) // 2]
    assert median <= ours * (1 + 1e-9), "no plane can beat the exhaustive search"
    assert ours < 12 * median + 2 * HALF
    # with many subsets the two are one
    _, coef = run_lms(samples, subsets=20000)
    residuals = ((samples[:, 2:] - table @ coef.T) ** 2).sum(axis=1)
    assert np.sort(residuals)[len(samples) // 2] == pytest.approx(median, rel=1e-6)


@pytest.mark.parametrize("share", [1, 2, 3])
def test_three_pixels_on_a_line_use_up_no_subset(share):
    """One subset is enough for an exact plane, though few draws of pixels on two lines span one."""
    samples, _, _ = window(1, size=7, outliers=0.0, noise=0.0)
    x, y = samples[:, 0], samples[:, 1]
    cross = samples[(y == 0) | ((x == 0) & (np.abs(y) <= share))]
    for state in range(1, 100):
        use, _ = run_lms(cross, subsets=1, state=state * 0x9E3779B97F4A7C15 % 2**64)
        assert use.all()


def test_neighbouring_windows_draw_independently():
    states = [first_state(row, col, 11) for row in (40, 41) for col in range(400)]
    assert len(set(states)) == len(states) and 0 not in states
    different = [bin(int(a) ^ int(b)).count("1") for a, b in pairwise(states)]
    assert min(different) > 10 and np.mean(different) == pytest.approx(32, abs=4)
    pixels = np.bincount(np.array(states, np.uint64) % np.uint64(49), minlength=49)
    assert chi2.sf(((pixels - 800 / 49) ** 2 / (800 / 49)).sum(), 48) > 1e-3


def test_plain_least_squares_would_have_failed_there():
    """What the robust fit is for: the same windows by least squares keep outliers or lose the plane."""
    spoiled = 0
    for seed in range(25):
        samples, bad, _ = window(seed, size=9)
        coef = np.empty((CHANNELS, 3))
        fit_plane(samples.T.copy(), np.ones(len(samples), bool), len(samples), coef)
        table = np.column_stack([np.ones(len(samples)), samples[:, :2]])
        residuals = ((samples[:, 2:] - table @ coef.T) ** 2).sum(axis=1)
        spoiled += bool((residuals[~bad] > CUT).mean() > 0.3)
    assert spoiled > 20


def test_quantised_windows_have_a_scale_all_the_same():
    """More than half of the samples exactly on the plane: median zero, but noise is at least the sensor's."""
    samples, bad, _ = window(3, size=9, noise=0.0, outliers=0.3)
    samples[np.nonzero(~bad)[0][:8], 2] += 1.5
    use, _ = run_lms(samples)
    assert use[~bad].all()
    assert not use[bad].any()


def plane_image(seed=0, shape=(40, 50), step_at=None):
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    image = (0.3 * cols + 0.2 * rows)[..., None] + rng.normal(size=(*shape, CHANNELS))
    if step_at is not None:
        image[:, step_at:] += 40.0
    return image


def seeds(image, edges=None, flags=None, within=None, **changes):
    signals = crafted_signals(image, flags=flags)
    edges = np.zeros(signals.flags.shape, np.uint8) if edges is None else edges
    labels, count = initial_partition(signals, edges, SeedsConfig(**changes), within)
    present = np.unique(labels[labels > 0])
    assert np.array_equal(present, np.arange(1, count + 1))
    return labels, count


@pytest.mark.parametrize("fit", ["auto", "lms"])
def test_windows_cover_a_plane_and_none_overlaps_an_edge(fit):
    edges = np.zeros((40, 50), np.uint8)
    edges[:, 21] = 1
    edges[17, 22:] = 4
    labels, count = seeds(plane_image(), edges, fit=fit)
    assert not labels[edges > 0].any()
    assert (labels > 0).mean() > 0.8
    for k in range(1, count + 1):
        rows, cols = np.nonzero(labels == k)
        largest = 11 if fit == "lms" else 31  # windows of pure noise may be wider
        assert max(np.ptp(rows), np.ptp(cols)) < largest, "a seed is larger than the largest window"
        assert (cols < 21).all() or (cols > 21).all(), "a seed lies across an edge"
        assert (rows < 17).all() or (rows > 17).all() or (cols < 21).all()


def test_a_step_without_an_edge_parts_the_seeds_all_the_same():
    """The robust fit gives the window to one side and releases the other."""
    labels, count = seeds(plane_image(step_at=25))
    for k in range(1, count + 1):
        cols = np.nonzero(labels == k)[1]
        assert (cols < 25).mean() in (0.0, 1.0)
    assert (labels > 0).mean() > 0.7


def test_outliers_are_released_and_flagged_pixels_never_taken():
    image = plane_image()
    rng = np.random.default_rng(1)
    wild = rng.random((40, 50)) < 0.2
    image[wild] += 50.0 * rng.choice([-1, 1], (wild.sum(), CHANNELS))
    labels, _ = seeds(image)
    assert not labels[wild].any()
    assert (labels[~wild] > 0).mean() > 0.6
    labels, _ = seeds(plane_image(), flags=np.where(wild, 2, 0))
    assert not labels[wild].any()


@pytest.mark.parametrize("n_range", [0, 4])
def test_one_signal_alone_is_fitted_robustly_without_any_tolerance(n_range):
    """No range channel, or no colour, and no tolerance: nothing is divided by nothing."""
    signals = crafted_signals(plane_image(step_at=25), n_range)
    labels, _ = initial_partition(signals, np.zeros((40, 50), np.uint8), SeedsConfig(fit="lms"))
    assert (labels > 0).mean() > 0.7


def test_larger_windows_come_first_and_sizes_are_bounded():
    labels, _ = seeds(plane_image(), max_window=5, min_window=5, fit="lms")
    assert np.bincount(labels.ravel())[1:].max() <= 25
    labels, _ = seeds(plane_image(), fit="lms")
    areas = np.bincount(labels.ravel())[1:]
    assert areas[0] > 0.8 * 121, "the first seed is not of the largest window"


def test_seeds_keep_to_one_value_of_within():
    within = np.ones((40, 50), np.int32)
    within[:, 19:] = 2
    within[30:] = 0
    labels, count = seeds(plane_image(), within=within)
    assert not labels[within == 0].any()
    for k in range(1, count + 1):
        assert len(np.unique(within[labels == k])) == 1


@pytest.mark.parametrize("shape", [(3, 3), (3, 40), (4, 7), (10, 10)])
def test_windows_fit_small_images(shape):
    labels, count = seeds(plane_image(shape=shape))
    assert count >= 1
    assert labels.shape == shape


def test_the_same_image_gives_the_same_seeds():
    image = plane_image(step_at=25)
    assert np.array_equal(seeds(image, fit="lms")[0], seeds(image, fit="lms")[0])
