"""A bent region is several surfaces, or one that is curved, whichever is the shorter description."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from crafted import crafted_signals

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig
from rcseg_core.decision import facets
from rcseg_core.decision.facets import MOST, QUARTIC, Cells, describe, gather
from rcseg_core.graph.adjacency import find_pairs
from rcseg_core.models.moments import accumulate, region_boxes
from rcseg_core.models.polynomials import fit_models
from rcseg_core.models.second_order import second_order
from rcseg_core.partition import parting
from rcseg_core.partition.chamfers import dissolve_chamfers
from rcseg_core.partition.parting import UNUSABLE, bent_regions, find_parts, split_creases
from rcseg_core.partition.partition import Partition
from rcseg_core.signal.edges import ORIENTATION
from rcseg_core.signal.signals import INVALID, MISFIT, build_signals

SHAPE = (60, 80)
ROWS, COLS = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
X, Y = COLS - 40, ROWS - 30
#: A roof whose ridge runs askew, 4 sigma high.
FIRST, SECOND = 0.20 * COLS + 0.03 * ROWS, 14.0 - 0.15 * COLS + 0.05 * ROWS
ROOF, ON_SECOND = np.minimum(FIRST, SECOND), FIRST > SECOND
#: Three faces that meet in a point, as the corner of a box does.
FACES = np.stack([0.25 * X, -0.2 * X + 0.2 * Y, -0.05 * X - 0.3 * Y])
CORNER, ON_FACE = FACES.min(axis=0), FACES.argmin(axis=0)
#: Surfaces of one piece; those of second order are seen to the limb or nearly so.
BALL = 12.0 * np.sqrt(np.maximum(1.0 - (X / 52) ** 2 - (Y / 52) ** 2, 0.0))
TUBE = 10.0 * np.sqrt(np.maximum(1.0 - (X / 41) ** 2, 0.0)) + 0.05 * ROWS
CONE = np.sqrt((9.0 + 0.1 * ROWS) ** 2 - (8.7 * X / 40) ** 2)
WHOLE = {"plane": FIRST, "bowl": 0.006 * X**2, "ball": BALL, "tube": TUBE, "cone": CONE}
#: Blur of correlated noise, px, and the pixels that make one independent measurement then.
BLUR = 1.5
BLURRED = 4 * np.pi * BLUR**2


def noise_of(shape, seed, blur=0.0):
    """Noise of unit variance, blurred by a Gaussian."""
    if blur == 0:
        return np.random.default_rng(seed).normal(size=shape)
    wide = np.random.default_rng(seed).normal(size=(shape[0] + 20, shape[1] + 20))
    return np.sqrt(4 * np.pi) * blur * cv2.GaussianBlur(wide, (0, 0), blur)[10:-10, 10:-10]


def signals_of(value, seed=0, eps=1.0, blur=0.0, **changes):
    """Unit noise; a surface tilted by 45 degrees rises 3 sigma in UNIT_PX."""
    noisy = value + noise_of(value.shape, seed, blur)
    changes.setdefault("correlation", max(4 * np.pi * blur**2, 1.0))
    return replace(crafted_signals(noisy[..., None], 1, eps=eps, **changes), slope=(3.0, 0.0))


def found(value, mask=None, **changes):
    """Part of each pixel of a region, (h, w) from 0, or None where it stays whole."""
    labels = np.ones(value.shape, np.int32) if mask is None else mask.astype(np.int32)
    box, signals = region_boxes(labels, 1)[1], signals_of(value, **changes)
    if not bent_regions(Partition(labels, 1).moments(signals, 1), signals, 60).size:
        return None
    parts = find_parts(labels, 1, box, float(labels.sum()), signals)
    if parts is None:
        return None
    image = parting._image_of(parts, (labels == 1)[box[0] : box[2] + 1, box[1] : box[3] + 1])
    return image - 1


def agreement(image, truth):
    """Share of the pixels whose part is the one that holds most of their true face."""
    counts = np.zeros((int(truth.max()) + 1, int(image.max()) + 1))
    np.add.at(counts, (truth.astype(int).ravel(), image.ravel()), 1)
    best = counts.argmax(axis=1)
    assert len(set(best)) == len(best), "two faces are one part"
    return counts.max(axis=1).sum() / counts.sum()


def roof_frame(height, width, at, bend_deg=50.0, sigma=0.0015):
    """Two planes at 2 m that meet upright at a share `at` of the width, seen by a camera."""
    camera = PinholeCamera(525.0, 525.0, (width - 1) / 2, (height - 1) / 2)
    x = (np.arange(width) - camera.cx) / camera.fx
    ridge = (at * width - camera.cx) / camera.fx
    tilts = np.deg2rad([bend_deg / 2, -bend_deg / 2])
    left, right = ((x * np.sin(t) + np.cos(t)) / (2.0 * (ridge * np.sin(t) + np.cos(t))) for t in tilts)
    w = np.where(x < ridge, left, right) + sigma * np.random.default_rng(0).normal(size=(height, width))
    return RangeColorFrame.from_depth(1 / w, np.full((height, width, 3), 120, np.uint8), camera)


@pytest.mark.parametrize("at", [0.3, 0.5])
@pytest.mark.parametrize(
    ("height", "width"), [(250, 300), (251, 300), (250, 299), (125, 300), (400, 320), (500, 640), (240, 320)]
)
def test_a_roof_is_parted_at_any_size(height, width, at):
    """Cells of any width and any remainder at the rim; the ridge anywhere in a cell."""
    made = roof_frame(height, width, at)
    signals = build_signals(made, made.color, SegmenterConfig()).range_only()
    partition = Partition(np.ones((height, width), np.int32), 1)
    assert split_creases(partition, signals, 60)[0] == 1
    assert partition.count == 2
    assert agreement(partition.labels - 1, np.indices((height, width))[1] >= at * width) > 0.97


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["convex", "concave"])
@pytest.mark.parametrize("seed", range(3))
def test_a_roof_is_parted_along_its_ridge(sign, seed):
    image = found(sign * ROOF, seed=seed)
    assert image is not None and image.max() == 1
    assert agreement(image, ON_SECOND) > 0.95


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["convex", "concave"])
@pytest.mark.parametrize("seed", range(3))
def test_three_faces_of_a_corner_are_found_at_once(sign, seed):
    image = found(sign * 1.5 * CORNER, seed=seed)
    assert image is not None and image.max() == 2
    assert agreement(image, ON_FACE) > 0.93


def test_outliers_do_not_move_the_ridge():
    value = ROOF.copy()
    value[np.random.default_rng(3).random(SHAPE) < 0.05] += 30.0
    signals = signals_of(value)
    # single pixels far off are flagged before anything is described
    signals.flags[value > ROOF + 15.0] |= MISFIT
    labels = np.ones(SHAPE, np.int32)
    parts = find_parts(labels, 1, region_boxes(labels, 1)[1], float(labels.size), signals)
    assert agreement(parting._image_of(parts, labels == 1) - 1, ON_SECOND) > 0.95


def test_the_lid_of_a_can_is_parted_from_its_side():
    lid = ROWS < 22
    image = found(np.where(lid, TUBE[22] + 0.9 * (ROWS - 22), TUBE))
    assert image is not None
    upper = np.bincount(image[:18].ravel()).argmax()
    assert np.mean((image == upper) == lid) > 0.9


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("blur", [0.0, BLUR], ids=["white", "correlated"])
@pytest.mark.parametrize("name", list(WHOLE))
def test_one_surface_stays_whole(name, blur, seed):
    assert found(WHOLE[name], seed=seed, blur=blur) is None


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("blur", [0.0, BLUR], ids=["white", "correlated"])
@pytest.mark.parametrize("name", list(WHOLE))
def test_one_small_surface_stays_whole(name, blur, seed):
    """Half the width and height with the same relief: no more than 43 independent measurements."""
    small = WHOLE[name][::2, ::2]
    assert found(small, seed=seed, blur=blur) is None


@pytest.mark.parametrize("seed", range(10))
def test_correlated_noise_is_not_two_parallel_planes(seed):
    assert found(0.0 * ROWS, seed=seed, blur=BLUR, eps=0.3) is None


def test_a_crease_within_the_tolerance_is_none():
    assert found(ROOF, eps=1.0) is not None
    assert found(ROOF, eps=20.0) is None


def test_correlated_noise_asks_for_more_evidence():
    small = (ROWS > 15) & (ROWS < 35) & (np.abs(COLS - 42) < 20)
    assert found(1.5 * ROOF, small, eps=0.3, correlation=1.0) is not None
    assert found(1.5 * ROOF, small, eps=0.3, correlation=60.0) is None


def test_a_systematic_error_asks_for_more_evidence():
    assert found(ROOF, eps=0.3, systematic=0.0) is not None
    assert found(ROOF, eps=0.3, systematic=3.0) is None


def test_a_region_is_split_and_its_tree_stays_whole():
    signals = signals_of(ROOF)
    partition = Partition(np.ones(SHAPE, np.int32), 1)
    divided, edges = split_creases(partition, signals, 50)
    assert divided == 1
    assert partition.count == 2
    assert agreement(partition.labels - 1, ON_SECOND) > 0.95
    assert (partition.labels > 0).all()
    # each region has leaves of its own, and the crease is an orientation edge
    assert not set(partition.leaves[partition.labels == 1]) & set(partition.leaves[partition.labels == 2])
    assert set(np.unique(edges)) == {0, ORIENTATION}
    crease = (partition.labels[:, 1:] != partition.labels[:, :-1]).any(axis=1)
    assert ((edges != 0).any(axis=1) >= crease).all()


def test_each_connected_piece_of_a_part_is_a_region_of_its_own():
    parts = np.zeros(SHAPE, np.int32)
    parts[:, 10:20] = 1
    parts[5:50, 60:70] = 1
    parts[:, 20:30] = 2
    parts[0:3, 75:78] = 1  # too small
    flags = np.zeros(SHAPE, np.uint8)
    partition = Partition(np.ones(SHAPE, np.int32), 1)
    assert partition.separate(parts, flags, 50) == 3
    assert partition.count == 4
    pieces = [partition.labels[s] for s in (np.s_[:, 10:20], np.s_[5:50, 60:70], np.s_[:, 20:30])]
    names = {int(piece.flat[0]) for piece in pieces}
    assert all((piece == piece.flat[0]).all() for piece in pieces)
    assert len(names) == 3 and 0 not in names and 1 not in names
    assert not partition.labels[0:3, 75:78].any()
    assert (partition.labels[parts == 0] == 1).all()


def test_faces_of_one_plane_on_either_side_of_a_beam_are_two_regions():
    """One plane describes both; a beam between them hides that they hang together."""
    value = np.maximum(0.0 * X, 12.0 - 0.6 * np.abs(X))
    signals = signals_of(value)
    partition = Partition(np.ones(SHAPE, np.int32), 1)
    assert split_creases(partition, signals, 50)[0] == 1
    left, right = partition.labels[:, 3:15], partition.labels[:, -14:-3]
    names = [int(np.bincount(side.ravel()).argmax()) for side in (left, right)]
    assert names[0] != names[1] and min(names) > 0
    assert all(np.mean(side == name) > 0.95 for side, name in zip((left, right), names, strict=True))


def naive_gather(labels, image, flags, k, box, side):
    """Cells of region k from the mean of each square: {(i, j): (x, y, value, pixels)}."""
    cells = {}
    for i, row in enumerate(range(box[0], box[2] + 1, side)):
        for j, col in enumerate(range(box[1], box[3] + 1, side)):
            part = np.s_[row : min(row + side, box[2] + 1), col : min(col + side, box[3] + 1)]
            rows, cols = np.nonzero((labels[part] == k) & (flags[part] & UNUSABLE == 0))
            if rows.size >= 0.3 * side * side:
                values = image[part][rows, cols].astype(float)
                cells[i, j] = (cols.mean() + col, rows.mean() + row, values.mean(), rows.size)
    return cells


@pytest.mark.parametrize("side", [3, 5, 7])
@pytest.mark.parametrize("seed", range(3))
def test_cells_are_the_means_of_their_squares(seed, side):
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 3, (6, 8)).astype(np.int32).repeat(10, 0).repeat(10, 1)
    flags = np.where(rng.random(SHAPE) < 0.2, rng.choice([1, INVALID, MISFIT], SHAPE), 0).astype(np.uint8)
    image = rng.normal(size=(*SHAPE, 2)).astype(np.float32)
    box = region_boxes(labels, 2)[2]
    *arrays, number, middle, scale = gather(labels, image, flags, UNUSABLE, 2, box, side, 1)
    place, value, weight, beside = arrays
    wanted = naive_gather(labels, image[..., 1], flags, 2, box, side)
    assert {(int(i), int(j)) for i, j in np.argwhere(number >= 0)} == set(wanted)
    total = np.array([(x, y, v) for x, y, v, _ in wanted.values()])
    pixels = np.array([n for *_, n in wanted.values()], float)
    np.testing.assert_allclose(middle, pixels @ total / pixels.sum(), rtol=1e-6)
    assert scale == 0.5 * max(box[2] - box[0], box[3] - box[1])
    for (i, j), (x, y, v, n) in wanted.items():
        at = number[i, j]
        assert weight[at] == n
        np.testing.assert_allclose(place[at] * scale + middle[:2], [x, y], rtol=1e-9)
        assert value[at] + middle[2] == pytest.approx(v, abs=1e-6)
        around = [(i, j - 1), (i, j + 1), (i - 1, j), (i + 1, j)]
        assert beside[at].tolist() == [number[p] if p in wanted else -1 for p in around]


def rendered(kind, size=24):
    """Inverse depth of the cells of a ball or cylinder, traced in a pinhole camera, in cells to the limb."""
    x, y = np.meshgrid(np.linspace(-0.24, 0.24, 2 * size), np.linspace(-0.2, 0.2, 2 * size))
    rays = np.stack([x, y, np.ones_like(x)], -1)
    center, radius = np.array([0.03, -0.02, 2.0]), 0.4
    axis = np.array([0.3, 0.9, 0.3]) / np.linalg.norm([0.3, 0.9, 0.3]) * (kind == "cylinder")
    across = rays - (rays @ axis)[..., None] * axis
    base = center - center @ axis * axis
    # |t across - base| = radius, the nearer of the two
    a, b, c = np.sum(across**2, -1), across @ base, base @ base - radius**2
    root2 = b * b - a * c
    seen = root2 > 0.02 * (b * b).max() * radius**2 / 4
    t = (b - np.sqrt(np.maximum(root2, 0))) / a
    return x[seen], y[seen], 1.0 / t[seen]


def cells_of(x, y, value):
    """Cells of weight 1 without neighbours, in the coordinates of `Cells`."""
    place = np.stack([x - x.mean(), y - y.mean()], axis=1)
    place /= np.abs(place).max()
    none = np.full((x.size, 4), -1, np.int64)
    return Cells(np.ascontiguousarray(place), value - value.mean(), np.ones(x.size), none)


@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["outside", "inside"])
def test_second_order_follows_a_rendered_surface(kind, sign):
    """What it misses is a hundredth of the relief; no quartic of the image comes as near."""
    x, y, w = rendered(kind)
    cells = cells_of(x, y, sign * w)
    length = second_order(cells, np.inf, np.inf, 1.0, 0.0, np.empty((QUARTIC + 1, QUARTIC)), np.empty((4, 9)))
    relief = np.linalg.lstsq(np.column_stack([np.ones_like(x), x, y]), w, rcond=None)[1][0]
    assert np.sqrt(length / relief) < 0.01
    terms = np.stack([x**a * y**b for a in range(5) for b in range(5)], axis=1)
    quartic = np.linalg.lstsq(terms, w, rcond=None)[1][0]
    assert length < 0.5 * quartic


def test_two_planes_are_a_surface_of_second_order_and_three_are_not():
    """(w - f)(w - g) = 0; so a roof is told by its eight coefficients against ten, a corner by its misses."""
    misses = []
    for value in (ROOF, 1.5 * CORNER):
        cells = cells_of(*(a[::3, ::3].ravel() for a in (X, Y, value)))
        length = second_order(
            cells, np.inf, np.inf, 1.0, 0.0, np.empty((QUARTIC + 1, QUARTIC)), np.empty((4, 9))
        )
        misses.append(np.sqrt(length / cells.value.size))
    assert misses[0] < 0.01 < 0.2 < misses[1]


def gathered(value, side=5):
    labels = np.ones(value.shape, np.int32)
    box, signals = region_boxes(labels, 1)[1], signals_of(value)
    *arrays, _, _, _ = gather(labels, signals.image, signals.flags, UNUSABLE, 1, box, side, 0)
    return Cells(*arrays)


def described(run, value, side=5):
    cells = gathered(value, side)
    owner = np.zeros(len(cells.value), np.int64)
    coefs, terms = np.zeros((MOST + 1, QUARTIC)), np.zeros(MOST + 1, np.int64)
    count, length, curved = run(
        cells, 2.0, 2.0, 1.0, 1.0, np.log(value.size), 1.0, owner, coefs, terms, np.zeros((MOST, MOST, 3))
    )  # fmt: skip
    return count, length, curved, owner, coefs[:count], terms[:count]


@pytest.mark.parametrize("value", [ROOF, 1.5 * CORNER, BALL, FIRST], ids=["roof", "corner", "ball", "plane"])
def test_a_description_is_no_longer_than_it_says(value):
    """Misses, coefficients and names, summed once more by hand from what is given back."""
    count, length, curved, owner, coefs, terms = described(describe, value)
    if count < 2:
        assert length >= curved or count == 1
        return
    place, values, weight, beside = gathered(value)
    other = (beside >= 0) & (owner[beside] != owner[:, None])
    weight = np.where(other.any(axis=1), 0.0, weight)  # across a border a cell lies on neither side
    x, y = place.T
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    miss = values - np.sum(basis * coefs[owner, :6], axis=1)
    total = np.sum(weight * np.minimum(miss**2, 2.0)) + np.log(value.size) * np.sum(terms + 1)
    assert length == pytest.approx(total, rel=1e-9)


def test_describe_is_the_same_without_the_compiler(monkeypatch):
    """The kernels' own sources are put in their place, on few cells."""
    values = (2.0 * ROOF, 3.0 * CORNER, FIRST)
    compiled = [described(describe, value, 8) for value in values]
    assert [count > 1 for count, *_ in compiled] == [True, True, False]
    if not hasattr(describe, "py_func"):
        pytest.skip("this run is interpreted already")
    for name in (
        "_basis",
        "_sum_terms",
        "_sum_plane",
        "_fit",
        "_gains",
        "_cost",
        "_costs",
        "_assign",
        "_length",
        "_settle",
        "_one_polynomial",
        "second_order",
    ):
        monkeypatch.setattr(facets, name, getattr(facets, name).py_func)
    interpreted = [described(describe.py_func, value, 8) for value in values]
    for ours, theirs in zip(compiled, interpreted, strict=True):
        assert ours[0] == theirs[0]
        assert ours[1:3] == pytest.approx(theirs[1:3], rel=1e-9)
        for a, b in zip(ours[3:], theirs[3:], strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9)


def chamfer_case(value):
    """A roof of regions 1 and 2 and a strip, region 3, along the ridge."""
    labels = np.where(ON_SECOND, 2, 1).astype(np.int32)
    labels[np.abs(FIRST - SECOND) < 1.2] = 3
    signals = signals_of(value, eps=0.5)
    partition = Partition(labels, 3)
    moments = accumulate(signals.image, signals.flags, labels, 3, 1)
    models = fit_models(moments, np.ones((4, 2), np.int64), 1)
    return partition, signals, models, find_pairs(labels, 3, np.zeros(SHAPE, np.uint8), 3)


def test_a_strip_that_both_sides_explain_dissolves():
    partition, *rest = chamfer_case(ROOF)
    assert dissolve_chamfers(partition, *rest, 1000) == 1
    assert partition.count == 2
    assert (partition.labels[np.abs(FIRST - SECOND) < 1.2] == 0).all()


def test_a_strip_that_stands_out_stays():
    partition, *rest = chamfer_case(ROOF + 3.0 * (np.abs(FIRST - SECOND) < 1.2))
    assert dissolve_chamfers(partition, *rest, 1000) == 0
    assert partition.count == 3


def test_large_regions_are_not_looked_at():
    partition, *rest = chamfer_case(ROOF)
    size = int((partition.labels == 3).sum())
    assert dissolve_chamfers(partition, *rest, size) == 0
