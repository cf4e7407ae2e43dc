"""Messages of other packages by their public definitions: every field filled, and the numbers right.

The classes are made of the field lists below, so none of these packages need be installed.
"""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation
from shapely import Polygon

from rcseg_core import LocalPlane
from rcseg_core.errors import ConfigError
from rcseg_core.world import Box3d, Category, Object
from rcseg_ros.bridges import BRIDGES, Bridge, available, load
from rcseg_ros.bridges.moveit import CollisionScene
from rcseg_ros.bridges.shape import plane_message, prism
from rcseg_ros.bridges.terrain import empty_grid_map, planar_terrain
from rcseg_ros.bridges.vision import detection_array, label_info

DEFINITIONS = {
    "vision_msgs/msg/VisionClass": "uint16 class_id\nstring class_name",
    "vision_msgs/msg/LabelInfo": (
        "std_msgs/Header header\nvision_msgs/VisionClass[] class_map\nfloat32 threshold"
    ),
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
        "vision_msgs/BoundingBox3D bbox\nstring id"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections",
    "object_recognition_msgs/msg/ObjectType": "string key\nstring db",
    "moveit_msgs/msg/CollisionObject": (
        "std_msgs/Header header\ngeometry_msgs/Pose pose\nstring id\n"
        "object_recognition_msgs/ObjectType type\n"
        "shape_msgs/SolidPrimitive[] primitives\ngeometry_msgs/Pose[] primitive_poses\n"
        "shape_msgs/Mesh[] meshes\ngeometry_msgs/Pose[] mesh_poses\n"
        "shape_msgs/Plane[] planes\ngeometry_msgs/Pose[] plane_poses\n"
        "string[] subframe_names\ngeometry_msgs/Pose[] subframe_poses\n"
        "byte ADD=0\nbyte REMOVE=1\nbyte APPEND=2\nbyte MOVE=3\nbyte operation"
    ),
    "convex_plane_decomposition_msgs/msg/Point2d": "float64 x\nfloat64 y",
    "convex_plane_decomposition_msgs/msg/Polygon2d": "convex_plane_decomposition_msgs/Point2d[] points",
    "convex_plane_decomposition_msgs/msg/PolygonWithHoles2d": (
        "convex_plane_decomposition_msgs/Polygon2d outer_boundary\n"
        "convex_plane_decomposition_msgs/Polygon2d[] holes"
    ),
    "convex_plane_decomposition_msgs/msg/BoundingBox2d": (
        "float64 min_x\nfloat64 min_y\nfloat64 max_x\nfloat64 max_y"
    ),
    "convex_plane_decomposition_msgs/msg/PlanarRegion": (
        "geometry_msgs/Pose plane_parameters\nconvex_plane_decomposition_msgs/BoundingBox2d bbox2d\n"
        "convex_plane_decomposition_msgs/PolygonWithHoles2d boundary\n"
        "convex_plane_decomposition_msgs/PolygonWithHoles2d[] insets"
    ),
    "grid_map_msgs/msg/GridMapInfo": (
        "float64 resolution\nfloat64 length_x\nfloat64 length_y\ngeometry_msgs/Pose pose"
    ),
    "grid_map_msgs/msg/GridMap": (
        "std_msgs/Header header\ngrid_map_msgs/GridMapInfo info\nstring[] layers\nstring[] basic_layers\n"
        "std_msgs/Float32MultiArray[] data\nuint16 outer_start_index\nuint16 inner_start_index"
    ),
    "convex_plane_decomposition_msgs/msg/PlanarTerrain": (
        "convex_plane_decomposition_msgs/PlanarRegion[] planar_regions\ngrid_map_msgs/GridMap gridmap"
    ),
}
SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def store():
    made = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for name, text in DEFINITIONS.items():
        types.update(get_types_from_msg(text, name))
    made.register(types)
    return made


@pytest.fixture(scope="module")
def make(store):
    return lambda name, **fields: store.types[name](**fields)


@pytest.fixture(scope="module")
def header(make):
    stamp = make("builtin_interfaces/msg/Time", sec=1, nanosec=2)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id="camera")


# A table top of 0.8 m by 0.6 m with a hole of 0.1 m, tilted and away from the origin.
TABLE = Polygon(
    [(-0.4, -0.3), (0.4, -0.3), (0.4, 0.3), (-0.4, 0.3)], [[(0, 0), (0.1, 0), (0.1, 0.1), (0, 0.1)]]
)


def plane(at=(0.2, 0.3, 1.5), turn=(2.0, 0.1, 0.3)):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", turn).as_matrix()
    pose[:3, 3] = at
    return LocalPlane(pose, np.zeros((3, 3)), np.zeros((3, 3)))


def world_of(*categories, polygons=((TABLE,),), objects=()):
    return SimpleNamespace(
        categories=[Category(name, 0.9, {name: 0.9}) for name in categories],
        boundaries=[SimpleNamespace(rings=(), polygons=parts) for parts in polygons],
        objects=objects,
    )


def surface(label, form):
    return SimpleNamespace(label=label, plane=form)


def serializes(store, message):
    data = store.serialize_cdr(message, message.__msgtype__)
    assert store.serialize_cdr(store.deserialize_cdr(data, message.__msgtype__), message.__msgtype__) == data


def test_objects_are_detections(store, make, header):
    pose = np.eye(4)
    pose[:3, 3] = 1.0, 2.0, 3.0
    world = world_of(objects=(Object(1, (2, 3), 50, Box3d(pose, np.array([0.1, 0.2, 0.3])), 1),))
    message = detection_array(world, header, make)
    serializes(store, message)
    (found,) = message.detections
    assert (found.id, found.header.frame_id, found.results[0].hypothesis.score) == ("1", "camera", 1.0)
    assert (found.bbox.center.position.z, found.bbox.size.y) == (3.0, 0.2)
    assert detection_array(world, header, make, ids=[17]).detections[0].id == "17"


def test_label_info_names_the_values_of_the_mask(store, make, header):
    message = label_info(header, make)
    serializes(store, message)
    names = {c.class_id: c.class_name for c in message.class_map}
    assert names[0] == "unlabelled" and names[1] == "floor" and names[4] == "vertical" and len(names) == 9


def test_the_plane_equation_holds_on_the_plane(store, make):
    form = plane()
    message = plane_message(form, make)
    serializes(store, message)
    points = np.random.default_rng(0).uniform(-1, 1, (20, 2)) @ form.pose[:3, :2].T + form.origin
    np.testing.assert_allclose(points @ message.coef[:3] + message.coef[3], 0, atol=1e-12)
    assert np.linalg.norm(message.coef[:3]) == pytest.approx(1)


def test_a_prism_is_closed_and_holds_its_volume():
    vertices, faces = prism(TABLE, 0.02)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = {tuple(e) for e in edges.tolist()}
    assert len(there) == len(edges) and all((b, a) in there for a, b in there), "not a closed surface"
    a, b, c = vertices[faces].transpose(1, 0, 2)
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(TABLE.area * 0.02)


def test_horizontal_surfaces_are_added_and_removed_when_gone(store, make, header):
    scene = CollisionScene(thickness_m=0.02, gone_after_s=2.0)
    surfaces = [surface(1, plane()), surface(2, plane((1, 1, 2))), surface(3, plane((0, 0, 4)))]
    world = world_of("horizontal", "vertical", "floor", polygons=((TABLE, TABLE), (TABLE,), (TABLE,)))
    first = scene.update(surfaces, world, 0, header, make)
    assert [(m.id, m.operation, len(m.meshes)) for m in first] == [("rcseg_1", 0, 2), ("rcseg_2", 0, 1)]
    for message in first:
        serializes(store, message)
        assert len(message.mesh_poses) == len(message.meshes)
    assert first[0].pose.position.z == 1.5
    # the same table a little on, under another label; the floor is out of sight
    moved = [surface(1, plane((0.23, 0.3, 1.5)))]
    again = scene.update(moved, world_of("horizontal"), SECOND, header, make)
    assert [(m.id, m.operation) for m in again] == [("rcseg_1", 0)]
    late = scene.update(moved, world_of("horizontal"), 3 * SECOND, header, make)
    assert [(m.id, m.operation) for m in late] == [("rcseg_1", 0), ("rcseg_2", 1)]
    assert late[1].meshes == []
    assert not scene.update([], world_of(polygons=()), 4 * SECOND, header, make)
    assert [m.id for m in scene.update([], world_of(polygons=()), 6 * SECOND, header, make)] == ["rcseg_1"]
    assert not scene.update([], world_of(polygons=()), 20 * SECOND, header, make)


def test_ids_of_tracks_are_kept_and_a_bag_may_loop(make, header):
    scene = CollisionScene(gone_after_s=1.0)
    world = world_of("horizontal")
    (message,) = scene.update([surface(1, plane())], world, 9 * SECOND, header, make, ids=[0, 42])
    assert message.id == "rcseg_42"
    assert not CollisionScene().update([surface(1, plane())], world, 0, header, make, ids=[0, 0])
    back = scene.update([surface(1, plane())], world, 0, header, make, ids=[0, 42])
    assert [(m.id, m.operation) for m in back] == [("rcseg_42", 0)]
    assert [m.operation for m in scene.update([], world_of(polygons=()), 2 * SECOND, header, make)] == [1]


def test_planes_that_face_up_are_terrain(store, make, header):
    form = plane()
    surfaces = [surface(1, form), surface(2, plane()), surface(3, None), surface(4, plane())]
    world = world_of(
        "horizontal", "vertical", "sphere", "inclined", polygons=((TABLE,), (TABLE,), (), (TABLE,))
    )
    message = planar_terrain(surfaces, world, 0.05, empty_grid_map(header, make), make)
    serializes(store, message)
    assert len(message.planar_regions) == 2 and message.gridmap.header.frame_id == "camera"
    region = message.planar_regions[0]
    q = region.plane_parameters.orientation
    np.testing.assert_allclose(
        Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), form.pose[:3, :3], atol=1e-12
    )
    assert (region.bbox2d.min_x, region.bbox2d.max_y) == (-0.4, 0.3)

    def area(ring):
        return Polygon([(p.x, p.y) for p in ring.points]).area

    assert area(region.boundary.outer_boundary) == pytest.approx(0.48)
    assert area(region.boundary.holes[0]) == pytest.approx(0.01)
    (inset,) = region.insets
    assert area(inset.outer_boundary) == pytest.approx(0.7 * 0.5)
    assert area(inset.holes[0]) == pytest.approx(0.2 * 0.2)


def test_an_inset_may_leave_nothing_or_two_parts(make, header):
    waist = Polygon(
        [
            (0, 0),
            (1, 0),
            (1, 0.02),
            (2, 0.02),
            (2, 0),
            (3, 0),
            (3, 1),
            (2, 1),
            (2, 0.05),
            (1, 0.05),
            (1, 1),
            (0, 1),
        ]
    )
    for inset_m, parts in ((0.0, 1), (0.05, 2), (0.6, 0)):
        terrain = planar_terrain(
            [surface(1, plane())],
            world_of("floor", polygons=((waist,),)),
            inset_m,
            empty_grid_map(header, make),
            make,
        )
        assert len(terrain.planar_regions[0].insets) == parts


def test_a_missing_package_is_one_line():
    assert available("numpy") and not available("no_such_msgs")
    with pytest.raises(ConfigError, match=r"no_such_msgs: no_such_msgs/msg/Thing is not installed; install"):
        load(Bridge("things", "no_such_msgs/msg/Thing"))
    known = {bridge.type for bridges in BRIDGES.values() for bridge in bridges}
    assert known <= set(DEFINITIONS) and {b.package for bs in BRIDGES.values() for b in bs} == set(BRIDGES)


class _Fake:
    """Stands for a message class of rclpy: keyword fields, and a kind that rclpy takes its own way."""

    def __init__(self, **fields):
        self.__dict__.update(fields)

    @classmethod
    def get_fields_and_field_types(cls):
        return {"operation": "octet"}


def test_the_node_publishes_what_is_turned_on_to_who_listens(monkeypatch):
    pytest.importorskip("rclpy")
    pytest.importorskip("rcseg_msgs.msg")
    from rcseg_core import segment
    from rcseg_core.synthetic import make_scene
    from rcseg_ros.frames.conversions import Header
    from rcseg_ros.live.bridges import NodeBridges
    from rcseg_ros.live.publishers import ResultPublishers
    from rcseg_ros.options import NODE_PARAMETERS

    for name in DEFINITIONS:
        package, _, kind = name.split("/")
        module = sys.modules.get(f"{package}.msg") or ModuleType(f"{package}.msg")
        monkeypatch.setitem(sys.modules, f"{package}.msg", module)
        monkeypatch.setitem(sys.modules, package, sys.modules.get(package) or ModuleType(package))
        setattr(module, kind, type(kind, (_Fake,), {}))
    heard, published = set(), []

    def publisher(kind, topic, qos, **_):
        return SimpleNamespace(
            is_activated=True,
            get_subscription_count=lambda: int(topic in heard),
            publish=lambda message: published.append((topic, message)),
        )

    parameters = {p.key: p.default for p in NODE_PARAMETERS}
    assert not NodeBridges(parameters).topics
    parameters |= {f"bridges.{name}": True for name in BRIDGES}
    node = SimpleNamespace(create_lifecycle_publisher=publisher)
    results = ResultPublishers(node, NodeBridges(parameters))
    scene = make_scene("blocks", 3, width=160, height=120)
    result = segment(scene.frame)
    results.publish_rest(results.messages(Header(5, "f"), scene.frame, result))
    assert [topic for topic, _ in published] == ["~/label_info"], "latched; the others for nobody"
    published.clear()
    heard |= {"~/detections", "~/collision_objects", "~/planar_terrain"}
    results.publish_rest(results.messages(Header(6, "f"), scene.frame, result))
    made = {topic: [m for t, m in published if t == topic] for topic in heard}
    assert len(made["~/detections"][0].detections) == len(result.objects) > 0
    assert {m.operation for m in made["~/collision_objects"]} == {b"\x00"}
    assert len(made["~/planar_terrain"][0].planar_regions) > 0
