"""segment() on scanner grids without a camera: planes and balls of exact scans, all that a result offers."""

import numpy as np
import pytest
from scans import BALL, BALL_SURFACE, HALL, PLANES, SMALL_BOXES, frame_of, room_scan, spherical_rays, tilt

from rcseg_core import RangeColorFrame, SegmenterConfig, segment
from rcseg_core.datasets import load_frame
from rcseg_core.errors import ConfigError
from rcseg_core.evaluation.frames import evaluate_labels
from rcseg_core.resampling.views import pinhole_view
from rcseg_core.signal.reflectance import normalize_reflectance
from rcseg_core.synthetic import make_scene

XYZ = SegmenterConfig().replace({"signal.kind": "xyz"})
LIDAR = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # x ahead, y left, z up


@pytest.fixture(scope="module")
def scan():
    return room_scan()


@pytest.fixture(scope="module")
def result(scan):
    return segment(scan[0])


def best_overlap(surface, labels, number):
    """Intersection over union of a true surface with the label that covers most of it."""
    at = surface == number
    label = np.bincount(labels[at]).argmax()
    found = labels == label
    return (at & found).sum() / (at | found).sum(), label


@pytest.mark.parametrize("axes", [np.eye(3), LIDAR, tilt(15, 20, -30)], ids=["optical", "lidar", "tilted"])
def test_planes_and_a_ball_come_out_whole(axes):
    frame, surface = room_scan(axes=axes)
    labels = segment(frame).surface_labels
    for number in np.unique(surface[surface > 0]):
        assert best_overlap(surface, labels, number)[0] > 0.93, number
    assert np.count_nonzero(np.bincount(labels.ravel())[1:] > 20) == np.unique(surface[surface > 0]).size


def test_faces_of_boxes_are_found_that_x_y_z_misses():
    frame, surface = room_scan(300, 380, planes=HALL, boxes=SMALL_BOXES, ball=None)
    found = {}
    for kind in ("auto", "xyz"):
        labels = segment(frame, SegmenterConfig().replace({"signal.kind": kind})).surface_labels
        found[kind] = evaluate_labels(surface, labels, mask=frame.valid).at(0.8)
    assert found["auto"].correct == found["auto"].truth_regions == 18
    assert found["xyz"].correct < 18


def test_the_result_is_on_the_grid_itself(scan, result):
    frame, _ = scan
    assert result.camera is None
    for image in (result.labels, result.surface_labels, result.edges):
        assert image.shape == frame.valid.shape
    assert result.labels.dtype == result.surface_labels.dtype == np.int32 and result.edges.dtype == np.uint8
    sizes = np.bincount(result.labels.ravel())[1:]
    assert (np.diff(sizes) <= 0).all() and (sizes > 0).all()
    assert (np.diff(np.bincount(result.surface_labels.ravel())[1:]) <= 0).all()
    assert len(result.regions) == sizes.size
    for k, region in enumerate(result.regions, 1):
        rows, cols = np.nonzero(result.labels == k)
        assert (region.label, region.pixel_count) == (k, rows.size)
        assert region.box == (rows.min(), cols.min(), rows.max(), cols.max())
        assert set(result.surface_labels[rows, cols]) == {region.surface}
        assert all(k in result.regions[n - 1].neighbors for n in region.neighbors)
    assert {"view", "grid"} <= set(result.timings)
    assert result.noise.range_law.shape == (3, 3)


def test_patches_stand_for_the_points_of_the_grid(scan, result):
    frame, _ = scan
    points, color = result.reconstruct()
    assert np.isfinite(points[result.labels > 0]).all()
    exact = room_scan(sigma=0.0)[0].points
    error = np.linalg.norm(points - exact, axis=-1)
    assert np.median(error) < 0.002  # the noise along the rays
    assert (np.abs(color[result.labels > 0].astype(int) - 128) <= 1).all()
    for region in result.regions[:3]:
        rows, cols = np.nonzero(result.labels == region.label)
        assert region.range_patch.kind == "xyz"
        np.testing.assert_allclose(region.range_patch.evaluate(rows, cols), points[rows, cols], atol=1e-4)
        np.testing.assert_allclose(region.centroid, frame.points[rows, cols].mean(axis=0), atol=0.03)


@pytest.mark.parametrize("axes", [np.eye(3), LIDAR], ids=["optical", "lidar"])
def test_normals_of_planes_are_theirs_and_face_the_scanner(axes):
    frame, surface = room_scan(axes=axes)
    result = segment(frame)
    for number, (normal, _) in enumerate(PLANES, 1):
        overlap, label = best_overlap(surface, result.labels, number)
        wanted = -np.asarray(normal, float) @ axes.T / np.linalg.norm(normal)
        found = result.regions[label - 1].normal
        assert overlap > 0.9 and np.degrees(np.arccos(found @ wanted)) < 3, number


def test_levels_only_join_and_the_tree_holds_every_region(result):
    labels = result.labels
    assert result.nodes.shape == (labels.max() + 1,)
    np.testing.assert_array_equal(result.labels_at(1), labels)
    finer = None
    for level in (0, 0.5, 1, 2, 10, 1000):
        coarser = result.labels_at(level)
        np.testing.assert_array_equal(coarser > 0, labels > 0)
        if finer is not None:  # each finer region lies in one coarser one
            pairs = np.unique(np.stack([finer.ravel(), coarser.ravel()]), axis=1)
            assert np.unique(pairs[0]).size == pairs.shape[1]
        finer = coarser
    assert result.labels_at(0).max() > labels.max() > result.labels_at(1000).max()


def test_levels_of_the_grid_are_those_of_its_view():
    frame, _ = room_scan(200, 250, planes=HALL, boxes=SMALL_BOXES, ball=None, sigma=0.004)
    result = segment(frame)
    back = pinhole_view(frame, frame.color, SegmenterConfig()).back
    renumbered = np.unique(np.stack([result.labels, result.view.labels.ravel()[back]]).reshape(2, -1), axis=1)
    assert (renumbered[0] != renumbered[1]).any(), "the scene must number its regions anew"
    top = result.tree.cut(1.0)[result.leaves]
    for region in result.regions:  # most pixels of a region came with leaves below its node
        inside = result.labels == region.label
        assert np.bincount(top[inside]).argmax() == result.nodes[region.label]
    for level in (0.3, 1.5, 4, 20):
        here, there = result.labels_at(level), result.view.labels_at(level).ravel()[back]
        assert 1 < here.max() == np.unique(there).size
        pairs = np.unique(np.stack([here, there]).reshape(2, -1), axis=1)
        assert pairs.shape[1] == here.max(), level


def test_levels_are_lengths_at_the_median_depth(scan, result):
    scale = result.scale
    ahead = np.nanmedian(scan[0].points @ np.array([0, np.sin(np.deg2rad(5)), np.cos(np.deg2rad(5))]))
    assert scale.depth_m == pytest.approx(ahead, rel=0.15)
    assert scale.tolerance_m == pytest.approx(SegmenterConfig().grouping.range_tolerance * scale.depth_m)
    assert all(region.persistence >= 1 for region in result.regions)
    np.testing.assert_array_equal(result.labels_at(tolerance_m=scale.tolerance_m), result.labels)


def test_surfaces_are_the_shapes_that_they_are(scan, result):
    for number, kind in [(1, "plane"), (2, "plane"), (3, "plane"), (BALL_SURFACE, "sphere")]:
        label = best_overlap(scan[1], result.surface_labels, number)[1]
        assert result.surfaces[label - 1].primitive.kind == kind, number


@pytest.mark.parametrize("order", ["joint", "surfaces_first", "range_only"])
def test_every_order_of_work_goes_through_the_view(scan, order):
    frame, surface = scan
    result = segment(frame, SegmenterConfig().replace({"grouping.order": order}))
    assert "view" in result.timings
    assert evaluate_labels(surface, result.surface_labels, mask=frame.valid).at(0.8).matched >= 6
    assert result.labels_at(0).max() >= result.labels_at(0.5).max() >= result.labels.max()


def test_the_same_scan_gives_the_same_result(scan, result):
    again = segment(scan[0])
    for name in ("labels", "surface_labels", "edges", "leaves"):
        np.testing.assert_array_equal(getattr(again, name), getattr(result, name))
    np.testing.assert_array_equal(again.reconstruct()[0], result.reconstruct()[0])


def test_a_mirrored_scan_gives_the_mirrored_surfaces(scan, result):
    frame, surface = scan
    mirrored = RangeColorFrame(np.ascontiguousarray(frame.points[:, ::-1]), frame.color)
    labels = segment(mirrored).surface_labels[:, ::-1]
    for number in np.unique(surface[surface > 0]):
        assert best_overlap(surface, labels, number)[0] > 0.93, number


def test_a_scan_stored_by_columns_gives_the_same_surfaces(scan):
    frame, surface = scan
    points, color = (np.ascontiguousarray(image.swapaxes(0, 1)) for image in (frame.points, frame.color))
    result = segment(RangeColorFrame(points, color))
    assert "view" in result.timings
    for number in np.unique(surface[surface > 0]):
        assert best_overlap(surface, result.surface_labels.T, number)[0] > 0.93, number


def test_colours_on_a_plane_are_regions_of_one_surface():
    straight = spherical_rays(np.linspace(20, -20, 120), np.linspace(-25, 25, 150))
    range_m = 2.0 / straight[..., 2]
    color = np.full((120, 150, 3), 60, np.uint8)
    color[:, 75:] = (200, 90, 40)
    result = segment(frame_of(straight, range_m, sigma=0.002, color=color))
    assert result.surface_labels.max() == 1
    assert result.labels.max() == 2
    assert (result.labels[:, :74] == result.labels[0, 0]).all()
    assert (result.labels[:, 76:] == result.labels[0, 149]).all()
    assert result.regions[0].neighbors == (2,)


def test_missing_pixels_and_points_in_the_origin_stay_unlabelled(scan):
    frame, surface = scan
    points = np.array(frame.points)
    rng = np.random.default_rng(4)
    lost = rng.random(surface.shape) < 0.25
    points[lost] = np.nan
    points[10:20, 10:30] = (0.0, 0.0, 1e-12)
    result = segment(RangeColorFrame(points, frame.color))
    assert (result.labels[lost] == 0).all() and (result.labels[10:20, 10:30] == 0).all()
    there = ~lost
    there[10:20, 10:30] = False
    assert (result.labels[there] > 0).mean() > 0.99  # pixels all alone may stay without a region
    assert (result.edges[lost] & 3 == 0).all()
    surface = np.where(there, surface, 0)
    assert evaluate_labels(surface, result.surface_labels, mask=there).at(0.8).correct >= 5


def test_light_is_taken_out_once(scan):
    frame, _ = scan
    rng = np.random.default_rng(5)
    color = np.clip(150 + 4 * rng.normal(size=frame.color.shape), 0, 255).astype(np.uint8)
    lit = RangeColorFrame(frame.points, color)
    config = SegmenterConfig().replace({"reflectance.mode": "active"})
    before = RangeColorFrame(frame.points, normalize_reflectance(lit, config.reflectance))
    np.testing.assert_array_equal(segment(lit, config).labels, segment(before).labels)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("keep", ["one row", "one column", "few points", "one point seen by all"])
def test_bad_grids_are_segmented_as_before(scan, keep):
    points = np.full_like(scan[0].points, np.nan)
    if keep == "one row":
        points[70] = scan[0].points[70]
    elif keep == "one column":
        points[:, 90] = scan[0].points[:, 90]
    elif keep == "few points":
        points[::30, ::30] = scan[0].points[::30, ::30]
    else:
        points[:] = (0.1, 0.2, 1.0)
    frame = RangeColorFrame(points, scan[0].color)
    result = segment(frame)
    assert "view" not in result.timings
    np.testing.assert_array_equal(result.labels, segment(frame, XYZ).labels)


@pytest.mark.parametrize("family", ["painting", "billiard"])
def test_grids_of_parallel_rays_are_segmented_as_before(family):
    frame = make_scene(family, 42, width=240, height=180).frame
    result, before = segment(frame), segment(frame, XYZ)
    for name in ("labels", "surface_labels", "edges"):
        np.testing.assert_array_equal(getattr(result, name), getattr(before, name))
    assert result.timings.keys() == before.timings.keys()


def test_a_cloud_of_a_camera_needs_no_intrinsics():
    frame = make_scene("room", 41, width=240, height=180).frame
    with_camera = segment(frame)
    without = segment(RangeColorFrame(frame.points, frame.color))
    assert (with_camera.surface_labels == without.surface_labels).mean() > 0.995
    assert without.regions[0].range_patch.kind == "xyz"


def test_inverse_depth_without_centre_is_refused():
    frame = make_scene("painting", 42, width=120, height=90).frame
    config = SegmenterConfig().replace({"signal.kind": "inverse_depth"})
    with pytest.raises(ConfigError, match="rays"):
        segment(frame, config)
    result = segment(room_scan(60, 80)[0], config)
    assert "view" in result.timings and result.regions[0].range_patch.kind == "xyz"


def test_planes_of_a_recorded_benchmark(shared_data):
    folder = shared_data / "synpeb"
    if not folder.is_dir():
        pytest.skip("no SynPEB data")
    recorded = load_frame(folder / "test_500.npz")
    labels = segment(recorded.frame).surface_labels
    found = evaluate_labels(recorded.truth, labels, mask=recorded.frame.valid).at(0.8)
    assert found.truth_regions == 37 and found.correct >= 32 and found.noise <= 3


def test_the_ball_is_one_surface(scan, result):
    _, surface = scan
    overlap, label = best_overlap(surface, result.surface_labels, BALL_SURFACE)
    assert overlap > 0.93
    regions = [r for r in result.regions if r.surface == label]
    distance = np.linalg.norm(np.asarray(BALL[0]))
    assert np.linalg.norm(regions[0].centroid) == pytest.approx(distance - 0.6 * BALL[1], abs=0.1)


@pytest.mark.parametrize("axes", [LIDAR, tilt(15, 20, -30)], ids=["x ahead", "tilted"])
def test_a_depth_camera_in_other_axes_gives_what_it_gives_in_its_own(axes):
    scene = make_scene("blocks", 41, width=160, height=120).frame
    own = segment(RangeColorFrame(scene.points, scene.color))
    turned = segment(RangeColorFrame((scene.points @ axes.T).astype(np.float32), scene.color))
    assert evaluate_labels(own.surface_labels, turned.surface_labels).covering > 0.95
    for region, other in zip(own.regions[:2], turned.regions[:2], strict=True):
        np.testing.assert_allclose(other.centroid, axes @ region.centroid, atol=0.02)
        np.testing.assert_allclose(other.normal, axes @ region.normal, atol=0.02)


def test_a_floor_at_z_0_of_a_map_is_a_surface():
    """It vanished: z = 0 was taken for missing."""
    rays = spherical_rays(np.linspace(5, -45, 100), np.linspace(-35, 35, 140), LIDAR)
    origin = np.array([2.0, 3.0, 1.2])
    down = np.where(rays[..., 2] < 0, -1.2 / np.where(rays[..., 2] < 0, rays[..., 2], -1), np.inf)
    ahead = 3.0 / rays[..., 0]
    points = origin + rays * np.minimum(down, ahead)[..., None]
    floor = down < ahead
    points[floor, 2] = 0.0
    frame = RangeColorFrame(points, np.full(points.shape, 128, np.uint8))
    assert frame.valid.all() and 0.3 < floor.mean() < 0.9
    labels = segment(frame).surface_labels
    for number in (False, True):
        assert best_overlap(floor, labels, number)[0] > 0.93
