"""Colour encodings beyond plain RGB, and rows whose step is zero or absurd; values are made here by hand."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from wire import cloud, image, reason

from rcseg_ros.frames.conversions import MessageError, Reading, decode_cloud, decode_depth, decode_image

RNG = np.random.default_rng(5)
COLOR = RNG.integers(0, 256, (6, 8, 3), np.uint8)
GREY = COLOR[..., 0]
HEIGHT, WIDTH = 12, 16
#: Smooth colours, which survive chroma of half the size.
SMOOTH = np.stack(
    [
        np.add.outer(np.arange(HEIGHT) * down, np.arange(WIDTH) * across) + first
        for down, across, first in ((8, 2, 40), (3, 6, 60), (2, 3, 90))
    ],
    axis=-1,
).astype(np.uint8)


def yuv(color):
    """Y, U, V of ITU-R BT.601 with footroom, as cameras send them."""
    r, g, b = np.moveaxis(color.astype(float), -1, 0)
    y = 16 + (65.738 * r + 129.057 * g + 25.064 * b) / 256
    u = 128 + (-37.945 * r - 74.494 * g + 112.439 * b) / 256
    v = 128 + (112.439 * r - 94.154 * g - 18.285 * b) / 256
    return tuple(np.rint(plane).astype(np.uint8) for plane in (y, u, v))


def halved(plane):
    return np.rint(plane.reshape(HEIGHT // 2, 2, WIDTH // 2, 2).mean(axis=(1, 3))).astype(np.uint8)


def planes(order, padding=0):
    """The rows of a planar image and their step."""
    y, u, v = yuv(SMOOTH)
    u, v = halved(u), halved(v)
    if order in ("nv12", "nv21"):
        pair = (u, v) if order == "nv12" else (v, u)
        chroma = np.stack(pair, axis=-1).reshape(HEIGHT // 2, WIDTH)
    else:
        chroma = np.concatenate([p.reshape(-1) for p in ((u, v) if order == "i420" else (v, u))])
        chroma = chroma.reshape(HEIGHT // 2, WIDTH)
    rows = np.vstack([y, chroma])
    return np.hstack([rows, np.full((len(rows), padding), 0xAB, np.uint8)])


def message(rows, encoding, height, step):
    return SimpleNamespace(
        height=height, width=WIDTH, encoding=encoding, step=step, is_bigendian=0, data=rows.tobytes()
    )


@pytest.mark.parametrize("encoding", ["nv12", "nv21", "i420", "yv12", "NV12"])
@pytest.mark.parametrize(
    "layout", ["plain", "step 0", "step with chroma", "rows of chroma counted", "padded"]
)
def test_planes_of_luma_and_chroma(encoding, layout):
    order = encoding.lower()
    if layout == "padded" and order in ("i420", "yv12"):
        pytest.skip("chroma rows of half the width have no step of their own")
    rows = planes(order, 8 if layout == "padded" else 0)
    height = HEIGHT * 3 // 2 if layout == "rows of chroma counted" else HEIGHT
    step = {"step 0": 0, "step with chroma": WIDTH * 3 // 2, "padded": WIDTH + 8}.get(layout, WIDTH)
    decoded = decode_image(message(rows, encoding, height, step))
    assert decoded.shape == SMOOTH.shape
    assert np.abs(decoded.astype(int) - SMOOTH).max() <= 12
    assert np.abs(decoded.astype(int) - SMOOTH).mean() <= 3


def test_nv24_has_chroma_for_every_pixel():
    y, u, v = yuv(SMOOTH)
    rows = np.concatenate([y.ravel(), np.stack([u, v], -1).ravel()])
    decoded = decode_image(message(rows, "nv24", HEIGHT, WIDTH))
    assert np.abs(decoded.astype(int) - SMOOTH).max() <= 8


@pytest.mark.parametrize(
    "encoding, order",
    [
        ("yuv422", "uyvy"),
        ("UYVY", "uyvy"),
        ("yuv422_uyvy", "uyvy"),
        ("yuv422_yuy2", "yuyv"),
        ("YUY2", "yuyv"),
        ("yuyv", "yuyv"),
        ("yvyu", "yvyu"),
    ],
)
def test_luma_and_chroma_in_turn(encoding, order):
    y, u, v = yuv(SMOOTH)
    pairs = {"u": u.reshape(HEIGHT, -1, 2).mean(2), "v": v.reshape(HEIGHT, -1, 2).mean(2)}
    pixels = np.empty((HEIGHT, WIDTH * 2), np.uint8)
    for place, letter in enumerate(order):
        if letter == "y":
            pixels[:, place::4] = y[:, place // 2 :: 2]
        else:
            pixels[:, place::4] = np.rint(pairs[letter])
    decoded = decode_image(image(pixels.reshape(HEIGHT, WIDTH, 2), encoding, 3))
    assert np.abs(decoded.astype(int) - SMOOTH).max() <= 8


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
@pytest.mark.parametrize("encoding", ["mono16", "16UC1", "rgb16", "bayer_rggb16"])
def test_sixteen_bits_hold_as_many_as_the_data_need(encoding, bits):
    """Twelve bits in mono16 would be black if the upper byte were taken."""
    stored = COLOR.astype(np.uint16) << (bits - 8)
    stored[0, 0] = (1 << bits) - 1
    bright = COLOR.copy()
    bright[0, 0] = 255
    if encoding == "rgb16":
        np.testing.assert_array_equal(decode_image(image(stored, encoding)), bright)
    else:
        decoded = decode_image(image(np.ascontiguousarray(stored[..., 0]), encoding))
        if encoding == "bayer_rggb16":
            np.testing.assert_array_equal(decoded, decode_image(image(bright[..., 0], "bayer_rggb8")))
        else:
            np.testing.assert_array_equal(decoded[..., 1], bright[..., 0])


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_encodings_that_name_their_bits(bits):
    dark = (GREY >> 2).astype(np.uint16) << (bits - 8)  # the maximum does not tell the bits
    np.testing.assert_array_equal(decode_image(image(dark, f"mono{bits}", 4))[..., 0], GREY >> 2)
    mosaic = decode_image(image(dark, f"bayer_gbrg{bits}"))
    np.testing.assert_array_equal(mosaic, decode_image(image(GREY >> 2, "bayer_gbrg8")))


def test_the_bits_may_be_given():
    dark = (GREY >> 2).astype(np.uint16) << 4
    dark[0, 0] = 1000
    assert decode_image(image(dark, "mono16"))[0, 0, 0] == 250
    assert decode_image(image(dark, "mono16"), Reading(color_bits=12))[0, 0, 0] == 1000 >> 4
    too_many = np.full((4, 4), 5000, np.uint16)
    assert (decode_image(image(too_many, "mono16"), Reading(color_bits=12)) == 255).all()


@pytest.mark.parametrize("encoding", ["RGB8", "Rgb8"])
def test_the_case_of_an_encoding_does_not_matter(encoding):
    np.testing.assert_array_equal(decode_image(image(COLOR, encoding)), COLOR)


def picture(form, pixels, extension=".png"):
    return SimpleNamespace(format=form, data=cv2.imencode(extension, pixels)[1].tobytes())


def test_compressed_pictures_of_any_depth_and_channels():
    bgr = COLOR[..., ::-1]
    for form, pixels in {
        "rgb8; png compressed bgr8": bgr,
        "rgba8; png compressed ": np.dstack([bgr, GREY]),
        "rgb16; png compressed bgr16": np.where(bgr == bgr.max(), 255, bgr).astype(np.uint16) << 8,
        "png": bgr,
    }.items():
        np.testing.assert_array_equal(decode_image(picture(form, pixels)), COLOR, err_msg=form)
    twelve = GREY.astype(np.uint16) << 4
    twelve[0, 0] = 4095
    decoded = decode_image(picture("mono16; png compressed ", twelve))
    np.testing.assert_array_equal(decoded[..., 2].ravel()[1:], GREY.ravel()[1:])
    mosaic = decode_image(picture("bayer_grbg8; png compressed ", GREY))
    np.testing.assert_array_equal(mosaic, decode_image(image(GREY, "bayer_grbg8")))
    np.testing.assert_array_equal(decode_image(picture("mono8; png compressed ", GREY))[..., 0], GREY)


def words(function, *arguments):
    with pytest.raises(MessageError) as caught:
        function(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("form", ["h264", "h265", "hevc", "rgb8; h264 compressed"])
def test_video_is_named_as_such(form):
    text = words(decode_image, SimpleNamespace(format=form, data=b"\0\0\0\1gB"))
    assert "video stream" in text and form in text


def test_a_depth_encoding_where_colour_is_due_is_named_as_such():
    assert "that of a depth image" in words(decode_image, image(np.ones((4, 4), np.float32), "32FC1"))
    assert "it reads 16UC1, 16UC3" in words(decode_image, image(GREY, "jfif"))


def changed(message, **fields):
    return SimpleNamespace(**{**vars(message), **fields})


@pytest.mark.parametrize("step", [0, 8, 23, 7_000_000])
def test_a_step_that_is_wrong_where_the_size_leaves_one_reading(step):
    np.testing.assert_array_equal(decode_image(changed(image(COLOR, "rgb8"), step=step)), COLOR)
    depth = RNG.uniform(1, 2, (6, 8)).astype(np.float32)
    np.testing.assert_array_equal(decode_depth(changed(image(depth, "32FC1"), step=step)), depth)


@pytest.mark.parametrize("step", [0, 8])
def test_padding_is_told_by_the_size(step):
    np.testing.assert_array_equal(decode_image(changed(image(COLOR, "rgb8", 8), step=step)), COLOR)


POINTS = RNG.normal(size=(6, 8, 3)).astype(np.float32)
XYZ = [(name, "f4", POINTS[..., i]) for i, name in enumerate("xyz")]


@pytest.mark.parametrize(
    "changes", [{"row_step": 0}, {"row_step": 8}, {"row_step": 221_000_000}, {"point_step": 0}]
)
def test_a_row_step_that_is_wrong_where_the_size_leaves_one_reading(changes):
    decoded = decode_cloud(changed(cloud(XYZ, (6, 8)), **changes))
    np.testing.assert_array_equal(decoded.points, POINTS)
    padded = decode_cloud(changed(cloud(XYZ, (6, 8), row_padding=12), row_step=0))
    np.testing.assert_array_equal(padded.points, POINTS)


def test_a_step_that_claims_too_much_is_told_with_both_sizes():
    text = words(decode_cloud, changed(cloud(XYZ, (6, 8)), row_step=36_900_000, data=b"\0" * 580))
    assert "36900000 bytes a row" in text and "221 MB" in text and "got 580 bytes" in text
    text = words(decode_image, changed(image(COLOR, "rgb8"), step=36_900_000, data=b"\0" * 150))
    assert "221 MB" in text and "got 150 bytes" in text
    assert reason(decode_image, changed(image(COLOR, "rgb8"), step=0, data=b"\0" * 100)) == "truncated_data"


def test_whatever_comes_is_read_or_refused_with_a_reason():
    encodings = ["rgb8", "bayer_rggb8", "mono16", "yuv422", "nv12", "i420", "nv24", "16UC1", "64FC1", "?", ""]
    outcomes = set()
    for _ in range(3000):
        height, width = (int(v) for v in RNG.integers(0, 6, 2))
        step = int(RNG.choice([0, 1, 7, width, 2 * width, 3 * width, 8 * width, 2**31]))
        size = int(RNG.choice([0, height * width, 2 * height * width, height * width * 3 // 2, 100]))
        odd = SimpleNamespace(
            height=height, width=width, encoding=str(RNG.choice(encodings)), step=step,
            is_bigendian=int(RNG.integers(2)), data=RNG.integers(0, 256, size, np.uint8).tobytes(),
        )  # fmt: skip
        for decode in (decode_image, decode_depth):
            try:
                assert decode(odd).shape[:2][1] == width
                outcomes.add("read")
            except MessageError as error:
                outcomes.add(error.reason)
    assert outcomes == {
        "read", "unknown_encoding", "truncated_data", "bad_step", "empty_image", "depth_unit"
    }  # fmt: skip


def test_points_where_z_is_zero_are_points_and_a_range_of_zero_is_none():
    points = POINTS.copy()
    points[2, :, 2] = 0
    columns = [(name, "f4", points[..., i]) for i, name in enumerate("xyz")]
    np.testing.assert_array_equal(decode_cloud(cloud(columns, (6, 8))).points, points)
    ranges = np.full((6, 8), 1500, np.uint32)
    ranges[1, 1] = 0
    decoded = decode_cloud(cloud([*columns, ("range", "u4", ranges)], (6, 8))).points
    assert np.argwhere(np.isnan(decoded).any(axis=2)).tolist() == [[1, 1]]


def test_a_cloud_in_millimetres_is_refused_by_the_name_of_the_unit():
    far = 1000 * (POINTS + np.array([0.0, 0, 3]))
    message = cloud([(name, "f4", far[..., i]) for i, name in enumerate("xyz")], (6, 8))
    assert reason(decode_cloud, message) == "depth_unit"
    assert "millimetres: set it to 0.001" in words(decode_cloud, message)
    np.testing.assert_allclose(
        decode_cloud(message, Reading(depth_unit_m=0.001)).points, far / 1000, rtol=1e-5, atol=1e-6
    )
    in_a_map = POINTS + np.array([450_000, 5_400_000, 300], np.float32)
    message = cloud([(name, "f4", in_a_map[..., i]) for i, name in enumerate("xyz")], (6, 8))
    np.testing.assert_array_equal(decode_cloud(message).points, in_a_map)


def test_coordinates_beyond_float32_are_missing():
    points = POINTS.astype(np.float64)
    points[1, 2, 0] = 1e300
    decoded = decode_cloud(cloud([(n, "f8", points[..., i]) for i, n in enumerate("xyz")], (6, 8)))
    assert np.argwhere(~np.isfinite(decoded.points).all(axis=2)).tolist() == [[1, 2]]
