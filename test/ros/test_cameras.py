"""K or P, raw or rectified, one frame or two: what the pixels of a pair of images see.

The truth is a slanted plane with a pattern, seen by rays that are bent by the formulas of plumb_bob,
rational_polynomial and equidistant lenses as their papers give them, written here again.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from rcseg_core import PinholeCamera
from rcseg_ros.frames.assembly import assemble
from rcseg_ros.frames.cameras import choose_view, is_rectified, project, raw_rays, shows
from rcseg_ros.frames.conversions import CameraModel, MessageError, decode_camera_info
from rcseg_ros.frames.extrinsic import TransformTree
from rcseg_ros.frames.registration import Surroundings, registered_by_name
from rcseg_ros.results.outputs import cloud_message, depth_message, picture_message

HEIGHT, WIDTH = 60, 80
K = PinholeCamera(70.0, 71.0, 39.5, 29.5)
P = PinholeCamera(64.0, 66.0, 41.0, 28.0)
BENT = (-0.2, 0.05, 0.002, -0.001, 0.01)
PLANE, DISTANCE = np.array([0.2, -0.1, 1.0]), 1.5
LENSES = [
    ("plumb_bob", BENT),
    ("plumb_bob", BENT[:4]),
    ("rational_polynomial", (0.2, -0.1, 0.001, 0.002, 0.03, 0.1, -0.05, 0.01)),
    ("equidistant", (0.05, -0.02, 0.01, -0.004)),
]


def bend(x, y, model, d):
    """Distorted coordinates of the rays x, y, after Brown, OpenCV's rational form, and Kannala."""
    r = np.hypot(x, y)
    if model == "equidistant":
        theta = np.arctan(r)
        bent = theta * (1 + sum(k * theta ** (2 * i + 2) for i, k in enumerate(d)))
        scale = np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)
        return x * scale, y * scale
    k1, k2, p1, p2, k3, k4, k5, k6 = (*d, 0.0, 0.0, 0.0, 0.0, 0.0)[:8]
    radial = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
        y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
    )


def unbend(x, y, model, d):
    """The rays whose bent coordinates are given, by bisection along nothing: a fixed point, long enough."""
    u, v = x.copy(), y.copy()
    for _ in range(500):
        a, b = bend(u, v, model, d)
        u, v = u + 0.5 * (x - a), v + 0.5 * (y - b)
    return u, v


def rays_of(pinhole, model="", d=(), height=HEIGHT, width=WIDTH):
    cols, rows = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    x, y = (cols - pinhole.cx) / pinhole.fx, (rows - pinhole.cy) / pinhole.fy
    if model:
        x, y = unbend(x, y, model, d)
    return np.stack([x, y, np.ones_like(x)], axis=2)


def scene(rays, origin=(0.0, 0.0, 0.0)):
    """Depth along z and colour of the patterned plane, whose pattern is smooth in x and y."""
    depth = (DISTANCE - PLANE @ np.array(origin)) / (rays @ PLANE)
    return depth.astype(np.float32), pattern(np.array(origin) + rays * depth[..., None])


def pattern(points):
    x, y = points[..., 0], points[..., 1]
    waves = [np.sin(9 * x), np.cos(7 * y), np.sin(6 * (x + y))]
    return np.rint(128 + 100 * np.stack(waves, axis=-1)).astype(np.uint8)


def make(_, **fields):
    return SimpleNamespace(**fields)


def head(frame_id="cam", stamp_ns=0):
    stamp = SimpleNamespace(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return SimpleNamespace(stamp=stamp, frame_id=frame_id)


def info(k=K, p=P, model="plumb_bob", d=(0.0,) * 5, r=np.eye(3), frame_id="cam", size=(HEIGHT, WIDTH)):
    roi = SimpleNamespace(x_offset=0, y_offset=0, height=0, width=0)
    return SimpleNamespace(
        header=head(frame_id), height=size[0], width=size[1], distortion_model=model, d=np.array(d),
        k=np.zeros(9) if k is None else k.matrix().ravel(), r=np.asarray(r).ravel(),
        p=np.zeros(12) if p is None else np.c_[p.matrix(), np.zeros(3)].ravel(), binning_x=0, binning_y=0,
        roi=roi,
    )  # fmt: skip


def depth_image(depth, frame_id="cam"):
    return depth_message(depth, head(frame_id), make)


def color_image(color, frame_id="cam"):
    return picture_message(color, head(frame_id), make)


def cloud(rays, depth, color=None, frame_id="cam"):
    points = (rays * depth[..., None]).astype(np.float32)
    shape = depth.shape
    own = np.zeros((*shape, 3), np.uint8) if color is None else color
    message = cloud_message(points, own, np.zeros(shape, np.int32), head(frame_id), make)
    message.fields = [f for f in message.fields if color is not None or f.name != "rgb"]
    return message


def check(made, pinhole, matrix, *words, inner=4):
    """The frame shows the plane and its pattern through that pinhole, and says so."""
    frame = made.frame
    assert frame.camera == pinhole and made.geometry.matrix == matrix
    for word in words:
        assert word in str(made.geometry)
    valid = frame.valid.copy()
    valid[:inner], valid[-inner:], valid[:, :inner], valid[:, -inner:] = False, False, False, False
    assert valid.mean() > 0.5
    points = frame.points[valid].astype(float)
    np.testing.assert_allclose(points @ PLANE, DISTANCE, atol=4e-3)
    off = np.abs(frame.color[valid].astype(int) - pattern(points))
    assert np.median(off) <= 3 and off.max() < 25


# K or P.


@pytest.mark.parametrize(
    ("range_topic", "color_topic"),
    [
        ("/camera/depth/image_rect", "/camera/rgb/image_rect_color"),
        ("/camera/depth/image_rect_raw", "/camera/image"),
        ("/camera/depth", "/kinect2/qhd/image_color_rect/compressed"),
        ("/left_rect/depth", "/left_rect/image"),
    ],
)
@pytest.mark.parametrize("d", [(0.0,) * 5, BENT])
def test_rectified_images_are_seen_through_p(range_topic, color_topic, d):
    rays = rays_of(P)
    depth, color = scene(rays)
    around = Surroundings(range_topic, color_topic)
    made = assemble(depth_image(depth), color_image(color), info(d=d), None, around)
    check(made, P, "P", "rectified", inner=1)
    np.testing.assert_array_equal(made.frame.color, color)


def test_raw_images_without_distortion_are_seen_through_k():
    depth, color = scene(rays_of(K))
    for around in (Surroundings(), Surroundings("/depth/image_raw", "/rgb/image_raw")):
        made = assemble(depth_image(depth), color_image(color), info(), None, around)
        check(made, K, "K", "without distortion", inner=1)
        np.testing.assert_array_equal(made.frame.color, color)


@pytest.mark.parametrize(("model", "d"), LENSES)
@pytest.mark.parametrize("p", [P, None])
def test_raw_images_with_distortion_are_rectified_together(model, d, p):
    depth, color = scene(rays_of(K, model, d))
    made = assemble(depth_image(depth), color_image(color), info(p=p, model=model, d=d))
    check(made, p or K, "P" if p else "K", f"distortion {model}, rectified here")


def test_a_rectifying_rotation_turns_depth_and_colour():
    angle = 0.05
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
    rays = rays_of(K, "plumb_bob", BENT) @ turn.T  # in rectified axes, which the plane is given in
    along, color = scene(rays)
    depth = along.astype(float)[..., None] * rays @ turn  # back to raw axes, whose z a raw depth image has
    made = assemble(depth_image(depth[..., 2].astype(np.float32)), color_image(color), info(d=BENT, r=turn))
    check(made, P, "P")


@pytest.mark.parametrize("turn", [0.0, 0.1])
def test_under_a_rectifying_rotation_a_raw_image_is_not_that_of_p(turn):
    """Though P is K: only without a rotation are both images one."""
    rotation = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    camera = decode_camera_info(info(p=K, r=rotation))
    rectified, raw = choose_view(camera, colour=True), choose_view(camera, colour=False)
    assert (rectified.matrix, raw.matrix) == ("P", "K")
    assert shows(rectified, camera, True) and shows(raw, camera, False)
    assert shows(rectified, camera, False) == (turn == 0.0)


def test_a_raw_and_a_rectified_image_meet_in_p():
    depth, _ = scene(rays_of(K, "plumb_bob", BENT))
    _, color = scene(rays_of(P))
    around = Surroundings("/camera/depth_registered/image_raw", "/camera/rgb/image_rect_color")
    check(assemble(depth_image(depth), color_image(color), info(d=BENT), None, around), P, "P", "colour")
    depth, _ = scene(rays_of(P))
    _, color = scene(rays_of(K))
    around = Surroundings("/camera/depth/image_rect", "/camera/rgb/image_raw")
    check(assemble(depth_image(depth), color_image(color), info(), None, around), P, "P", "depth")


def test_the_user_has_the_last_word():
    depth, color = scene(rays_of(P))
    raw_by_name = Surroundings("/depth/image_raw", "/rgb/image_raw", images="rectified")
    check(assemble(depth_image(depth), color_image(color), info(d=BENT), None, raw_by_name), P, "P")
    depth, color = scene(rays_of(K))
    rect_by_name = Surroundings("/depth/image_rect", "/rgb/image_rect", images="raw")
    check(assemble(depth_image(depth), color_image(color), info(), None, rect_by_name), K, "K")


def test_k_of_zero_with_a_good_p_is_a_calibrated_camera():
    depth, color = scene(rays_of(P))
    for d in ((), BENT):
        made = assemble(depth_image(depth), color_image(color), info(k=None, d=d))
        check(made, P, "P", "K is zero", inner=1)
    with pytest.raises(MessageError) as caught:
        assemble(depth_image(depth), color_image(color), info(k=None, p=None))
    assert caught.value.reason == "uncalibrated_camera"


@pytest.mark.parametrize(("pinhole", "matrix"), [(K, "K"), (P, "P")])
@pytest.mark.parametrize("topic", ["/image", "/image_raw", "/image_rect"])
def test_points_of_a_cloud_tell_k_from_p(pinhole, matrix, topic):
    rays = rays_of(pinhole)
    depth, color = scene(rays)
    for d in ((0.0,) * 5, BENT):
        around = Surroundings("/points", topic)
        made = assemble(cloud(rays, depth), color_image(color), info(d=d), None, around)
        check(made, pinhole, matrix, "points of the cloud fit", inner=1)
        made = assemble(cloud(rays, depth, color), None, info(d=d), None, around)
        check(made, pinhole, matrix, inner=1)


def test_a_cloud_of_a_raw_image_with_distortion_is_rectified_with_it():
    rays = rays_of(K, "plumb_bob", BENT)
    depth, color = scene(rays)
    check(assemble(cloud(rays, depth), color_image(color), info(d=BENT)), P, "P", "rectified here")


def test_a_cloud_of_neither_is_refused():
    other = PinholeCamera(120.0, 120.0, 39.5, 29.5)
    rays = rays_of(other)
    depth, color = scene(rays)
    with pytest.raises(MessageError, match="by K and P") as caught:
        assemble(cloud(rays, depth), color_image(color), info(d=BENT))
    assert caught.value.reason == "camera_mismatch"


def test_unorganised_clouds_are_projected_into_the_view_of_the_image():
    rays = rays_of(P)
    depth, _ = scene(rays)
    flat = cloud(rays.reshape(1, -1, 3), depth.reshape(1, -1))
    _, color = scene(rays_of(K, "plumb_bob", BENT))
    around = Surroundings("/points", "/image_raw")
    check(assemble(flat, color_image(color), info(d=BENT), None, around), P, "P", "rectified here")
    _, color = scene(rays)
    around = Surroundings("/points", "/image_rect")
    check(assemble(flat, color_image(color), info(d=BENT), None, around), P, "P", "rectified colour")


def test_an_unknown_lens_is_refused_only_where_its_distortion_matters():
    depth, color = scene(rays_of(P))
    strange = info(model="pincushion", d=BENT)
    with pytest.raises(MessageError, match="pincushion") as caught:
        assemble(depth_image(depth), color_image(color), strange)
    assert caught.value.reason == "unknown_distortion"
    around = Surroundings("/depth/image_rect", "/image_rect")
    check(assemble(depth_image(depth), color_image(color), strange, None, around), P, "P", inner=1)
    check(assemble(cloud(rays_of(P), depth), color_image(color), strange), P, "P", inner=1)


@pytest.mark.parametrize(("model", "d"), LENSES)
def test_rays_of_raw_images_are_the_lens_backwards(model, d):
    camera = CameraModel(K, HEIGHT, WIDTH, model, d)
    rays = raw_rays(camera)
    np.testing.assert_allclose(rays, rays_of(K, model, d)[..., :2], atol=2e-4)
    x, y = bend(rays[..., 0], rays[..., 1], model, d)
    ours = project(rays.reshape(-1, 2), camera).reshape(HEIGHT, WIDTH, 2)
    np.testing.assert_allclose(ours[..., 0], K.fx * x + K.cx, atol=1e-6)
    np.testing.assert_allclose(ours[..., 1], K.fy * y + K.cy, atol=1e-6)


def test_a_lens_whose_model_turns_back_leaves_its_corners_out():
    camera = CameraModel(PinholeCamera(30.0, 30.0, 39.5, 29.5), HEIGHT, WIDTH, "plumb_bob", (-0.4, 0, 0, 0))
    rays = raw_rays(camera)
    assert np.isnan(rays[0, 0]).all() and np.isfinite(rays[30, 40]).all()
    assert not rays.flags.writeable


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/camera/rgb/image_rect_color", True), ("/camera/depth/image_rect", True),
        ("/camera/depth/image_rect_raw", True), ("/cam/image_raw", False), ("/a/rectified/image", True),
        ("/cam/image_raw/compressed", False), ("/CAM/Image_Rect", True),
        ("/camera/direct/image", None), ("/rectangle/image", None), ("/image", None), ("/unrectified", None),
        ("", None),
    ],
)  # fmt: skip
def test_names_of_rectified_images(topic, rectified):
    assert is_rectified(topic) is rectified
    assert is_rectified(topic, "raw") is False and is_rectified(topic, "rectified") is True


# One frame or two.

OWN = PinholeCamera(50.0, 51.0, 34.0, 25.0)
OWN_SIZE = (52, 70)
POSE = np.eye(4)  # of the depth camera in the colour camera's frame
POSE[:3, :3] = [[np.cos(0.03), 0, np.sin(0.03)], [0, 1, 0], [-np.sin(0.03), 0, np.cos(0.03)]]
POSE[:3, 3] = [0.06, -0.01, 0.02]


def transforms(*links):
    """A tree of (parent, child, 4x4 pose of the child)."""
    from scipy.spatial.transform import Rotation

    tree = TransformTree()
    for parent, child, pose in links:
        q = Rotation.from_matrix(pose[:3, :3]).as_quat()
        transform = SimpleNamespace(
            translation=SimpleNamespace(**dict(zip("xyz", pose[:3, 3], strict=True))),
            rotation=SimpleNamespace(**dict(zip("xyzw", q, strict=True))),
        )
        stamped = SimpleNamespace(header=head(parent), child_frame_id=child, transform=transform)
        tree.add(SimpleNamespace(transforms=[stamped]), fixed=True)
    return tree


def pair(d=(0.0,) * 5, own=OWN, own_size=OWN_SIZE, own_d=(0.0,) * 5):
    """Depth of a camera at POSE and colour at the origin, with both camera_infos."""
    rays = rays_of(own, "plumb_bob" if any(own_d) else "", own_d, *own_size) @ POSE[:3, :3].T
    depth, _ = scene(rays, POSE[:3, 3])
    _, color = scene(rays_of(K, "plumb_bob" if any(d) else "", d))
    return (
        depth_image(depth, "depth_optical"),
        color_image(color, "color_optical"),
        info(d=d, frame_id="color_optical"),
        info(own, None, d=own_d, frame_id="depth_optical", size=own_size),
    )


@pytest.mark.parametrize("d", [(0.0,) * 5, BENT])
@pytest.mark.parametrize("own_d", [(0.0,) * 5, (-0.1, 0.03, 0.001, -0.002, 0.0)])
def test_depth_of_another_camera_is_drawn_into_the_colours_view(d, own_d):
    around = Surroundings(transforms=transforms(("color_optical", "depth_optical", POSE)))
    made = assemble(*pair(d=d, own_d=own_d), around)
    matrix = "P" if any(d) else "K"
    check(made, P if any(d) else K, matrix, "moved by tf from depth_optical to color_optical", inner=8)
    assert made.frame_id == "color_optical"


def test_chains_of_transforms_resolve_in_both_directions():
    rng = np.random.default_rng(5)
    links = []
    for _ in range(2):
        pose = np.eye(4)
        pose[:3, 3] = rng.normal(size=3)
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        pose[:3, :3] = turn * np.linalg.det(turn)
        links.append(pose)
    base_depth, base_color = links
    # depth hangs on depth_link on base; the colour camera is where POSE asks for, as a grandchild of base
    base_color = base_depth @ base_color @ np.linalg.inv(POSE)
    tree = transforms(
        ("base", "depth_link", base_depth), ("depth_link", "depth_optical", links[1]),
        ("world", "base", np.eye(4)), ("base", "color_link", np.eye(4)),
        ("/color_link", "/color_optical", base_color),
    )  # fmt: skip
    np.testing.assert_allclose(tree.lookup("color_optical", "depth_optical"), POSE, atol=1e-12)
    back = tree.lookup("depth_optical", "color_optical")
    np.testing.assert_allclose(back, np.linalg.inv(POSE), atol=1e-12)
    assert tree.lookup("color_optical", "nowhere") is None
    check(assemble(*pair(), Surroundings(transforms=tree)), K, "K", inner=8)


def test_without_a_transform_it_is_an_error_that_says_what_to_do():
    with pytest.raises(
        MessageError, match="range is in frame depth_optical, colour in frame color_opt"
    ) as caught:
        assemble(*pair(own=K, own_size=(HEIGHT, WIDTH)))
    assert caught.value.reason == "no_transform"
    for word in ("/tf_static", "input.extrinsic", "input.assume_registered"):
        assert word in str(caught.value)


def test_extrinsic_and_assumption():
    check(assemble(*pair(), Surroundings(extrinsic=POSE)), K, "K", "input.extrinsic", inner=8)
    depth, color = scene(rays_of(K))
    messages = depth_image(depth, "depth_optical"), color_image(color, "color_optical"), info()
    made = assemble(*messages, None, Surroundings(assume_registered=True))
    check(made, K, "K", "assumed to be registered", inner=1)
    np.testing.assert_array_equal(made.frame.color, color)


@pytest.mark.parametrize("missing", [2, 3])
def test_a_missing_camera_of_two_is_named(missing):
    messages = list(pair())
    messages[missing] = None
    around = Surroundings(extrinsic=POSE)
    what = {2: "colour image", 3: "depth image"}[missing]
    with pytest.raises(MessageError, match=f"the camera_info of the {what} is missing") as caught:
        assemble(*messages, around)
    assert caught.value.reason == "no_camera_info"
    # the one that came tells by its frame whose it is, not by its topic
    if missing == 2:
        messages[2], messages[3] = messages[3], None
        with pytest.raises(MessageError, match=f"the camera_info of the {what} is missing"):
            assemble(*messages, around)


@pytest.mark.parametrize(
    ("range_topic", "color_topic", "how"),
    [
        ("/camera/aligned_depth_to_color/image_raw", "/camera/color/image_raw", "range"),
        ("/camera/depth_registered/image_raw", "/camera/rgb/image_raw", "range"),
        ("/camera/depth/image_registered", "/camera/rgb/image_raw", "range"),
        ("/k4a/depth_to_rgb/image_raw", "/k4a/rgb/image_raw", "range"),
        ("/k4a/depth/image_raw", "/k4a/rgb_to_depth/image_raw", "color"),
        ("/camera/aligned_depth_to_infra1/image_raw", "/camera/color/image_raw", ""),
        ("/camera/aligned_depth_to_infra1/image_raw", "/camera/infra1/image_rect_raw", "range"),
        ("/camera/depth/image_raw", "/camera/color/image_raw", ""),
        ("/camera/unregistered/depth", "/camera/color/image_raw", ""),
        ("/camera/depth/not_aligned", "/camera/color/image_raw", ""),
    ],
)
def test_names_tell_that_a_driver_has_registered(range_topic, color_topic, how):
    assert registered_by_name(range_topic, color_topic) == {"range": range_topic, "color": color_topic}.get(
        how, ""
    )
    depth, color = scene(rays_of(K))
    messages = depth_image(depth, "depth_optical"), color_image(color, "color_optical"), info(p=K)
    around = Surroundings(range_topic, color_topic)
    if not how:
        with pytest.raises(MessageError, match="no transform"):
            assemble(*messages, None, around)
        return
    made = assemble(*messages, None, around)
    check(made, K, made.geometry.matrix, "registered by the name of", inner=1)
    assert made.frame_id == ("depth_optical" if how == "color" else "color_optical")


def test_one_frame_or_none_pairs_as_it_is():
    depth, color = scene(rays_of(K))
    for one, other in (("cam", "cam"), ("/cam", "cam"), ("", "cam"), ("cam", ""), ("", "")):
        made = assemble(depth_image(depth, one), color_image(color, other), info(frame_id=""))
        check(made, K, "K", inner=1)
        assert made.frame_id in ("cam", "/cam") or one == other == ""


def test_two_names_of_one_place_need_no_second_camera_info():
    depth, color = scene(rays_of(K))
    around = Surroundings(transforms=transforms(("a", "b", np.eye(4))))
    made = assemble(depth_image(depth, "a"), color_image(color, "b"), info(frame_id="b"), None, around)
    check(made, K, "K", inner=1)
    assert made.frame_id == "b"


@pytest.mark.parametrize("organised", [True, False])
@pytest.mark.parametrize("shift_m", [0.0, 0.01])
@pytest.mark.parametrize("by", ["tf", "extrinsic"])
def test_results_have_the_frame_of_the_view_by_the_identity_as_by_any_transform(organised, shift_m, by):
    depth, color = scene(rays_of(K))
    rays = rays_of(K)
    if not organised:
        rays, depth = rays.reshape(1, -1, 3), depth.reshape(1, -1)
    pose = np.eye(4)
    pose[0, 3] = shift_m
    around = Surroundings(extrinsic=pose)
    if by == "tf":
        around = Surroundings(transforms=transforms(("color_optical", "lidar", pose)))
    camera = info(frame_id="color_optical")
    made = assemble(
        cloud(rays, depth, frame_id="lidar"), color_image(color, "color_optical"), camera, None, around
    )
    assert made.frame_id == "color_optical"


def test_clouds_of_another_frame_are_moved_or_keep_their_own_colour():
    rays = rays_of(OWN, height=OWN_SIZE[0], width=OWN_SIZE[1])
    depth, _ = scene(rays @ POSE[:3, :3].T, POSE[:3, 3])
    _, color = scene(rays_of(K))
    image, camera = color_image(color, "color_optical"), info(frame_id="color_optical")
    known = Surroundings(transforms=transforms(("color_optical", "depth_optical", POSE)))
    made = assemble(cloud(rays, depth, frame_id="depth_optical"), image, camera, None, known)
    assert made.frame_id == "color_optical" and "moved by tf" in str(made.geometry)
    valid = made.frame.valid
    np.testing.assert_allclose(made.frame.points[valid] @ PLANE, DISTANCE, atol=1e-3)
    with pytest.raises(MessageError, match="no transform"):
        assemble(cloud(rays, depth, frame_id="depth_optical"), image, camera)
    own = np.full((*depth.shape, 3), 77, np.uint8)
    colored = cloud(rays, depth, own, "depth_optical")
    for around in (Surroundings(), known):
        made = assemble(colored, image, camera, None, around)
        assert made.frame_id == "depth_optical" and (made.frame.color == 77).all()
        assert made.geometry.matrix == "none", "the colour's camera_info is not the cloud's"
    made = assemble(colored, image, camera, info(OWN, None, frame_id="depth_optical", size=OWN_SIZE))
    assert made.frame.camera == OWN
    flat = cloud(rays.reshape(1, -1, 3), depth.reshape(1, -1), own.reshape(1, -1, 3), "depth_optical")
    made = assemble(flat, image, camera, info(OWN, None, frame_id="depth_optical", size=OWN_SIZE))
    assert made.frame.camera == OWN and made.frame_id == "depth_optical" and made.frame.valid.all()
    with pytest.raises(MessageError, match="no transform"):
        assemble(flat, image, camera)
    around = Surroundings(transforms=known.transforms, prefer_image=True)
    assert assemble(colored, image, camera, None, around).frame_id == "color_optical"


def test_a_cloud_in_the_grid_of_another_camera_is_drawn_without_gaps():
    rays = rays_of(OWN, height=OWN_SIZE[0], width=OWN_SIZE[1])
    depth, _ = scene(rays @ POSE[:3, :3].T, POSE[:3, 3])
    _, color = scene(rays_of(K))
    messages = cloud(rays, depth, frame_id="depth_optical"), color_image(color, "color_optical")
    cameras = info(frame_id="color_optical"), info(OWN, None, frame_id="depth_optical", size=OWN_SIZE)
    made = assemble(*messages, *cameras, Surroundings(extrinsic=POSE))
    check(made, K, "K", inner=8)
    gappy = assemble(*messages, cameras[0], None, Surroundings(extrinsic=POSE))
    inner = np.s_[10:-10, 14:-10]
    assert made.frame.valid[inner].all() and not gappy.frame.valid[inner].all()


def test_transforms_that_are_none_are_left_out():
    bad = np.eye(4)
    tree = transforms(("a", "b", bad))
    stamped = SimpleNamespace(
        header=head("b"), child_frame_id="c",
        transform=SimpleNamespace(
            translation=SimpleNamespace(x=0.0, y=0.0, z=0.0),
            rotation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0),
        ),
    )  # fmt: skip
    tree.add(SimpleNamespace(transforms=[stamped]), fixed=True)
    assert tree.lookup("a", "c") is None and tree.frames() == ["a", "b"]
    tree = transforms(("a", "b", bad), ("b", "a", bad))  # a ring is no tree, and ends
    assert tree.lookup("a", "elsewhere") is None


def test_of_a_moving_transform_what_lies_between_two_samples_is_interpolated():
    tree = TransformTree()
    for second in range(5):
        transform = SimpleNamespace(
            translation=SimpleNamespace(x=float(second), y=0.0, z=0.0),
            rotation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0),
        )
        stamped = SimpleNamespace(
            header=head("world", second * 10**9), child_frame_id="robot", transform=transform
        )
        tree.add(SimpleNamespace(transforms=[stamped]), fixed=False)
    assert tree.lookup("world", "robot", 2_100_000_000)[0, 3] == pytest.approx(2.1)
    assert tree.lookup("robot", "world", 9_000_000_000)[0, 3] == -4.0
