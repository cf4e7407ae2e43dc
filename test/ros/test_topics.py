"""What users rely on: every output of every frame, bit for bit what the library computes, whatever form the
input has.
"""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from rcseg_core import RangeColorFrame, SegmenterConfig, segment

stamps = itertools.count(1_700_000_000_000_000_000, 1_000_000_000)


@pytest.fixture(scope="module")
def frame(live):
    return live.scene()


@pytest.fixture(scope="module")
def labels(live, frame):
    return live.expected_labels(frame)


def test_every_output_carries_the_inputs_stamp_and_frame(live, peer, frame, labels):
    stamp = next(stamps)
    peer.send(frame, stamp)
    outputs = {name: peer.wait_for(name, stamp) for name in live.OUTPUTS}
    for name, message in outputs.items():
        header = message.header if name != "markers" else message.markers[0].header
        assert header.frame_id == live.FRAME_ID, name
    np.testing.assert_array_equal(live.image_array(outputs["labels"]), labels)
    assert len(outputs["regions"].regions) == labels.max()
    assert outputs["overlay"].encoding == "rgb8"
    assert outputs["reconstruction"].height == frame.height
    assert {m.ns for m in outputs["markers"].markers} >= {"surfaces", "boxes", "normals", "labels"}


def test_shapes_and_noise_arrive_with_the_regions_and_in_diagnostics(live, peer, frame):
    stamp = next(stamps)
    peer.send(frame, stamp)
    array = peer.wait_for("regions", stamp)
    expected = segment(frame, SegmenterConfig())
    kinds = [{0: "none", 1: "plane", 2: "sphere", 3: "cylinder"}[s.primitive.kind] for s in array.surfaces]
    assert kinds == [s.primitive.kind for s in expected.surfaces] and "plane" in kinds
    for told, surface in zip(array.surfaces, expected.surfaces, strict=True):
        values = [np.ravel(v) for v in surface.primitive.parameters.values()]
        np.testing.assert_array_equal(told.primitive.parameters, np.concatenate(values) if values else [])
    assert [r.persistence for r in array.regions] == [r.persistence for r in expected.regions]
    assert array.noise.source == "estimated"
    values = peer.diagnosed(lambda told: "noise.source" in told)
    assert values["noise.source"] == "estimated"
    assert float(values["noise.range_sigma_mm"]) == pytest.approx(1e3 * array.noise.sigma, abs=0.006)
    assert float(values["noise.at_median_depth_m"]) == pytest.approx(array.noise.depth, abs=0.006)
    assert len(values["noise.color_sigma"].split()) == 3
    assert float(values["noise.range_correlation_px"]) >= 1


def test_depth_and_image(live, run, labels, frame):
    """A second node: auto takes the first range topic that speaks."""
    _, peer = run("of_depth", {}, ("labels",))
    peer.connected("depth", "image", "camera_info")
    stamp = next(stamps)
    peer.publish(camera_info=live.camera_info_of(frame, stamp))
    peer.publish(depth=live.depth_of(frame, stamp), image=live.image_of(frame, stamp))
    np.testing.assert_array_equal(live.image_array(peer.wait_for("labels", stamp)), labels)
    stamp = next(stamps)
    millimetres = np.nan_to_num(frame.depth_m * 1000).round().astype(np.uint16)
    message = live.depth_of(frame, stamp)
    message.encoding, message.step, message.data = "16UC1", frame.width * 2, millimetres.tobytes()
    peer.publish(depth=message, image=live.image_of(frame, stamp))
    rounded = millimetres.astype(np.float32) * np.float32(0.001)
    rounded[millimetres == 0] = np.nan
    expected = live.expected_labels(RangeColorFrame.from_depth(rounded, frame.color, live.CAMERA))
    np.testing.assert_array_equal(live.image_array(peer.wait_for("labels", stamp)), expected)


def _bayer(color: np.ndarray) -> np.ndarray:
    mosaic = color[..., 1].copy()
    mosaic[0::2, 0::2], mosaic[1::2, 1::2] = color[0::2, 0::2, 0], color[1::2, 1::2, 2]
    return mosaic


ENCODINGS = {
    "rgb8": lambda c: c,
    "bgr8": lambda c: c[..., ::-1],
    "rgba8": lambda c: np.dstack([c, np.full(c.shape[:2], 255, np.uint8)]),
    "bgra8": lambda c: np.dstack([c[..., ::-1], np.full(c.shape[:2], 255, np.uint8)]),
    "mono8": lambda c: cv2.cvtColor(c, cv2.COLOR_RGB2GRAY),
    "mono16": lambda c: cv2.cvtColor(c, cv2.COLOR_RGB2GRAY).astype(np.uint16) * 257,
    "bayer_rggb8": _bayer,
}
DECODED = {
    "mono8": lambda c: np.dstack([cv2.cvtColor(c, cv2.COLOR_RGB2GRAY)] * 3),
    "mono16": lambda c: np.dstack([cv2.cvtColor(c, cv2.COLOR_RGB2GRAY)] * 3),
    "bayer_rggb8": lambda c: cv2.cvtColor(_bayer(c), cv2.COLOR_BayerBG2RGB),
}


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("padding", [0, 12])
def test_encodings(live, peer, frame, encoding, padding):
    stamp = next(stamps)
    pixels = np.ascontiguousarray(ENCODINGS[encoding](frame.color))
    rows = pixels.reshape(frame.height, -1)
    big_endian = encoding == "mono16" and padding > 0
    rows = (rows.byteswap() if big_endian else rows).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    message = live.image_of(frame, stamp)
    message.encoding, message.step, message.is_bigendian = encoding, rows.shape[1], int(big_endian)
    message.data = rows.tobytes()
    peer.publish(camera_info=live.camera_info_of(frame, stamp))
    peer.publish(points=live.cloud_of(frame, stamp), image=message)
    decoded = DECODED.get(encoding, lambda c: c)(frame.color)
    expected = live.expected_labels(RangeColorFrame(frame.points, decoded, live.CAMERA))
    np.testing.assert_array_equal(live.image_array(peer.wait_for("labels", stamp)), expected)


@pytest.mark.parametrize("distortion", [(), (0.02, -0.01, 0.001, -0.001, 0.0)])
def test_unorganised_clouds_are_projected(live, peer, frame, labels, distortion):
    stamp = next(stamps)
    peer.publish(camera_info=live.camera_info_of(frame, stamp, distortion))
    peer.publish(points=live.cloud_of(frame, stamp, organized=False), image=live.image_of(frame, stamp))
    received = live.image_array(peer.wait_for("labels", stamp))
    if not distortion:
        np.testing.assert_array_equal(received, labels)
    else:
        assert received.shape == labels.shape and (received > 0).mean() > 0.8


def test_patches_of_a_received_message_are_the_cores(live, peer, frame):
    from rcseg_core import SegmenterConfig, segment
    from rcseg_ros.patches import evaluate_patch, surface_points

    stamp = next(stamps)
    peer.send(frame, stamp)
    array = peer.wait_for("regions", stamp)
    result = segment(frame, SegmenterConfig())
    rows, cols = np.mgrid[0 : frame.height : 7, 0 : frame.width : 7]
    for message, region in zip(array.regions, result.regions, strict=True):
        for one, other in (
            (message.range_patch, region.range_patch),
            (message.color_patch, region.color_patch),
        ):
            np.testing.assert_allclose(
                evaluate_patch(one, rows, cols), other.evaluate(rows, cols), rtol=1e-9, atol=1e-9
            )
            assert len(one.standard_errors) == len(one.control_points) == one.channels * (one.degree + 1) ** 2
            assert len(one.covariance) == one.channels**2 and len(one.noise_sigma) == one.channels
        inside = result.labels[rows, cols] == region.label
        surface = surface_points(array, message, rows[inside], cols[inside])
        error_m = np.abs(surface - frame.points[rows[inside], cols[inside]])
        assert not inside.any() or np.nanmedian(error_m) < 0.005
        assert tuple(message.neighbors) == tuple(region.neighbors)


def test_colour_of_the_cloud_alone(live, frame, labels, run):
    _, peer = run("of_cloud", {"input.color_from": "cloud"}, ("labels", "regions"))
    peer.connected("points", "camera_info")
    stamp = next(stamps)
    peer.publish(camera_info=live.camera_info_of(frame, stamp))
    peer.publish(points=live.cloud_of(frame, stamp))
    np.testing.assert_array_equal(live.image_array(peer.wait_for("labels", stamp)), labels)


def test_a_scanner_grid_without_camera(live, frame, run):
    _, peer = run("of_scanner", {"input.camera": "none"}, ("labels", "regions"))
    peer.connected("points", "image")
    stamp = next(stamps)
    peer.send(frame, stamp, camera=False)
    expected = live.expected_labels(RangeColorFrame(frame.points, frame.color))
    np.testing.assert_array_equal(live.image_array(peer.wait_for("labels", stamp)), expected)
    array = peer.wait_for("regions", stamp)
    assert array.k[0] == 0 and array.regions[0].range_patch.kind == 2
