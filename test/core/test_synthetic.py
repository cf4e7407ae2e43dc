"""Scenes: the truth is exact, the noise is what it says, every option does its thing and nothing else."""

import cv2
import numpy as np
import pytest

from rcseg_core.errors import InputError
from rcseg_core.frame import PinholeCamera
from rcseg_core.synthetic import (
    FAMILIES,
    LEAST_DIFFERENCE,
    SCANNER_FAMILIES,
    SensorOptions,
    default_camera,
    make_scene,
    make_tabletop_sequence,
)
from rcseg_core.synthetic.layouts import KINECT_SIGMA_INVERSE_M
from rcseg_core.synthetic.paint import distinct_colors

SMALL = {"width": 160, "height": 120}
CAMERA_FAMILIES = [family for family in FAMILIES if family not in SCANNER_FAMILIES]


def inner(labels, label, margin=2):
    """Pixels of a label that are at least `margin` px from its border."""
    mask = (labels == label).astype(np.uint8)
    return cv2.erode(mask, np.ones((2 * margin + 1,) * 2, np.uint8)).astype(bool)


@pytest.mark.parametrize("family", FAMILIES)
def test_scenes_are_whole_and_have_5_to_15_regions_that_matter(family):
    for seed in range(6):
        scene = make_scene(family, seed, **SMALL)
        labels = scene.labels
        assert labels.shape == (120, 160)
        assert labels.dtype == np.int32
        areas = np.bincount(labels.ravel())[1:]
        assert (areas > 0).all(), "labels are not 1..N"
        assert 5 <= np.count_nonzero(areas >= 100 * labels.size / (640 * 480)) <= 15
        seen = np.isfinite(scene.clean_points).all(axis=2)
        assert (seen == (labels > 0)).all()
        assert (scene.frame.valid == seen).all()
        assert (scene.frame.camera is None) == (family in SCANNER_FAMILIES)


@pytest.mark.parametrize("family", FAMILIES)
def test_labels_are_connected_components_of_one_surface_and_one_object(family):
    scene = make_scene(family, 1, **SMALL)
    for image in (scene.labels, scene.surface_labels):
        for label in range(1, image.max() + 1):
            count, _ = cv2.connectedComponents((image == label).astype(np.uint8), connectivity=4)
            assert count == 2
    for fine, coarse in ((scene.labels, scene.surface_labels), (scene.surface_labels, scene.object_labels)):
        pairs = {(a, b) for a, b in zip(fine.ravel().tolist(), coarse.ravel().tolist(), strict=True)}
        assert len(pairs) == len({a for a, _ in pairs}), "a part lies on two wholes"


@pytest.mark.parametrize("family", FAMILIES)
def test_same_seed_same_scene_other_seed_other_scene(family):
    one, same, other = (make_scene(family, seed, outliers=0.1, dropout=0.1, **SMALL) for seed in (4, 4, 5))
    assert (one.frame.color == same.frame.color).all()
    assert np.array_equal(one.frame.points, same.frame.points, equal_nan=True)
    assert (one.labels == same.labels).all()
    assert (one.labels != other.labels).any()


def test_the_size_changes_the_pixels_and_not_the_scene():
    """The small image samples the large one: regions of area share agree."""
    large, small = (make_scene("room", 2, width=w, height=h) for w, h in ((640, 480), (160, 120)))
    assert large.pose == pytest.approx(small.pose)
    big = large.object_labels[1::4, 1::4]
    assert np.mean(big == small.object_labels) > 0.97


@pytest.mark.parametrize("family", ["room", "blocks"])
def test_flat_surfaces_are_planes_in_the_truth_and_linear_in_inverse_depth(family):
    scene = make_scene(family, 0, **SMALL)
    rows, cols = np.indices(scene.labels.shape)
    flat = 0
    for label in range(1, scene.surface_labels.max() + 1):
        on = scene.surface_labels == label
        if on.sum() < 30 or np.ptp(scene.normals[on], axis=0).max() > 1e-6:
            continue
        flat += 1
        points, normal = scene.clean_points[on], scene.normals[on][0].astype(float)
        assert np.ptp(points @ normal) < 1e-6
        design = np.stack([np.ones(on.sum()), rows[on], cols[on]], axis=1)
        inverse = 1 / points[:, 2]
        residual = inverse - design @ np.linalg.lstsq(design, inverse, rcond=None)[0]
        assert np.abs(residual).max() < 1e-9
    assert flat >= 4


def test_normals_face_the_camera_and_are_those_of_the_depth():
    scene = make_scene("curved", 0, **SMALL)
    seen = scene.labels > 0
    assert (np.sum(scene.normals * scene.clean_points, axis=2)[seen] < 0).all()
    down = scene.clean_points[2:, 1:-1] - scene.clean_points[:-2, 1:-1]
    right = scene.clean_points[1:-1, 2:] - scene.clean_points[1:-1, :-2]
    cross = np.cross(right, down)
    cross /= -np.linalg.norm(cross, axis=2, keepdims=True)
    for label in range(1, scene.surface_labels.max() + 1):
        on = inner(scene.surface_labels, label)[1:-1, 1:-1]
        if on.any():
            agree = np.sum(cross * scene.normals[1:-1, 1:-1], axis=2)[on]
            assert np.median(agree) > 0.995


@pytest.mark.parametrize("family", CAMERA_FAMILIES)
def test_points_lie_on_the_rays_of_the_camera(family):
    scene = make_scene(family, 0, **SMALL)
    rays = scene.frame.camera.rays(120, 160)
    for points in (scene.clean_points, scene.frame.points):
        np.testing.assert_allclose(points, rays * points[..., 2:], atol=1e-5)


def test_a_camera_of_ones_own_is_used():
    camera = PinholeCamera(100.0, 110.0, 70.0, 65.0)
    scene = make_scene("room", 0, camera=camera, **SMALL)
    assert scene.frame.camera == camera
    rays = camera.rays(120, 160)
    np.testing.assert_allclose(scene.clean_points, rays * scene.clean_points[..., 2:], atol=1e-5)


# ---- noise


def inverse_error(scene):
    z, clean = scene.frame.points[..., 2].astype(float), scene.clean_points[..., 2]
    return 1 / z - 1 / clean


def test_camera_noise_is_constant_in_inverse_depth():
    scene = make_scene("room", 0)
    error = inverse_error(scene)
    near = scene.clean_points[..., 2] < np.median(scene.clean_points[..., 2])
    for part in (near, ~near):
        assert error[part].std() == pytest.approx(KINECT_SIGMA_INVERSE_M, rel=0.02)
        assert abs(error[part].mean()) < 2e-5
    wanted = KINECT_SIGMA_INVERSE_M * scene.clean_points[..., 2] ** 2
    np.testing.assert_allclose(scene.sigma_range, wanted, rtol=1e-5)


@pytest.mark.parametrize("family", SCANNER_FAMILIES)
def test_scanner_noise_is_some_tenths_of_a_millimetre(family):
    scene = make_scene(family, 0)
    seen = scene.labels > 0
    error = (scene.frame.points - scene.clean_points)[seen]
    sigma = scene.sigma_range[seen][0]
    assert 1e-4 <= sigma <= 4e-4
    assert error[:, 2].std() == pytest.approx(sigma, rel=0.02)
    assert 0 < error[:, 0].std() < 0.3 * sigma


def test_colour_noise_has_the_sigma_that_was_asked_for():
    scene = make_scene("room", 0, color_noise=5.0)
    error = scene.frame.color.astype(float) - scene.clean_color
    middle = (scene.clean_color > 30) & (scene.clean_color < 225)
    assert error[middle].std() == pytest.approx(np.hypot(5, 1 / np.sqrt(12)), rel=0.02)


def test_noise_can_be_scaled_and_switched_off():
    double = make_scene("room", 0, noise=2.0, **SMALL)
    assert inverse_error(double).std() == pytest.approx(2 * KINECT_SIGMA_INVERSE_M, rel=0.05)
    still = make_scene("room", 0, noise=0.0, color_noise=0.0, **SMALL)
    assert np.abs(inverse_error(still)).max() < 1e-6
    assert np.abs(still.frame.color - still.clean_color).max() <= 0.5


def test_correlated_noise_keeps_its_variance():
    scene = make_scene("room", 0, correlation_px=2.0)
    error = inverse_error(scene)
    assert error.std() == pytest.approx(KINECT_SIGMA_INVERSE_M, rel=0.05)
    for lag in (1, 2, 4):
        correlation = np.mean(error[:, lag:] * error[:, :-lag]) / error.var()
        assert correlation == pytest.approx(np.exp(-(lag**2) / (4 * 2.0**2)), abs=0.05)
    white = inverse_error(make_scene("room", 0))
    assert abs(np.mean(white[:, 1:] * white[:, :-1]) / white.var()) < 0.02


def test_quantised_disparities_are_multiples_of_the_step():
    scene = make_scene("room", 0, quantization=0.125)
    disparity = 525 * 0.075 / scene.frame.points[..., 2].astype(float)
    steps = disparity / 0.125
    assert np.abs(steps - np.round(steps)).max() < 1e-3
    total = np.hypot(KINECT_SIGMA_INVERSE_M, 0.125 / (525 * 0.075) / np.sqrt(12))
    assert inverse_error(scene).std() == pytest.approx(total, rel=0.03)
    np.testing.assert_allclose(scene.sigma_range, total * scene.clean_points[..., 2] ** 2, rtol=1e-5)


@pytest.mark.parametrize("family", ["room", "painting"])
def test_outliers_hit_each_signal_on_its_own_and_are_known(family):
    plain, spoilt = make_scene(family, 0), make_scene(family, 0, outliers=0.2)
    seen = spoilt.labels > 0
    ranges, colors = spoilt.range_outliers[seen], spoilt.color_outliers[seen]
    assert ranges.mean() == pytest.approx(0.2, abs=0.01)
    assert colors.mean() == pytest.approx(0.2, abs=0.01)
    assert np.mean(ranges & colors) == pytest.approx(0.04, abs=0.005)
    kept = seen & ~spoilt.range_outliers
    assert (spoilt.frame.points[kept] == plain.frame.points[kept]).all()
    assert (spoilt.frame.color[~spoilt.color_outliers] == plain.frame.color[~spoilt.color_outliers]).all()
    z, clean = spoilt.frame.points[..., 2], plain.frame.points[..., 2]
    assert np.nanmin(clean) <= z[seen].min()
    assert z[seen].max() <= np.nanmax(clean)
    off = np.abs(z - clean)[seen & spoilt.range_outliers]
    assert np.median(off) > 0.1 * np.ptp(clean[seen])


def test_drop_out_takes_range_and_leaves_the_truth():
    plain, holes = make_scene("room", 0), make_scene("room", 0, dropout=0.3)
    assert (~holes.frame.valid).mean() == pytest.approx(0.3, abs=0.01)
    assert (holes.dropped == ~holes.frame.valid).all()
    assert (holes.labels == plain.labels).all()
    assert (holes.frame.color == plain.frame.color).all()
    kept = holes.frame.valid
    assert (holes.frame.points[kept] == plain.frame.points[kept]).all()


def test_shading_darkens_and_keeps_the_truth():
    plain, lit = (make_scene("curved", 0, shading=s, **SMALL) for s in (False, True))
    assert (lit.labels == plain.labels).all()
    assert (lit.frame.points == plain.frame.points).all()
    factor = lit.clean_color / np.maximum(plain.clean_color, 1)
    assert factor.min() > 0.3
    assert factor.max() <= 1 + 1e-5
    assert np.ptp(factor) > 0.2
    channels = factor.reshape(-1, 3)
    assert np.ptp(channels, axis=1).max() < 1e-4, "a white lamp keeps the hue"


def test_texture_is_printed_on_some_surfaces_and_is_no_truth():
    plain, printed = (make_scene("room", 0, texture=t, **SMALL) for t in (0.0, 0.5))
    assert (printed.labels == plain.labels).all()
    changed = (printed.clean_color != plain.clean_color).any(axis=2)
    surfaces = plain.surface_labels
    shares = [changed[surfaces == number].mean() for number in range(1, surfaces.max() + 1)]
    assert any(share == 0 for share in shares)
    assert any(0.05 < share < 0.95 for share in shares)


# ---- structured light


def test_structured_light_has_shadow_flying_pixels_and_the_same_truth():
    plain, seen = make_scene("room", 1), make_scene("room", 1, structured_light=True)
    assert (seen.labels == plain.labels).all()
    assert 0.001 < seen.dropped.mean() < 0.1
    assert 0.0005 < seen.range_outliers.mean() < 0.05
    edge = cv2.dilate(plain.clean_points[..., 2], np.ones((3, 3))) - cv2.erode(
        plain.clean_points[..., 2], np.ones((3, 3))
    )
    assert (edge[seen.range_outliers] > 0.02).all()
    wild = np.abs(inverse_error(seen)) > 8 * KINECT_SIGMA_INVERSE_M
    assert not (wild & ~seen.range_outliers & seen.frame.valid).any()


def test_the_projector_shadow_is_what_the_rectified_disparities_hide():
    """A projector to the right sees column c - d: of two points of a row that land there the nearer hides the
    other. Points hidden this way, found from the clean depth alone, are dropped."""
    scene = make_scene("curved", 2, structured_light=True)
    depth = scene.clean_points[..., 2]
    disparity = 525 * 0.075 / depth
    columns = np.arange(640) - disparity
    hidden = np.zeros(depth.shape, bool)
    for row in range(480):
        nearest = {}
        for col in np.argsort(-disparity[row]):
            cell = round(columns[row, col])
            hidden[row, col] = nearest.get(cell, 0.0) > disparity[row, col] + 1.0
            nearest[cell] = max(nearest.get(cell, 0.0), disparity[row, col])
    assert hidden.mean() > 0.003
    core = cv2.erode(hidden.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert scene.dropped[core].mean() > 0.98
    near_hidden = cv2.dilate(hidden.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    inside = np.zeros_like(hidden)
    inside[:, 60:] = True  # points beside the image cast shadows into its left border only
    assert (scene.dropped & inside & ~near_hidden).sum() < 0.05 * scene.dropped.sum()


# ---- bad options


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("kitchen", 0), "unknown family 'kitchen'"),
        (("room", 0, {"outliers": 1.5}), "outliers is 1.5"),
        (("room", 0, {"dropout": -0.1}), "dropout is -0.1"),
        (("room", 0, {"width": 8}), "8 x 480"),
        (("billiard", 0, {"structured_light": True}), "needs a camera"),
        (("painting", 0, {"quantization": 0.1}), "needs a camera"),
        (("painting", 0, {"camera": default_camera(640, 480)}), "takes no camera"),
    ],
)
def test_bad_options_are_one_clear_line(arguments, text):
    family, seed, *more = arguments
    with pytest.raises(InputError) as error:
        make_scene(family, seed, **(more[0] if more else {}))
    assert text in str(error.value)
    assert "\n" not in str(error.value)


def test_colours_that_must_differ_differ():
    colors = distinct_colors(np.random.default_rng(0), 9)
    gaps = np.abs(colors[:, None] - colors[None]).max(axis=2)[~np.eye(9, dtype=bool)]
    assert gaps.min() >= LEAST_DIFFERENCE
    with pytest.raises(InputError, match="do not fit"):
        distinct_colors(np.random.default_rng(0), 500)


def test_regions_painted_on_one_surface_differ_clearly_in_the_picture():
    for family, seed in (("billiard", 0), ("painting", 0), ("room", 2)):
        scene = make_scene(family, seed, **SMALL)
        means = [scene.clean_color[scene.labels == n].mean(axis=0) for n in range(1, scene.labels.max() + 1)]
        right = np.stack([scene.labels[:, :-1].ravel(), scene.labels[:, 1:].ravel()], axis=1)
        same = (scene.surface_labels[:, :-1] == scene.surface_labels[:, 1:]).ravel()
        pairs = np.unique(right[same & (right[:, 0] != right[:, 1]) & (right > 0).all(axis=1)], axis=0)
        assert len(pairs)
        for a, b in pairs:
            assert np.abs(means[a - 1] - means[b - 1]).max() > LEAST_DIFFERENCE - 12


# ---- a sequence


def test_a_sequence_keeps_its_objects_and_its_world():
    frames = make_tabletop_sequence(4, 1, width=160, height=120)
    assert len(frames) == 4
    numbers = [set(np.unique(frame.object_labels)) for frame in frames]
    assert all({1, 2, 3} <= n for n in numbers)
    assert len(numbers[0]) >= 6
    assert (frames[0].object_labels != frames[-1].object_labels).mean() > 0.02
    first, last = frames[0], frames[-1]
    on = first.clean_points[inner(first.object_labels, 1)]
    world = on @ first.pose[:3, :3].T + first.pose[:3, 3]
    assert np.ptp(world[:, 2]) < 1e-9, "the table top is level in the world"
    seen = (world - last.pose[:3, 3]) @ last.pose[:3, :3]
    camera = last.frame.camera
    cols = np.round(camera.fx * seen[:, 0] / seen[:, 2] + camera.cx).astype(int)
    rows = np.round(camera.fy * seen[:, 1] / seen[:, 2] + camera.cy).astype(int)
    inside = (cols >= 0) & (cols < 160) & (rows >= 0) & (rows < 120)
    labels = last.object_labels[rows[inside], cols[inside]]
    assert np.mean(labels == 1) > 0.8, "points of the table are found on the table from the other side"
    covered = labels != 1
    depth = last.clean_points[rows[inside], cols[inside], 2]
    assert (depth[covered] < seen[inside][covered, 2] + 0.02).all(), "what covers them is nearer"


def test_frames_of_a_sequence_have_noise_of_their_own():
    frames = make_tabletop_sequence(2, 1, width=160, height=120, sweep_rad=0.0, options=SensorOptions())
    one, two = frames
    same = one.object_labels == two.object_labels
    errors = [f.frame.points[..., 2] - f.clean_points[..., 2] for f in frames]
    assert abs(np.corrcoef(errors[0][same], errors[1][same])[0, 1]) < 0.05


def test_a_sequence_without_frames_is_refused():
    with pytest.raises(InputError, match="at least 1"):
        make_tabletop_sequence(0, 1)
