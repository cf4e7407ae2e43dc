"""Categories, polygons, objects and clouds as messages: what they say is what the core found, and what a
reader finds in them without the core agrees with the pixels."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rcseg_core import SegmenterConfig, segment
from rcseg_core.synthetic import make_scene
from rcseg_core.world import CATEGORIES
from rcseg_ros.frames.conversions import Header, decode_cloud, decode_labels
from rcseg_ros.frames.up import Told, UpSettings, up_complaint, up_values
from rcseg_ros.recordings.result_bag import make_message, message_definitions, result_types, serialize
from rcseg_ros.results.made import ResultMessages
from rcseg_ros.results.marker_bytes import ARROW, MARKER_ARRAY, TEXT, TRIANGLES, Drawing, marker_array
from rcseg_ros.results.markers import draw, shapely_polygon
from rcseg_ros.results.outputs import header_message

NO_UP = SegmenterConfig().replace({"world.up_from": "none"})


def messages_of(scene, config=None, **told):
    result = segment(scene.frame, config)
    told = {"told": Told(**told)} if told else {}
    return ResultMessages(Header(7, "camera"), scene.frame, result, make_message, **told), result


@pytest.fixture(scope="module")
def scene():
    return make_scene("blocks", 3, width=320, height=240)


@pytest.fixture(scope="module")
def made(scene):
    return messages_of(scene)


def received(made):
    """A message that was serialised as it was made."""
    message = result_types().deserialize_cdr(made.data, made.type)
    assert bytes(serialize(message)) == made.data
    return message


def cloud_array(message):
    kinds = {7: "<f4", 6: "<u4", 2: "u1"}
    layout = np.dtype(
        {
            "names": [f.name for f in message.fields],
            "formats": [kinds[f.datatype] for f in message.fields],
            "offsets": [f.offset for f in message.fields],
            "itemsize": message.point_step,
        }
    )
    assert message.row_step == message.width * message.point_step
    return np.frombuffer(message.data, layout).reshape(message.height, message.width)


def test_the_constants_are_the_cores_names():
    text = message_definitions()["rcseg_msgs/msg/Surface"]
    told = {name: int(value) for name, value in re.findall(r"^uint8 ([A-Z]+)=(\d+)", text, re.MULTILINE)}
    assert told == {
        "UNKNOWN" if name == "unlabelled" else name.upper(): i for i, name in enumerate(CATEGORIES)
    }


def test_surfaces_carry_category_and_object(made):
    messages, result = made
    array, world = messages.regions, result.world()
    kinds = {CATEGORIES[s.category] for s in array.surfaces}
    assert {"floor", "vertical", "horizontal"} <= kinds
    for surface, category in zip(array.surfaces, world.categories, strict=True):
        assert CATEGORIES[surface.category] == category.name
        assert surface.category_probability == category.probability
        inside = world.object_labels[result.surface_labels == surface.label]
        assert set(np.unique(inside)) == {surface.object}
    np.testing.assert_allclose((array.up.x, array.up.y, array.up.z), world.up.vector)
    serialize(array)


def test_polygons_hold_the_pixels_of_their_plane(made, scene):
    """From the message alone: nine pixels in ten of a plane lie inside of one of its polygons."""
    messages, result = made
    from shapely import contains_xy

    points, large = scene.clean_points, 0
    for surface in messages.regions.surfaces:
        if not surface.plane:
            assert not surface.polygons
            continue
        pose = surface.plane[0].pose
        turn = Rotation.from_quat(
            [pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w]
        )
        local = turn.inv().apply(points.reshape(-1, 3) - [pose.position.x, pose.position.y, pose.position.z])
        polygons = [shapely_polygon(p) for p in surface.polygons]
        assert all(p.is_valid for p in polygons)
        inside = np.any([contains_xy(p, local[:, 0], local[:, 1]) for p in polygons], axis=0)
        mine = (result.surface_labels == surface.label).ravel() & (abs(local[:, 2]) < 0.02)
        if mine.sum() > 500:
            large += 1
            assert inside[mine].mean() > 0.9
        for told, polygon in zip(surface.polygons, polygons, strict=True):
            assert told.area == pytest.approx(polygon.area) and polygon.exterior.is_ccw
            assert not any(hole.is_ccw for hole in polygon.interiors)
    assert large >= 4


def test_one_polygon_instance_a_plane(made):
    messages, result = made
    told = {
        p.polygon.id: np.array([(c.x, c.y, c.z) for c in p.polygon.polygon.points]) for p in messages.polygons
    }
    planes = {
        s.label: s.plane
        for s in result.surfaces
        if s.plane is not None and result.world().boundaries[s.label - 1].polygons
    }
    assert told.keys() == planes.keys() and len(told) > 3
    for label, corners in told.items():
        np.testing.assert_allclose(corners @ planes[label].normal, planes[label].distance, atol=1e-5)
    assert {p.header.frame_id for p in messages.polygons} == {"camera"}
    for message in messages.polygons:
        serialize(message)


def test_objects_are_boxes_round_their_points(made, scene):
    messages, result = made
    labels, array = decode_labels(messages.object_labels), messages.objects
    assert len(array.objects) >= 2 and labels.max() == len(array.objects)
    for one in array.objects:
        inside = labels == one.label
        rows, cols = np.nonzero(inside)
        box = one.pixels
        assert (box.row_min, box.row_max, box.col_min, box.col_max) == (
            rows.min(),
            rows.max(),
            cols.min(),
            cols.max(),
        )
        assert one.pixel_count == inside.sum()
        assert set(one.surfaces) == set(np.unique(result.surface_labels[inside]))
        pose, size = one.box_pose, one.box_size
        turn = Rotation.from_quat(
            [pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w]
        )
        local = turn.inv().apply(
            scene.frame.points[inside] - [pose.position.x, pose.position.y, pose.position.z]
        )
        held = (abs(local) < np.array([size.x, size.y, size.z]) / 2 + 0.02).all(axis=1)
        assert held.mean() > 0.9
        assert one.stands_on == 0 or (array.objects and one.stands_on <= len(result.surfaces))
    serialize(array)


def test_ground_and_obstacles_are_all_points_once(made, scene):
    messages, result = made
    ground, obstacle = (cloud_array(received(m)) for m in (messages.ground_points, messages.obstacle_points))
    assert ground.size + obstacle.size == scene.frame.valid.sum() and min(ground.size, obstacle.size) > 1000
    at = result.world().ground == 1
    np.testing.assert_allclose(
        np.stack([ground[k][0] for k in "xyz"], axis=1), scene.frame.points[at], rtol=1e-6
    )
    np.testing.assert_array_equal(ground["label"][0], result.labels[at])
    np.testing.assert_array_equal(ground["surface"][0], result.surface_labels[at])
    assert received(messages.ground_points).is_dense


def test_the_labelled_cloud_is_the_input_with_labels(made, scene):
    messages, result = made
    message, world = received(messages.labelled_points), result.world()
    cloud, seen = cloud_array(message), scene.frame.valid
    assert cloud.shape == seen.shape
    xyz = np.stack([cloud[k] for k in "xyz"], axis=2)
    np.testing.assert_allclose(xyz[seen], scene.frame.points[seen], rtol=1e-6)
    assert np.isnan(xyz[~seen]).all()
    expected = {
        "label": result.labels, "surface": result.surface_labels,
        "object": world.object_labels, "class": world.class_mask,
    }  # fmt: skip
    for name, image in expected.items():
        np.testing.assert_array_equal(cloud[name], image, name)
    np.testing.assert_array_equal(decode_cloud(message).color[seen], scene.frame.color[seen])


def test_without_up_what_needs_it_is_silent_and_says_why(scene):
    messages, result = messages_of(scene, NO_UP)
    assert messages.class_mask is messages.ground_points is messages.obstacle_points is None
    assert np.isnan(messages.regions.up.x)
    assert cloud_array(received(messages.labelled_points))["class"].max() > 0
    assert up_values(messages.world) == {"world.up": "unknown"}
    reason, words = up_complaint(messages.world, Told(), UpSettings())
    assert reason == "up_unknown" and words.endswith("are silent: world.up_from is none")
    assert up_complaint(messages.world, Told(None, "tf", "no transform"), UpSettings())[1].endswith(
        ": no transform"
    )
    assert len(result.surfaces) > 3


@pytest.mark.parametrize(("degrees", "tilted"), [(0.0, False), (5.0, True)])
def test_a_wrong_transform_is_named(scene, degrees, tilted):
    """The up of the scene, turned by so much about the camera's z axis."""
    config = SegmenterConfig().replace({"world.up_from": "tf"})
    true = segment(scene.frame).world().up.vector
    up = Rotation.from_euler("z", degrees, degrees=True).apply(true)
    angle = np.rad2deg(np.arccos(np.clip(up @ true, -1, 1)))
    messages, _ = messages_of(scene, config, vector=up, source="tf")
    values = up_values(messages.world)
    assert values["world.up_from"] == "tf"
    assert float(values["world.tilt_deg"].split()[0]) == pytest.approx(angle, abs=0.1)
    found = up_complaint(messages.world, messages.told, UpSettings(frame="base"))
    assert (found is not None) == tilted
    if tilted:
        assert found[0] == "up_tilted" and "the transform to base (up.frame) is wrong" in found[1]


def test_markers_fill_and_outline_polygons_and_frame_objects(made):
    messages, result = made
    drawn = draw(messages.regions, result.labels, messages.objects)
    by_name = {
        name: {d.label: d for d in drawn if d.name == name}
        for name in ("polygons", "outlines", "objects", "object_labels")
    }
    assert (
        set(by_name["objects"])
        == set(by_name["object_labels"])
        == {o.label for o in messages.objects.objects}
    )
    for surface in messages.regions.surfaces:
        if surface.polygons:
            a, b, c = by_name["polygons"][surface.label].points.reshape(-1, 3, 3).transpose(1, 0, 2)
            area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
            assert area == pytest.approx(sum(p.area for p in surface.polygons), rel=1e-6)
            ends = by_name["outlines"][surface.label].points.reshape(-1, 2, 3)
            length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum()
            assert length == pytest.approx(sum(shapely_polygon(p).length for p in surface.polygons))


def test_marker_bytes_are_those_of_the_message():
    """Of every kind, with names and texts of every length, as alignment depends on them."""
    rng = np.random.default_rng(0)
    drawings = [
        Drawing(
            "n" * k, k, kind, rng.normal(size=(k, 3)), (0.25, 0.5, 1.0), 0.5, (1, 2, 3), (k, 0.5, -1), "ü" * k
        )
        for k in range(9)
        for kind in (ARROW, TEXT, TRIANGLES)
    ]
    header = header_message(Header(3_000_000_004, "frame"), make_message)
    data = marker_array(header, drawings).data
    message = result_types().deserialize_cdr(data, MARKER_ARRAY)
    assert bytes(serialize(message)) == data
    first, *markers = message.markers
    assert first.action == 3
    for marker, drawing in zip(markers, drawings, strict=True):
        assert (marker.ns, marker.id, marker.type, marker.text) == (
            drawing.name,
            drawing.label,
            drawing.kind,
            drawing.text,
        )
        assert (marker.header.stamp.sec, marker.header.stamp.nanosec, marker.header.frame_id) == (
            3,
            4,
            "frame",
        )
        np.testing.assert_array_equal(
            [(p.x, p.y, p.z) for p in marker.points] or np.empty((0, 3)), drawing.points
        )
        assert (marker.color.r, marker.color.g, marker.color.b, marker.color.a) == (0.25, 0.5, 1.0, 0.5)
        assert (marker.scale.x, marker.scale.y, marker.scale.z) == (1, 2, 3)
        assert (marker.pose.position.x, marker.pose.orientation.w) == (drawing.position[0], 1.0)
