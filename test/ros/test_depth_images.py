"""Depth in metres: units, what is no measurement, and every transport; the codes are written here by hand."""

import struct
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from wire import image, reason

from rcseg_ros.frames.conversions import MessageError, Reading, decode_depth

RNG = np.random.default_rng(11)
DEPTH_M = RNG.uniform(0.4, 6.0, (12, 16)).astype(np.float32)
MILLIMETRES = np.rint(DEPTH_M * 1000).astype(np.uint16)
MILLIMETRES[3:5, 2:9] = 0
KNOWN_M = np.where(MILLIMETRES == 0, np.nan, MILLIMETRES / 1000)


def compressed(form, data):
    return SimpleNamespace(format=form, data=bytes(data))


def png(pixels):
    return cv2.imencode(".png", pixels)[1].tobytes()


def header(a=0.0, b=0.0):
    return struct.pack("<iff", 0, a, b)


def refusal(message, reading=None):
    with pytest.raises(MessageError) as caught:
        decode_depth(message, reading or Reading())
    assert "\n" not in str(caught.value)
    return caught.value


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(
    "encoding, dtype", [("16UC1", "u2"), ("mono16", "u2"), ("16SC1", "i2"), ("32SC1", "i4")]
)
def test_whole_numbers_are_millimetres(encoding, dtype, big_endian):
    message = image(MILLIMETRES.astype(dtype), encoding, 6, big_endian)
    np.testing.assert_allclose(decode_depth(message), KNOWN_M, rtol=1e-6)


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("encoding, dtype", [("32FC1", "f4"), ("64FC1", "f8")])
def test_floats_are_metres(encoding, dtype, big_endian):
    found = decode_depth(image(DEPTH_M.astype(dtype), encoding, 4, big_endian))
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, DEPTH_M)


@pytest.mark.parametrize(
    "encoding, dtype, bad",
    [
        ("16UC1", "u2", [0, 65535]),
        ("16SC1", "i2", [0, -1, -32768, 32767]),
        ("32SC1", "i4", [0, -5, 2**31 - 1]),
        (
            "32FC1",
            "f4",
            [0, -0.0, -1, np.nan, np.inf, -np.inf, 1e-42, 1.2e-38, 65535, 65.535, 3.4e38, 1e30, 1e6, 2000],
        ),
        ("64FC1", "f8", [0, -1, np.nan, np.inf, 5e-324, 1e-40, 65535, 65.535, 1e300, -1e300]),
    ],
)
def test_what_is_no_measurement_is_missing(encoding, dtype, bad):
    """Zero, negative, saturated, subnormal, absurd: each beside good values."""
    good = 1500 if dtype[0] in "ui" else 1.5
    for value in bad:
        stored = np.full((6, 8), good, dtype)
        stored[2, 3] = value
        depth_m = decode_depth(image(stored, encoding))
        assert np.argwhere(np.isnan(depth_m)).tolist() == [[2, 3]], value
        assert depth_m[0, 0] == pytest.approx(1.5)


def test_far_values_of_a_long_range_camera_are_kept():
    stored = np.full((6, 8), 30.0, np.float32)
    stored[1, 1], stored[2, 2] = 180.0, 65.4
    np.testing.assert_array_equal(decode_depth(image(stored, "32FC1")), stored)


@pytest.mark.parametrize("encoding, dtype", [("32FC1", "f4"), ("64FC1", "f8")])
def test_millimetres_in_floats_are_refused_by_the_name_of_the_unit(encoding, dtype):
    stored = (DEPTH_M * 1000).astype(dtype)
    stored[0, :4] = 65535  # saturation does not hide it
    message = image(stored, encoding)
    error = refusal(message)
    assert error.reason == "depth_unit"
    assert "read as metres" in str(error) and "millimetres: set it to 0.001" in str(error)
    assert "input.depth_unit" in str(error) and "--depth-unit" in str(error)
    right = decode_depth(message, Reading(depth_unit_m=0.001))
    np.testing.assert_allclose(right[1:], DEPTH_M[1:], rtol=1e-6)
    assert np.isnan(right[0, :4]).all()


def test_a_wall_of_one_depth_in_millimetres_is_refused_too():
    assert refusal(image(np.full((6, 8), 1500, np.float32), "32FC1")).reason == "depth_unit"


def test_the_limit_of_the_median_is_a_parameter():
    message = image(DEPTH_M * 40, "32FC1")  # up to 240 m
    assert refusal(message).reason == "depth_unit"
    np.testing.assert_array_equal(decode_depth(message, Reading(max_depth_m=300.0)), DEPTH_M * np.float32(40))
    assert refusal(image(DEPTH_M, "32FC1"), Reading(max_depth_m=1.0)).reason == "depth_unit"


def test_the_unit_of_whole_numbers_may_be_given():
    """Stereo cameras at close range send tenths of a millimetre."""
    found = decode_depth(image(MILLIMETRES, "16UC1"), Reading(depth_unit_m=0.0001))
    np.testing.assert_allclose(found, KNOWN_M / 10, rtol=1e-6)
    error = refusal(image(MILLIMETRES, "16UC1"), Reading(depth_unit_m=1.0))
    assert "read as metres" in str(error)


def test_a_far_value_that_stands_for_nothing_does_not_make_the_median():
    """Renderers fill the sky with the distance of their far plane."""
    stored = np.full((10, 10), 3.0, np.float32)
    stored[:6] = 10_000.0
    depth_m = decode_depth(image(stored, "32FC1"))
    assert np.isnan(depth_m[:6]).all() and (depth_m[6:] == 3.0).all()


def quantised(depth_m, quantization=100.0, depth_max=10.0):
    """32FC1 as compressedDepth stores it: n = a / z + b, see compressed_depth_image_transport's codec."""
    a = quantization * (quantization + 1)
    b = 1 - a / depth_max
    levels = np.where(np.isfinite(depth_m), a / np.where(depth_m > 0, depth_m, 1) + b, 0)
    return levels.astype(np.uint16), header(a, b)


def rvl(pixels):
    """The code of A. D. Wilson, number by number."""
    groups = []

    def put(number):
        while True:
            group, number = number & 7, number >> 3
            groups.append(group | (8 if number else 0))
            if not number:
                return

    flat, at, previous = pixels.ravel().astype(int).tolist(), 0, 0
    while at < len(flat):
        zeros = next((i for i, v in enumerate(flat[at:]) if v), len(flat) - at)
        at += zeros
        run = next((i for i, v in enumerate(flat[at:]) if not v), len(flat) - at)
        put(zeros)
        put(run)
        for value in flat[at : at + run]:
            delta, previous = value - previous, value
            put(2 * delta if delta >= 0 else -2 * delta - 1)
        at += run
    groups += [0] * (-len(groups) % 8)
    words = [int("".join(f"{g:x}" for g in groups[i : i + 8]), 16) for i in range(0, len(groups), 8)]
    size = struct.pack("<II", pixels.shape[1], pixels.shape[0])
    return size + struct.pack(f"<{len(words)}I", *words)


@pytest.mark.parametrize(
    "form, data",
    [
        ("16UC1; compressedDepth png", header() + png(MILLIMETRES)),
        ("16UC1; compressedDepth", header() + png(MILLIMETRES)),
        ("16UC1;compressedDepth", header() + png(MILLIMETRES)),
        ("16UC1; compressedDepth png", png(MILLIMETRES)),  # recorders in Python leave the header out
        ("mono16; compressedDepth png", header() + png(MILLIMETRES)),
        ("16UC1; compressedDepth rvl", header() + rvl(MILLIMETRES)),
        ("16UC1; compressedDepth", header() + rvl(MILLIMETRES)),
        ("png", header() + png(MILLIMETRES)),
        ("16UC1; png compressed ", png(MILLIMETRES)),
        ("16UC1; png compressed", png(MILLIMETRES)),
        ("png", png(MILLIMETRES)),
        ("16UC1; tiff compressed ", cv2.imencode(".tiff", MILLIMETRES)[1]),
    ],
)
def test_transports_of_millimetres(form, data):
    np.testing.assert_allclose(decode_depth(compressed(form, data)), KNOWN_M, rtol=1e-6)


def test_the_unit_of_compressed_millimetres_may_be_given():
    message = compressed("16UC1; compressedDepth png", header() + png(MILLIMETRES))
    np.testing.assert_allclose(decode_depth(message, Reading(depth_unit_m=1e-4)), KNOWN_M / 10, rtol=1e-6)


@pytest.mark.parametrize("code", ["png", "rvl"])
def test_quantised_inverse_depth(code):
    depth_m = DEPTH_M.copy()
    depth_m[4, 4:9] = np.nan
    levels, head = quantised(depth_m)
    body = png(levels) if code == "png" else rvl(levels)
    found = decode_depth(compressed(f"32FC1; compressedDepth {code}", head + body))
    a = 100.0 * 101.0
    step_m = depth_m**2 / a  # dz = z^2 / a dn
    assert (np.isnan(found) == np.isnan(depth_m)).all()
    assert np.nanmax(np.abs(found - depth_m) / step_m) < 1.01
    assert np.nanmin(found) > 0.3


def test_floats_in_a_tiff():
    data = cv2.imencode(".tiff", DEPTH_M)[1]
    np.testing.assert_array_equal(decode_depth(compressed("32FC1; tiff compressed ", data)), DEPTH_M)


def test_rvl_of_noise_edges_and_an_empty_image():
    for pixels in (
        RNG.integers(0, 65535, (30, 41), np.uint16),
        np.zeros((5, 7), np.uint16),
        np.full((5, 7), 65534, np.uint16),
        np.where(RNG.random((40, 33)) < 0.5, 0, RNG.integers(1, 900, (40, 33))).astype(np.uint16),
    ):
        found = decode_depth(compressed("16UC1; compressedDepth rvl", header() + rvl(pixels)))
        expected = np.where(pixels == 0, np.nan, pixels * np.float32(0.001))
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_damaged_transports_are_refused_with_a_reason():
    good = header() + rvl(MILLIMETRES)
    endless = header() + struct.pack("<II", 10**6, 10**6) + good[20:]
    for data in (good[:-40], good[:22], good[:12], b""):
        assert reason(decode_depth, compressed("16UC1; compressedDepth rvl", data)) == "bad_compression"
    assert reason(decode_depth, compressed("16UC1; compressedDepth rvl", endless)) == "too_large"
    rng = np.random.default_rng(0)
    for _ in range(50):  # rubbish is refused or read, and never a traceback
        data = header() + struct.pack("<II", 16, 12) + rng.integers(0, 256, 400, np.uint8).tobytes()
        try:
            decode_depth(compressed("16UC1; compressedDepth rvl", data))
        except MessageError as error:
            assert error.reason == "bad_compression"
    levels, _ = quantised(DEPTH_M)
    for head in (b"", header(), header(np.nan, 1.0), header(-5.0, 1.0)):
        message = compressed("32FC1; compressedDepth png", head + png(levels))
        assert reason(decode_depth, message) == "bad_compression"
    for form in ("16UC1; compressedDepth png", "16UC1; png compressed ", "png", ""):
        assert reason(decode_depth, compressed(form, header() + b"rubbish")) == "bad_compression"


def test_a_jpeg_keeps_no_depth():
    grey = (MILLIMETRES >> 8).astype(np.uint8)
    for pixels in (grey, np.dstack([grey] * 3)):
        error = refusal(compressed("16UC1; jpeg compressed ", cv2.imencode(".jpg", pixels)[1]))
        assert error.reason == "bad_compression" and "JPEG keeps no depth" in str(error)
    assert "not a depth encoding" in str(refusal(image(np.zeros((4, 4), np.uint8), "8UC1")))
