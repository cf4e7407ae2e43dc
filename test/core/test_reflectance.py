"""Colour normalisation against shading computed from the formula (eq. 4-7)."""

import numpy as np
import pytest

from rcseg_core import InputError, PinholeCamera, RangeColorFrame, SegmenterConfig, segment
from rcseg_core.config import ReflectanceConfig
from rcseg_core.signal.reflectance import incidence, normalize_reflectance, pixel_normals, weigh_intensity

SHAPE = (96, 128)
CAMERA = PinholeCamera(110.0, 110.0, 63.5, 47.5)
INNER = np.s_[12:-12, 12:-12]


def sphere(center=(0.0, 0.0, 1.4), radius=0.5):
    """Depth and unit outward normals of a sphere before the camera; NaN beside it."""
    rays = CAMERA.rays(*SHAPE).astype(float)
    center = np.array(center)
    a, b = (rays**2).sum(-1), rays @ center
    root = b**2 - a * (center @ center - radius**2)
    with np.errstate(invalid="ignore"):
        depth = (b - np.sqrt(root)) / a
    return depth, (rays * depth[..., None] - center) / radius


def plane(normal=(0.35, -0.25, -0.9), offset=-1.6):
    normal = np.array(normal) / np.linalg.norm(normal)
    depth = offset / (CAMERA.rays(*SHAPE).astype(float) @ normal)
    return depth, np.broadcast_to(normal, (*SHAPE, 3))


def shaded(depth, normals, albedo, power=1.0):
    """Eq. (4) for light at the sensor: albedo (mu.n)/r^2, in levels; mu points to the sensor."""
    points = CAMERA.rays(*SHAPE).astype(float) * depth[..., None]
    r = np.linalg.norm(points, axis=-1)
    cosine = -np.einsum("ijk,ijk->ij", normals, points) / r
    light = np.nan_to_num(power * cosine / r**2)
    color = np.rint(albedo * light[..., None])
    assert color.max() <= 255, "the scene is too bright for the test"
    color = color.astype(np.uint8)
    return RangeColorFrame.from_depth(depth, color, CAMERA), r**2, cosine


@pytest.mark.parametrize("make", [sphere, plane])
def test_normals_and_incidence_are_those_of_the_surface(make):
    depth, normals = make()
    frame, r2, cosine = shaded(depth, normals, np.full(3, 150.0))
    inside = np.zeros(SHAPE, bool)
    inside[INNER] = cosine[INNER] > 0.5
    got = pixel_normals(frame.points, frame.valid)
    angle = np.degrees(np.arccos(np.clip(np.einsum("ijk,ijk->ij", got, normals), -1, 1)))
    assert np.nanquantile(angle[inside], 0.95) < 5
    assert np.nanmedian(angle[inside]) < 1.5
    got_r2, got_cosine = incidence(frame, 0.2)
    np.testing.assert_allclose(got_r2[inside], r2[inside], rtol=1e-5)
    error = np.abs(got_cosine[inside] - cosine[inside])
    assert np.quantile(error, 0.95) < 0.03 and np.median(error) < 0.01
    assert np.nanmin(got_cosine) >= np.float32(0.2)


@pytest.mark.parametrize("make", [sphere, plane])
def test_active_light_is_taken_out(make):
    """Eq. (5): what is left is the albedo, up to one factor for the whole frame."""
    depth, normals = make()
    albedo = np.array([180.0, 120.0, 60.0])
    frame, _, cosine = shaded(depth, normals, albedo)
    inside = np.zeros(SHAPE, bool)
    inside[INNER] = cosine[INNER] > 0.5
    got = normalize_reflectance(frame, ReflectanceConfig(mode="active")).astype(float)[inside]
    before = frame.color[inside].astype(float)
    spread = got[:, 0].std() / got[:, 0].mean()
    assert spread < 0.03
    assert spread < 0.35 * before[:, 0].std() / before[:, 0].mean()
    np.testing.assert_allclose(np.median(got, axis=0) / np.median(got[:, 0]), albedo / 180, rtol=0.03)
    assert np.median(got) == pytest.approx(np.median(before), rel=0.15), "the brightness is to stay"


@pytest.mark.parametrize("make", [sphere, plane])
def test_a_white_board_calibrates_even_uneven_light(make):
    """Eq. (6)-(7): the albedo relative to the board, whatever the incident power of each pixel."""
    rows, cols = np.mgrid[: SHAPE[0], : SHAPE[1]]
    power = 1.0 + 0.5 * np.cos(cols / 40) * np.sin(rows / 30)
    depth, normals = make()
    albedo = np.where((cols > 64)[..., None], [0.8, 0.5, 0.3], [0.4, 0.6, 0.2])
    frame, _, cosine = shaded(depth, normals, 100 * albedo, power)
    white, _, _ = shaded(*plane((0.0, 0.0, -1.0), -1.2), np.full(3, 100.0), power)
    inside = np.zeros(SHAPE, bool)
    inside[INNER] = (cosine[INNER] > 0.5) & (np.abs(cols - 64)[INNER] > 2)
    got = normalize_reflectance(frame, ReflectanceConfig(mode="calibrated"), white)
    error = got[inside] / 255.0 - albedo[inside]
    assert np.abs(error).mean() < 0.02
    assert np.abs(np.median(error, axis=0)).max() < 0.01, "levels are rounded, but to no side"


def test_passive_colour_is_left_as_it_is():
    frame, _, _ = shaded(*sphere(), np.full(3, 150.0))
    assert normalize_reflectance(frame, ReflectanceConfig()) is frame.color


def test_pixels_without_geometry_keep_their_place_among_their_neighbours():
    depth, normals = plane((0.0, 0.0, -1.0), -1.0)
    frame, _, _ = shaded(depth, normals, np.full(3, 120.0))
    points = frame.points.copy()
    points[40:60, 50:70] = np.nan
    holed = RangeColorFrame(points, frame.color, CAMERA)
    got = normalize_reflectance(holed, ReflectanceConfig(mode="active")).astype(int)
    known = np.median(got[30:40, 50:70])
    np.testing.assert_allclose(
        got[40:60, 50:70], known, rtol=0.3
    )  # the frame's median correction, not the local one
    white, _, _ = shaded(depth, normals, np.full(3, 200.0))
    got = normalize_reflectance(holed, ReflectanceConfig(mode="calibrated"), white).astype(int)
    np.testing.assert_allclose(got[40:60, 50:70], np.median(got[30:40, 50:70]), rtol=0.3)


@pytest.mark.parametrize("mode", ["active", "calibrated"])
def test_a_frame_whose_geometry_is_unknown_everywhere_keeps_its_colour(mode):
    """One row of pixels has no normal anywhere: there is nothing to correct by."""
    depth = np.full(SHAPE, np.nan)
    depth[50] = 1.5
    frame = RangeColorFrame.from_depth(depth, np.full((*SHAPE, 3), 90, np.uint8), CAMERA)
    white, _, _ = shaded(*plane((0.0, 0.0, -1.0), -1.2), np.full(3, 200.0))
    got = normalize_reflectance(frame, ReflectanceConfig(mode=mode), white)
    assert np.array_equal(got, frame.color)


def test_scanner_grids_are_lit_along_their_axis():
    rows, cols = np.mgrid[:60, :80]
    x, y = cols * 0.004, rows * 0.004
    z = 0.8 + 0.75 * x
    cosine = 1 / np.hypot(1, 0.75)
    color = np.clip(np.rint(120 * cosine / z**2), 0, 255).astype(np.uint8)[..., None].repeat(3, -1)
    frame = RangeColorFrame(np.stack([x, y, z], -1), color, None)
    r2, got_cosine = incidence(frame, 0.2)
    np.testing.assert_allclose(got_cosine[INNER[0], 12:-12], cosine, atol=0.02)
    np.testing.assert_allclose(r2, z**2, rtol=1e-5)
    got = normalize_reflectance(frame, ReflectanceConfig(mode="active"))[12:-12, 12:-12].astype(float)
    assert got.std() / got.mean() < 0.02


def test_calibration_needs_a_white_frame_of_the_same_size():
    frame, _, _ = shaded(*sphere(), np.full(3, 150.0))
    config = ReflectanceConfig(mode="calibrated")
    with pytest.raises(InputError, match="white-reference frame is needed"):
        normalize_reflectance(frame, config)
    other = RangeColorFrame(np.ones((10, 20, 3)), np.zeros((10, 20, 3), np.uint8), None)
    with pytest.raises(InputError, match="the white-reference frame is 20x10, the frame 128x96"):
        normalize_reflectance(frame, config, other)


def two_halves(left, right, seed=0):
    """A plane whose left and right half have these colours."""
    rng = np.random.default_rng(seed)
    color = np.where((np.arange(160) < 80)[None, :, None], left, right) * np.ones((120, 1, 1))
    color = np.clip(color + rng.normal(0, 2, color.shape), 0, 255).astype(np.uint8)
    depth_m = 1.5 + 0.001 * rng.normal(size=(120, 160))
    return RangeColorFrame.from_depth(depth_m, color, PinholeCamera(150.0, 150.0, 79.5, 59.5))


def test_a_weight_of_one_is_the_colour_itself():
    color = np.random.default_rng(0).integers(0, 256, (8, 9, 3)).astype(np.uint8)
    assert weigh_intensity(color, 1.0) is color


def test_brightness_counts_less_and_chromaticity_as_before():
    color = np.array([[[60, 100, 80], [90, 130, 110], [60, 80, 100]]], np.uint8)
    weighed = weigh_intensity(color, 0.25).astype(int)
    # the second pixel is the first with 30 levels more; 30 * 0.25 = 7.5
    assert np.abs((weighed[0, 1] - weighed[0, 0]) - 7.5).max() <= 1
    # the third has the mean of the first
    assert np.array_equal(weighed[0, 2] - weighed[0, 0], [0, -20, 20])


@pytest.mark.parametrize("order", ["surfaces_first", "joint"])
def test_a_shadow_parts_no_region_where_brightness_counts_little(order):
    shadow, paints = (
        two_halves((120, 110, 100), (170, 160, 150)),
        two_halves((120, 110, 100), (100, 110, 180)),
    )
    usual = SegmenterConfig().replace({"grouping.order": order})
    discounted = usual.replace({"grouping.intensity_weight": 0.25})
    assert segment(shadow, usual).labels.max() == 2
    result = segment(shadow, discounted)
    assert result.labels.max() == 1
    assert segment(paints, usual).labels.max() == segment(paints, discounted).labels.max() == 2
    # the model is that of the measured colour: its mean is theirs
    rebuilt = result.reconstruct()[1].astype(float)
    assert np.abs(rebuilt.mean(axis=(0, 1)) - shadow.color.mean(axis=(0, 1))).max() < 1.5
