"""How error shrinks with area: the correlated and systematic parts that were put in are found."""

import cv2
import numpy as np
import pytest
from crafted import crafted_signals
from test_noise import SIGMA, estimated, room

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig, segment
from rcseg_core.partition.partition import Partition
from rcseg_core.signal.spread import WINDOW_CELLS, _all_windows, cell_share, measure_spread, window_variances
from rcseg_core.stages.passes import measured_on_planes

QVGA, VGA = (240, 320), (480, 640)
#: A cell of 16 px shows this much of white noise: no less can be called systematic.
ONE_CELL = 1 / 16


def blurred(shape, blur, seed):
    """Noise of SIGMA, blurred by a Gaussian: exp(-d^2 / 4 s^2) apart, so 4 pi s^2 pixels make one number."""
    noise = np.random.default_rng(seed).normal(size=shape)
    if blur > 0:
        noise = cv2.GaussianBlur(noise, (0, 0), blur)
        noise /= noise.std()
    return SIGMA * noise


def bend(shape, rms, wave=60):
    """A smooth error of known rms, in sigmas, that bends over three windows of the noise."""
    rows, cols = np.indices(shape)
    return SIGMA * rms * 2 * np.sin(2 * np.pi * rows / wave + 0.3) * np.sin(2 * np.pi * cols / wave + 0.8)


@pytest.mark.parametrize("scene", [room, lambda shape: np.full(shape, 0.4)], ids=["room", "wall"])
@pytest.mark.parametrize("shape", [QVGA, VGA])
@pytest.mark.parametrize("seed", range(3))
def test_white_noise_is_white_and_bends_nothing(seed, shape, scene):
    noise = estimated(scene(shape) + blurred(shape, 0, seed))
    assert noise.range_correlation == pytest.approx(1.0, abs=0.2)
    assert noise.range_systematic <= ONE_CELL
    assert noise.range_sigma(np.array(0.4)) == pytest.approx(SIGMA, rel=0.03)


@pytest.mark.parametrize("shape", [QVGA, VGA])
@pytest.mark.parametrize("blur", [0.8, 1.0, 1.5])
@pytest.mark.parametrize("seed", range(3))
def test_pixels_of_one_measurement_are_those_of_the_blur(seed, blur, shape):
    noise = estimated(np.full(shape, 0.4) + blurred(shape, blur, seed))
    m = 4 * np.pi * blur**2
    assert noise.range_correlation == pytest.approx(m, rel=0.3)
    assert noise.range_systematic <= 2 * np.sqrt(m) * ONE_CELL
    # the plane of a window follows some of correlated noise, and that is made good
    assert noise.range_sigma(np.array(0.4)) == pytest.approx(SIGMA, rel=0.06)


@pytest.mark.parametrize("rms", [0.2, 0.5, 1.0])
@pytest.mark.parametrize("seed", range(2))
def test_a_bend_wider_than_the_windows_of_the_noise_is_systematic(seed, rms):
    noise = estimated(np.full(VGA, 0.4) + bend(VGA, rms) + blurred(VGA, 0, seed))
    assert noise.range_systematic == pytest.approx(rms, rel=0.3)


def cluttered(w, seed):
    """Boxes before it, holes, and a quarter of the pixels missing: (w, valid)."""
    rng = np.random.default_rng(seed)
    w, (height, width) = w.copy(), w.shape
    valid = rng.random(w.shape) > 0.25
    holes = np.ones(w.shape, np.uint8)
    for _ in range(8):
        row, col = rng.integers(0, height - 60), rng.integers(0, width - 60)
        h, v = rng.integers(20, 60, 2)
        w[row : row + h, col : col + v] += rng.uniform(0.05, 0.3)
        at = int(rng.integers(0, width)), int(rng.integers(0, height))
        cv2.circle(holes, at, int(rng.integers(4, 15)), 0, -1)
    return w, valid & (holes > 0)


@pytest.mark.parametrize(("blur", "rms"), [(0, 0.5), (1.0, 0.0), (1.0, 0.7), (1.5, 0.0), (1.5, 1.0)])
@pytest.mark.parametrize("seed", range(2))
def test_things_holes_and_missing_pixels_change_it_little(seed, blur, rms):
    w = np.full(VGA, 0.4) + bend(VGA, rms) + blurred(VGA, blur, seed)
    plain, seen = estimated(w.copy()), estimated(*cluttered(w, seed))
    assert seen.range_correlation == pytest.approx(plain.range_correlation, rel=0.4)
    m = max(4 * np.pi * blur**2, 1.0)
    assert seen.range_systematic == pytest.approx(plain.range_systematic, rel=0.4, abs=np.sqrt(m) * ONE_CELL)


@pytest.mark.parametrize("side", [8, 16])
@pytest.mark.parametrize("blur", [0.8, 1.0, 1.5, 2.5])
def test_the_share_of_a_cell_is_that_of_simulated_noise(blur, side):
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(1680, 1680)), (0, 0), blur)[40:-40, 40:-40]
    noise /= noise.std()
    means = noise.reshape(1600 // side, side, 1600 // side, side).mean(axis=(1, 3))
    assert cell_share(side, np.array(4 * np.pi * blur**2)) == pytest.approx(means.var(), rel=0.08)


@pytest.mark.parametrize("side", [3, 8, 16])
def test_the_share_of_a_cell_is_the_mean_correlation_of_its_pixels(side):
    """Var of a mean: the correlations of all pairs of pixels, averaged."""
    rows, cols = np.indices((side, side)).reshape(2, -1)
    distance2 = (rows[:, None] - rows) ** 2 + (cols[:, None] - cols) ** 2
    for m in (6.0, 12.0, 28.0, 100.0):
        wanted = np.exp(-np.pi * distance2 / m).mean()
        assert cell_share(side, np.array(m)) == pytest.approx(wanted, rel=0.08)


def test_windows_miss_their_quadratic_by_what_least_squares_says():
    """Without outliers weights are nearly one; a window with a third of the cells elsewhere says nothing."""
    rng = np.random.default_rng(1)
    rows, cols = np.indices((WINDOW_CELLS, WINDOW_CELLS)).reshape(2, -1)
    table = np.stack([cols**a * rows**b for a in range(3) for b in range(3 - a)], axis=1).astype(float)
    ratios = []
    for _ in range(40):
        mean = 2.0 + table @ rng.normal(size=6) + rng.normal(size=rows.size)
        out = np.empty((1, 2))
        window_variances(mean.reshape(WINDOW_CELLS, WINDOW_CELLS), out)
        rest = np.linalg.lstsq(table, mean, rcond=None)[1][0] / (rows.size - 6)
        assert out[0, 0] == pytest.approx(mean.mean())
        ratios.append(out[0, 1] / rest)
    assert np.median(ratios) == pytest.approx(1.0, abs=0.05)
    torn = rng.normal(size=(WINDOW_CELLS, WINDOW_CELLS))
    torn[:, 4:] += 1e3 * rng.normal(size=(WINDOW_CELLS, 2))
    window_variances(torn, out)
    assert np.isnan(out[0, 1])


def test_cells_that_stick_out_do_not_matter():
    rng = np.random.default_rng(2)
    found = []
    for _ in range(60):
        mean = rng.normal(size=(WINDOW_CELLS, WINDOW_CELLS))
        mean.flat[rng.choice(mean.size, 4, replace=False)] += 50.0
        out = np.empty((1, 2))
        window_variances(mean, out)
        found.append(out[0, 1])
    assert np.isfinite(found).mean() > 0.9
    assert np.nanmean(found) == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize("shape", [(8, 8), (50, 60), (40, 400)])
def test_images_with_too_few_windows_keep_what_is_known(shape):
    signal = np.random.default_rng(0).normal(size=(*shape, 1)).astype(np.float32)
    spread = measure_spread(signal, np.ones(shape, bool), np.ones_like, 441.0, 3.0)
    assert spread.correlation == 3.0
    assert spread.systematic == 0.0


def bent_regions_of(rms, share=1.0, seed=0):
    """Signals of unit noise with regions that a slow wave bends over `share` of the image."""
    rows, cols = np.indices(QVGA)
    wave = np.sqrt(2) * rms * np.cos(2 * np.pi * cols / QVGA[1])
    labels = np.where(rows < share * QVGA[0], 1, 2).astype(np.int32)
    value = 0.1 * cols + np.where(labels == 1, wave, 0.0)
    noise = np.random.default_rng(seed).normal(size=QVGA)
    return crafted_signals((value + noise)[..., None]), Partition(labels, int(labels.max()))


@pytest.mark.parametrize("rms", [0.3, 1.0])
def test_what_bends_over_the_whole_image_is_measured_on_its_planes(rms):
    signals, partition = bent_regions_of(rms)
    measured = measured_on_planes(partition, signals, SegmenterConfig())
    # the variance of the noise may be off by 3 %
    assert measured.noise.range_systematic == pytest.approx(np.sqrt(rms**2 - 0.03), rel=0.1)
    assert signals.noise.range_systematic == 0.0


def test_things_that_are_bent_themselves_are_not_the_sensor():
    signals, partition = bent_regions_of(20.0, share=0.4)
    assert measured_on_planes(partition, signals, SegmenterConfig()).noise.range_systematic < 0.1


def test_what_windows_saw_is_the_least():
    signals, partition = bent_regions_of(0.0)
    signals = crafted_signals(signals.image, systematic=0.6)
    assert measured_on_planes(partition, signals, SegmenterConfig()).noise.range_systematic == 0.6


#: Rows and columns of a board 0.8 m away, and where it begins, in QVGA.
BOARDS = {
    "small": ((60, 60), (20, 30)), "wide": ((50, 250), (180, 30)), "middle": ((90, 120), (75, 100)),
    "tall": ((150, 100), (40, 200)), "corner": ((120, 160), (0, 0)), "large": ((200, 160), (20, 80)),
}  # fmt: skip
SIGMA_M = 0.004


def board_before_a_wall(size, place):
    """Inverse depth of a wall at 4 m and a board at 0.8 m."""
    w = np.full(QVGA, 1 / 4.0)
    w[place[0] : place[0] + size[0], place[1] : place[1] + size[1]] = 1 / 0.8
    return w


@pytest.mark.parametrize("board", list(BOARDS))
def test_constant_depth_noise_is_a_law_that_holds_at_both_depths(board):
    """4 mm everywhere is 25 times as much of inverse depth at 0.8 m as at 4 m; 20 draws."""
    w = board_before_a_wall(*BOARDS[board])
    for seed in range(20):
        noise = estimated(w + SIGMA_M * w**2 * np.random.default_rng(seed).normal(size=QVGA))
        for depth in (0.8, 4.0):
            found = float(noise.range_sigma(np.array(1 / depth))) * depth**2
            assert SIGMA_M / 1.5 < found < SIGMA_M * 1.5, f"seed {seed}, {depth} m"


@pytest.mark.parametrize("seed", range(20))
def test_under_constant_depth_noise_wall_and_board_are_two_planes(seed):
    size, place = list(BOARDS.values())[seed % len(BOARDS)]
    w = board_before_a_wall(size, place)
    depth = 1 / w + SIGMA_M * np.random.default_rng(seed).normal(size=QVGA)
    camera = PinholeCamera(260.0, 260.0, 159.5, 119.5)
    frame = RangeColorFrame.from_depth(depth, np.full((*QVGA, 3), 120, np.uint8), camera)
    result = segment(frame, SegmenterConfig().replace({"grouping.order": "range_only"}))
    board = w > 1
    names = [int(np.bincount(result.labels[part]).argmax()) for part in (board, ~board)]
    assert names[0] != names[1], "the board is swallowed"
    for name, part in zip(names, (board, ~board), strict=True):
        assert np.mean(result.labels[part] == name) > 0.95
        assert np.mean(part[result.labels == name]) > 0.95
        assert result.regions[name - 1].range_patch.degree == 1
    assert len(result.regions) == 2


@pytest.mark.parametrize("rows", [1, 2, 3, 4, 9])
@pytest.mark.parametrize("more", [0, 2])
def test_windows_by_bands_are_those_of_the_whole(rows, more):
    step, cols = WINDOW_CELLS // 2, 3
    shape = step * (rows - 1) + WINDOW_CELLS + more, step * (cols - 1) + WINDOW_CELLS
    mean = np.random.default_rng(rows).normal(size=shape)
    whole = np.empty((rows * cols, 2))
    window_variances(mean, whole)
    for large in (False, True):
        np.testing.assert_array_equal(_all_windows(mean, rows, cols, large), whole)
