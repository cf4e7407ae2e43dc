"""Messages to arrays and back: every encoding, layout and byte order, a reason for all that is refused."""

import array
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from wire import CONTAINERS, cloud, image, reason

from rcseg_core import PinholeCamera
from rcseg_ros.frames.conversions import (
    Header,
    decode_camera_info,
    decode_cloud,
    decode_depth,
    decode_image,
    decode_labels,
    header_of,
)
from rcseg_ros.results.outputs import (
    cloud_message,
    depth_message,
    edges_message,
    header_message,
    labels_message,
    picture_message,
)

RNG = np.random.default_rng(7)
COLOR = RNG.integers(0, 256, (6, 8, 3), np.uint8)


@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    "encoding, pixels",
    [
        ("rgb8", COLOR),
        ("bgr8", COLOR[..., ::-1]),
        ("8UC3", COLOR[..., ::-1]),
        ("rgba8", np.dstack([COLOR, COLOR[..., 0]])),
        ("bgra8", np.dstack([COLOR[..., ::-1], COLOR[..., 0]])),
        ("8UC4", np.dstack([COLOR[..., ::-1], COLOR[..., 0]])),
    ],
)
def test_color_encodings_any_step_and_container(encoding, pixels, padding, container):
    np.testing.assert_array_equal(decode_image(image(pixels, encoding, padding, container=container)), COLOR)


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("encoding, order", [("rgb16", slice(None)), ("bgr16", slice(None, None, -1))])
def test_sixteen_bit_color_keeps_its_upper_byte(encoding, order, big_endian):
    pixels = COLOR.astype(np.uint16)[..., order] * 256 + 17
    np.testing.assert_array_equal(decode_image(image(pixels, encoding, 4, big_endian)), COLOR)


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_grey_becomes_three_equal_channels(encoding):
    decoded = decode_image(image(COLOR[..., 0], encoding, 3))
    np.testing.assert_array_equal(decoded, np.repeat(COLOR[..., :1], 3, axis=2))


@pytest.mark.parametrize("big_endian", [False, True])
def test_mono16(big_endian):
    pixels = COLOR[..., 0].astype(np.uint16) << 8
    decoded = decode_image(image(pixels, "mono16", 2, big_endian))
    np.testing.assert_array_equal(decoded[..., 1], COLOR[..., 0])


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_are_named_by_their_first_row(pattern, bits):
    flat = np.zeros((8, 8, 3), np.uint8) + np.array([200, 120, 30], np.uint8)
    mosaic = np.empty((8, 8), np.uint8)
    for i, letter in enumerate(pattern):
        mosaic[i // 2 :: 2, i % 2 :: 2] = flat[0, 0]["rgb".index(letter)]
    mosaic = mosaic if bits == 8 else mosaic.astype(np.uint16) << 8
    decoded = decode_image(image(mosaic, f"bayer_{pattern}{bits}"))
    np.testing.assert_array_equal(decoded[2:-2, 2:-2], flat[2:-2, 2:-2])


@pytest.mark.parametrize(
    "encoding, order", [("yuv422", "uyvy"), ("uyvy", "uyvy"), ("yuv422_yuy2", "yuyv"), ("yuyv", "yuyv")]
)
def test_yuv_of_a_grey_image_is_grey(encoding, order):
    pixels = np.empty((4, 6, 2), np.uint8)
    pixels[..., order.index("y")] = 126
    pixels[..., 1 - order.index("y")] = 128
    decoded = decode_image(image(pixels, encoding))
    assert np.abs(decoded.astype(int) - 128).max() <= 1


@pytest.mark.parametrize("extension, tolerance", [(".png", 0), (".jpg", 12)])
def test_compressed_color(extension, tolerance):
    smooth = cv2.resize(COLOR[:2, :2], (64, 48))
    data = cv2.imencode(extension, smooth[..., ::-1])[1]
    decoded = decode_image(SimpleNamespace(format=extension[1:], data=array.array("B", data.tobytes())))
    assert np.abs(decoded.astype(int) - smooth).max() <= tolerance


def test_depth_in_millimetres_zero_is_invalid():
    for encoding in ("16UC1", "mono16"):
        for big_endian in (False, True):
            stored = np.array([[0, 1000, 65534]] * 2, np.uint16)
            depth_m = decode_depth(image(stored, encoding, 6, big_endian))
            assert depth_m.dtype == np.float32
            np.testing.assert_allclose(depth_m, [[np.nan, 1.0, 65.534]] * 2, rtol=1e-6)


@pytest.mark.parametrize("big_endian", [False, True])
def test_depth_in_metres_only_positive_numbers_are_valid(big_endian):
    stored = np.array([[0.5, 0.0, -1.0, np.nan, np.inf, -np.inf]], np.float32)
    message = image(stored, "32FC1", 4, big_endian)
    np.testing.assert_array_equal(decode_depth(message), [[0.5] + [np.nan] * 5])
    assert message.data == image(stored, "32FC1", 4, big_endian).data  # the message is not written to


def test_compressed_depth():
    stored = np.array([[0, 1500], [2500, 40]], np.uint16)
    data = b"\0" * 12 + cv2.imencode(".png", stored)[1].tobytes()
    depth_m = decode_depth(SimpleNamespace(format="16UC1; compressedDepth png", data=data))
    np.testing.assert_allclose(depth_m, [[np.nan, 1.5], [2.5, 0.04]], rtol=1e-6)
    assert (
        reason(decode_depth, SimpleNamespace(format="32FC1; compressedDepth png", data=data))
        == "bad_compression"
    )


def test_what_is_wrong_with_an_image_is_named():
    good = image(COLOR, "rgb8")
    assert reason(decode_image, SimpleNamespace(**{**vars(good), "encoding": "rgb7"})) == "unknown_encoding"
    assert reason(decode_image, SimpleNamespace(**{**vars(good), "data": good.data[:-1]})) == "truncated_data"
    assert reason(decode_image, SimpleNamespace(**{**vars(good), "data": b""})) == "truncated_data"
    assert reason(decode_image, SimpleNamespace(**{**vars(good), "step": 3, "height": 5})) == "bad_step"
    assert reason(decode_image, SimpleNamespace(**{**vars(good), "height": 0})) == "empty_image"
    assert reason(decode_image, SimpleNamespace(format="jpeg", data=b"rubbish")) == "bad_compression"
    assert reason(decode_image, SimpleNamespace(format="jpeg", data=b"")) == "bad_compression"
    assert reason(decode_image, image(COLOR[:, :7, :2], "yuv422")) == "bad_step"
    assert reason(decode_depth, good) == "unknown_encoding"


def test_the_last_row_may_lack_its_padding():
    message = image(COLOR, "rgb8", 5)
    message.data = message.data[:-5]
    np.testing.assert_array_equal(decode_image(message), COLOR)


POINTS = RNG.normal(size=(6, 8, 3)).astype(np.float32)


def xyz(kind="f4"):
    return [(name, kind, POINTS[..., i]) for i, name in enumerate("xyz")]


@settings(max_examples=60, deadline=None)
@given(
    st.permutations(["x", "y", "z", "rgb", "intensity"]),
    st.sampled_from(["f4", "f8"]),
    st.booleans(),
    st.integers(0, 5),
    st.integers(0, 9),
    st.sampled_from(["f4", "u4", "i4"]),
)
def test_clouds_of_any_layout(names, kind, big_endian, gaps, row_padding, color_kind):
    packed = (COLOR.astype(np.uint32) * [65536, 256, 1]).sum(axis=2).astype(np.uint32)
    columns = {name: (name, kind, values) for name, kind, values in xyz(kind)}
    columns["rgb"] = ("rgb", color_kind, packed.view(color_kind))
    columns["intensity"] = ("intensity", "u2", 7)
    message = cloud(
        [columns[name] for name in names], (6, 8), big_endian=big_endian, gaps=gaps, row_padding=row_padding
    )
    decoded = decode_cloud(message)
    assert decoded.organized and decoded.points.dtype == np.float32
    np.testing.assert_array_equal(decoded.points, POINTS)
    np.testing.assert_array_equal(decoded.color, COLOR)


def test_cloud_colour_in_three_fields_or_none():
    separate = xyz() + [(name, "u1", COLOR[..., i]) for i, name in enumerate("rgb")]
    np.testing.assert_array_equal(decode_cloud(cloud(separate, (6, 8))).color, COLOR)
    assert decode_cloud(cloud(xyz(), (6, 8))).color is None


def test_a_cloud_of_one_row_is_not_organised_and_needs_no_row_step():
    message = cloud([(n, k, v.reshape(1, -1)) for n, k, v in xyz()], (1, 48))
    message.row_step = 0
    decoded = decode_cloud(message)
    assert not decoded.organized
    np.testing.assert_array_equal(decoded.points[0], POINTS.reshape(-1, 3))


def test_what_is_wrong_with_a_cloud_is_named():
    def changed(**fields):
        return SimpleNamespace(**{**vars(cloud(xyz(), (6, 8))), **fields})

    assert reason(decode_cloud, changed(data=b"\0" * 10)) == "truncated_data"
    assert reason(decode_cloud, changed(row_step=10, height=5)) == "bad_step"
    assert reason(decode_cloud, changed(point_step=0, width=13, height=17)) == "bad_step"
    assert reason(decode_cloud, changed(width=0)) == "empty_cloud"
    assert reason(decode_cloud, cloud(xyz()[:2], (6, 8))) == "missing_field"
    bad = cloud(xyz(), (6, 8))
    bad.fields[2].offset = 10
    assert reason(decode_cloud, bad) == "bad_field"
    bad.fields[2] = SimpleNamespace(name="z", offset=8, datatype=99, count=1)
    assert reason(decode_cloud, bad) == "bad_field"


def camera_info(**changes):
    roi = SimpleNamespace(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    info = {
        "header": SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=2), frame_id="cam"),
        "height": 480, "width": 640, "distortion_model": "plumb_bob", "d": np.zeros(5),
        "k": np.array([500.0, 0, 320, 0, 510, 240, 0, 0, 1]), "binning_x": 0, "binning_y": 0, "roi": roi,
    }  # fmt: skip
    return SimpleNamespace(**{**info, **changes})


def test_camera_info():
    camera = decode_camera_info(camera_info())
    assert (camera.pinhole.fx, camera.pinhole.fy, camera.pinhole.cx, camera.pinhole.cy) == (
        500,
        510,
        320,
        240,
    )
    assert (camera.height, camera.width, camera.frame_id, camera.distortion) == (480, 640, "cam", ())
    assert header_of(camera_info()).stamp_ns == 1_000_000_002


def test_camera_info_of_a_binned_region_of_interest():
    roi = SimpleNamespace(x_offset=100, y_offset=40, height=200, width=300, do_rectify=False)
    camera = decode_camera_info(camera_info(roi=roi, binning_x=2, binning_y=2))
    assert (camera.pinhole.fx, camera.pinhole.cx, camera.pinhole.cy) == (250, 110, 100)
    assert (camera.height, camera.width) == (100, 150)


def test_distortion_is_kept_and_calibration_is_k_or_p():
    assert decode_camera_info(camera_info(d=[0.1, 0, 0, 0, 0])).distortion == (0.1, 0, 0, 0, 0)
    rational = camera_info(distortion_model="rational_polynomial", d=[0.1] * 8 + [0.0] * 6)
    assert len(decode_camera_info(rational).distortion) == 14
    assert decode_camera_info(camera_info(distortion_model="equidistant", d=[0.0] * 4)).distortion == ()
    assert reason(decode_camera_info, camera_info(k=np.zeros(9))) == "uncalibrated_camera"
    p = np.array([400.0, 0, 310, -20, 0, 405, 230, 0, 0, 0, 1, 0])
    assert decode_camera_info(camera_info(p=p)).projection == PinholeCamera(400, 405, 310, 230)
    assert decode_camera_info(camera_info()).projection is None
    rectified = decode_camera_info(camera_info(k=np.zeros(9), p=p, d=[0.1] * 5))
    assert rectified.pinhole == PinholeCamera(400, 405, 310, 230)
    assert rectified.only_projection and rectified.distortion == ()
    roi = SimpleNamespace(x_offset=100, y_offset=40, height=200, width=300, do_rectify=False)
    part = decode_camera_info(camera_info(p=p, roi=roi, binning_x=2, binning_y=2))
    assert part.projection == PinholeCamera(200, 202.5, 105, 95)


def make(type_name, **fields):
    return SimpleNamespace(**fields)


def test_labels_edges_pictures_and_depth_return_from_their_messages():
    labels = RNG.integers(0, 65536, (6, 8)).astype(np.int32)
    np.testing.assert_array_equal(decode_labels(labels_message(labels, None, make)), labels)
    edges = RNG.integers(0, 8, (6, 8)).astype(np.uint8)
    np.testing.assert_array_equal(decode_image(edges_message(edges, None, make))[..., 0], edges)
    np.testing.assert_array_equal(decode_image(picture_message(COLOR, None, make)), COLOR)
    depth_m = np.array([[1.25, np.nan], [0.5, 2.0]])
    np.testing.assert_array_equal(decode_depth(depth_message(depth_m, None, make)), depth_m)
    assert reason(decode_labels, picture_message(COLOR, None, make)) == "unknown_encoding"


def test_too_many_labels_are_refused_not_wrapped():
    with pytest.raises(ValueError, match="65536 labels"):
        labels_message(np.array([[65536]], np.int32), None, make)


def test_the_reconstructed_cloud_returns_with_labels():
    labels = np.arange(48, dtype=np.int32).reshape(6, 8)
    message = cloud_message(POINTS, COLOR, labels, None, make)
    decoded = decode_cloud(message)
    np.testing.assert_array_equal(decoded.points, POINTS)
    np.testing.assert_array_equal(decoded.color, COLOR)
    (field,) = (field for field in message.fields if field.name == "label")
    stored = message.data.reshape(-1, message.point_step)[:, field.offset : field.offset + 4]
    np.testing.assert_array_equal(stored.copy().view("<u4").ravel(), labels.ravel())


def test_stamps_keep_every_nanosecond():
    head = header_message(Header(1_700_000_000_123_456_789, "cam"), make)
    assert (head.stamp.sec, head.stamp.nanosec, head.frame_id) == (1_700_000_000, 123_456_789, "cam")
