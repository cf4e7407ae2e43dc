"""RegionArray: the same from both message libraries, and enough to evaluate, draw and cut the regions."""

from __future__ import annotations

import re
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig, segment
from rcseg_core.shapes.primitives import NONE
from rcseg_core.synthetic import make_scene
from rcseg_ros.frames.conversions import Header
from rcseg_ros.patches import evaluate_patch, surface_points
from rcseg_ros.recordings.result_bag import make_message, serialize
from rcseg_ros.results.markers import draw
from rcseg_ros.results.messages import region_array
from rcseg_ros.results.outputs import header_message

OF_REGIONS = {"surfaces", "boxes", "normals", "labels"}
MSG = Path(__file__).parents[2] / "rcseg_msgs" / "msg"


@pytest.fixture(scope="module", params=["camera", "scanner"])
def case(request):
    """(frame, result, message as rosbags makes it)."""
    cols = np.arange(120) + np.zeros((90, 1))
    depth_m = (1 / (0.5 + 0.002 * cols)).astype(np.float32)
    depth_m[30:60, 20:50] = 1.1
    depth_m += np.random.default_rng(0).normal(0, 0.001, depth_m.shape).astype(np.float32)
    color = np.where((cols < 70)[..., None], (60, 90, 120), (180, 150, 90)).astype(np.uint8)
    frame = RangeColorFrame.from_depth(depth_m, color, PinholeCamera(130.0, 130.0, 59.5, 44.5))
    if request.param == "scanner":
        frame = RangeColorFrame(frame.points, frame.color)
    result = segment(frame, SegmenterConfig())
    return (
        frame,
        result,
        region_array(frame, result, header_message(Header(5, "f"), make_message), make_message),
    )


def test_every_field_is_commented():
    for path in MSG.glob("*.msg"):
        lines = path.read_text().splitlines()
        for i, line in enumerate(lines):
            if re.match(r"[a-z]\w*(/\w+)?(\[[<=\d]*\])?\s+[a-z]", line):
                documented = "#" in line or path.stem == "PixelBox"  # its head says all
                assert documented, f"{path.name}:{i + 1}: {line}"


def test_one_region_a_label_in_order(case):
    frame, result, message = case
    assert (message.height, message.width) == result.labels.shape
    assert [r.label for r in message.regions] == list(range(1, len(result.regions) + 1))
    assert message.k[0] == (frame.camera.fx if frame.camera else 0.0)
    for region in message.regions:
        inside = result.labels == region.label
        assert region.pixel_count == inside.sum()
        rows, cols = np.nonzero(inside)
        box = region.pixels
        assert (box.row_min, box.col_min, box.row_max, box.col_max) == (
            rows.min(),
            cols.min(),
            rows.max(),
            cols.max(),
        )
        assert set(np.unique(result.surface_labels[inside])) == {region.surface}


def test_patches_evaluate_from_the_message_alone(case):
    frame, result, message = case
    rows, cols = np.mgrid[0 : frame.height : 5, 0 : frame.width : 5]
    for region, core in zip(message.regions, result.regions, strict=True):
        for one, other in ((region.range_patch, core.range_patch), (region.color_patch, core.color_patch)):
            np.testing.assert_allclose(
                evaluate_patch(one, rows, cols), other.evaluate(rows, cols), rtol=1e-9, atol=1e-9
            )
        inside = result.labels[rows, cols] == region.label
        points, _ = result.reconstruct()
        surface = surface_points(message, region, rows[inside], cols[inside])
        np.testing.assert_allclose(surface, points[rows[inside], cols[inside]], atol=2e-4)


def test_noise_and_uncertainty_have_the_scale_of_the_scene(case):
    frame, _, message = case
    region = message.regions[0]
    depth_m = region.centroid.z
    sigma_m = region.range_patch.noise_sigma[-1] * (depth_m**2 if frame.camera else 1.0)
    assert 0.0003 < sigma_m < 0.004  # 1 mm was added
    assert np.all(np.asarray(region.range_patch.standard_errors) < 10 * region.range_patch.noise_sigma[-1])


def test_both_message_libraries_give_the_same_message(live, case):
    from rclpy.serialization import deserialize_message

    from rcseg_msgs.msg import RegionArray
    from rcseg_ros.results.messages import make_rcl

    frame, result, message = case
    of_rclpy = region_array(frame, result, header_message(Header(5, "f"), make_rcl), make_rcl)
    live.assert_same(deserialize_message(bytes(serialize(message)), RegionArray), of_rclpy)


def test_the_merge_tree_cuts_as_the_core_does(case):
    _, result, message = case
    parent, height = message.hierarchy.parent, message.hierarchy.height
    count = len(message.regions)
    assert np.all(height[:count] == 1) and np.all(height[count:] > 1)
    assert all(p == 0 or (p > n and height[p - 1] >= height[n - 1]) for n, p in enumerate(parent, start=1))
    for level in (1.0, 2.0, 16.0):
        tops = []
        for node in range(1, count + 1):
            while parent[node - 1] and height[parent[node - 1] - 1] <= level:
                node = int(parent[node - 1])
            tops.append(node)
        image = np.concatenate([[0], tops])[result.labels]
        expected = result.labels_at(level)
        pairs = {(int(a), int(b)) for a, b in zip(image.ravel(), expected.ravel(), strict=True)}
        assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs}), "another partition"


def test_persistence_can_be_read_off_the_merge_tree(case):
    _, result, message = case
    parent, height = message.hierarchy.parent, message.hierarchy.height
    for region, core in zip(message.regions, result.regions, strict=True):
        above = int(parent[region.label - 1])
        assert region.persistence == core.persistence
        assert (region.persistence == np.inf) == (above == 0)
        if above:  # born at level 1 at the latest
            assert region.persistence >= height[above - 1] * (1 - 1e-12)


def test_surfaces_hold_their_regions_and_a_shape(case):
    _, result, message = case
    assert [s.label for s in message.surfaces] == list(range(1, result.surface_labels.max() + 1))
    for surface in message.surfaces:
        inside = result.surface_labels == surface.label
        assert surface.pixel_count == inside.sum()
        assert set(surface.regions) == {r.label for r in message.regions if r.surface == surface.label}
        assert all(message.regions[label - 1].surface == surface.label for label in surface.regions)
    wall, box = message.surfaces[:2]
    # the wall is z = 1 / (0.5 + 0.002 col): x, z with 1 = 0.5 z + 0.002 (130 x + 59.5 z)
    normal = np.array([0.26, 0.0, 0.619]) / np.hypot(0.26, 0.619)
    for shape, wanted, distance in (
        (wall.primitive, -normal, -1 / np.hypot(0.26, 0.619)),
        (box.primitive, (0, 0, -1), -1.1),
    ):
        assert shape.kind == 1 and shape.convex
        np.testing.assert_allclose(shape.parameters[:3], wanted, atol=2e-3)
        assert shape.parameters[3] == pytest.approx(distance, abs=2e-3)
        covariance = np.reshape(shape.covariance, (4, 4))
        assert np.all(np.linalg.eigvalsh(covariance) > -1e-12)
        assert 1e-6 < np.sqrt(covariance[3, 3]) < 1e-3
        assert 3e-4 < shape.rms < 2e-3 and 0.5 < shape.rms_sigma < 2


def test_shapes_are_told_in_minimal_local_form(case):
    _frame, result, message = case
    told = {name: sum(len(getattr(s, name)) for s in message.surfaces) for name in ("plane", "sphere")}
    assert told["plane"] == sum(s.primitive.kind == 1 for s in message.surfaces) > 1 and told["sphere"] == 0
    for surface, core in zip(message.surfaces, result.surfaces, strict=True):
        for plane in surface.plane:
            matrix, at = core.plane.pose, plane.pose.position
            turn = Rotation.from_quat([getattr(plane.pose.orientation, axis) for axis in "xyzw"])
            np.testing.assert_allclose(turn.as_matrix(), matrix[:3, :3], atol=1e-9)
            np.testing.assert_allclose((at.x, at.y, at.z), matrix[:3, 3])
            np.testing.assert_array_equal(np.reshape(plane.covariance, (3, 3)), core.plane.covariance)
            np.testing.assert_array_equal(np.reshape(plane.systematic, (3, 3)), core.plane.systematic)


def test_balls_and_cylinders_are_told_in_minimal_local_form():
    scene = make_scene("curved", 1, width=320, height=240)
    result = segment(scene.frame)
    header = header_message(Header(5, "f"), make_message)
    message = region_array(scene.frame, result, header, make_message)
    counts = dict.fromkeys(("sphere", "cylinder"), 0)
    for surface, core in zip(message.surfaces, result.surfaces, strict=True):
        for name in counts:
            for form in getattr(surface, name):
                wanted = getattr(core, name)
                assert form.radius == wanted.radius
                np.testing.assert_array_equal(form.covariance, wanted.covariance.ravel())
                counts[name] += 1
    assert min(counts.values()) > 0, counts
    kinds = [s.primitive.kind for s in message.surfaces]
    assert counts == {"sphere": kinds.count(2), "cylinder": kinds.count(3)}
    serialize(message)


def test_no_shape_is_told_as_none(case):
    frame, result, _ = case
    shapeless = [replace(surface, primitive=NONE, local=None) for surface in result.surfaces]
    other = copy(result)
    other.__dict__["surfaces"] = shapeless
    message = region_array(frame, other, header_message(Header(5, "f"), make_message), make_message)
    assert len(message.surfaces) == len(shapeless) > 0
    for surface in message.surfaces:
        shape = surface.primitive
        assert shape.kind == len(shape.parameters) == len(shape.covariance) == 0
        assert len(surface.plane) == len(surface.sphere) == len(surface.cylinder) == 0
        assert np.isnan([shape.rms, shape.rms_sigma, shape.misfit, shape.p_value]).all()


def test_the_noise_is_told_with_its_unit(case):
    frame, result, message = case
    noise = message.noise
    assert noise.source == "estimated"
    assert len(noise.range_law) == 3 * noise.channels == 3 * (1 if frame.camera else 3)
    assert noise.range_correlation >= 1 and noise.color_correlation >= 1
    # the rays of the grid pass through one point, so that it is segmented in inverse depth without a camera
    assert noise.depth == pytest.approx(np.nanmedian(frame.depth_m), rel=0.05)
    if frame.camera:
        a, b, c = noise.range_law
        sigma_w = a + b / noise.depth + c / noise.depth**2
        assert noise.sigma == pytest.approx(sigma_w * noise.depth**2, rel=1e-6)
    assert noise.tolerance == pytest.approx(0.004 * noise.depth, rel=1e-6)
    assert 5e-4 < noise.sigma < 2e-3  # 1 mm was added
    np.testing.assert_array_equal(noise.color_sigma, result.noise.color)


def test_markers_draw_every_region(case):
    _, result, message = case
    markers = draw(message, result.labels)
    for region in message.regions:
        mine = {m.name: m for m in markers if m.label == region.label and m.name in OF_REGIONS}
        assert mine.keys() == OF_REGIONS
        assert len(mine["boxes"].points) == 24 and len(mine["normals"].points) == 2
        corners = mine["surfaces"].points
        assert len(corners) % 3 == 0
        center = np.array([region.centroid.x, region.centroid.y, region.centroid.z])
        assert np.linalg.norm(corners.mean(axis=0) - center) < 0.2


def test_markers_draw_spheres_and_cylinders_where_they_are():
    scene = make_scene("curved", 1, width=320, height=240)
    result = segment(scene.frame)
    message = region_array(scene.frame, result, header_message(Header(5, "f"), make_message), make_message)
    drawn = {m.label: m.points for m in draw(message, result.labels) if m.name == "shapes"}
    kinds = {s.label: s.primitive for s in result.surfaces if s.primitive.kind in ("sphere", "cylinder")}
    assert drawn.keys() == kinds.keys() and {k.kind for k in kinds.values()} == {"sphere", "cylinder"}
    for label, shape in kinds.items():
        lines, values = drawn[label], shape.parameters
        assert len(lines) % 2 == 0
        local = lines - values["center" if shape.kind == "sphere" else "point"]
        if shape.kind == "cylinder":
            height = local @ values["axis"]
            points = scene.clean_points[result.surface_labels == label]
            seen = (points - values["point"]) @ values["axis"]
            assert height.min() < np.nanquantile(seen, 0.02) and height.max() > np.nanquantile(seen, 0.98)
            assert np.ptp(height) < 1.5 * np.nanmax(seen) - 1.5 * np.nanmin(seen)
            local = local - height[:, None] * values["axis"]
        np.testing.assert_allclose(np.linalg.norm(local, axis=1), values["radius"], rtol=1e-9)
