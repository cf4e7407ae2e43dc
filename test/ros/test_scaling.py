"""Images and cameras in other sizes than the range; the right values follow from the text of CameraInfo."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from test_assembly import camera_message, image_message, make, range_cloud

from rcseg_core import PinholeCamera
from rcseg_ros.frames.assembly import assemble_frame
from rcseg_ros.frames.conversions import MessageError, decode_camera_info
from rcseg_ros.frames.scaling import fit_camera_info, scale_color
from rcseg_ros.results.outputs import depth_message

HEIGHT, WIDTH = 30, 40
PINHOLE = PinholeCamera(50.0, 52.0, 19.5, 14.5)
HALF = PinholeCamera(25.0, 26.0, (19.5 + 0.5) / 2 - 0.5, (14.5 + 0.5) / 2 - 0.5)
RNG = np.random.default_rng(3)
DEPTH = (1 + RNG.random((HEIGHT, WIDTH))).astype(np.float32)


def board(height, width):
    """A smooth picture of the same view in any size: colour by the direction of sight."""
    y, x = (np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width
    return np.rint(np.dstack(np.broadcast_arrays(40 + 160 * x, (30 + 180 * y)[:, None], 90))).astype(np.uint8)


def fitted(message, height, width):
    camera = decode_camera_info(fit_camera_info(message, (height, width)))
    assert (camera.height, camera.width) == (height, width)
    return camera.pinhole


def near(pinhole, expected):
    np.testing.assert_allclose(pinhole.matrix(), expected.matrix(), atol=1e-9)


def info(height=480, width=640, binning=(0, 0), roi=(0, 0, 0, 0), k=(500.0, 510.0, 320.0, 240.0), p=None):
    fx, fy, cx, cy = k
    x, y, roi_height, roi_width = roi
    message = camera_message(height, width, PinholeCamera(fx, fy, cx, cy))
    message.binning_x, message.binning_y = binning
    message.roi = SimpleNamespace(x_offset=x, y_offset=y, height=roi_height, width=roi_width)
    if p is not None:
        message.p = np.array(p, float)
    return message


def test_a_camera_info_of_the_image_is_taken_as_it_is():
    message = info()
    assert fit_camera_info(message, (480, 640)) is message


def test_a_camera_info_without_a_size_takes_that_of_the_image():
    near(fitted(info(0, 0), 480, 640), PinholeCamera(500, 510, 320, 240))
    near(fitted(info(0, 640), 480, 640), PinholeCamera(500, 510, 320, 240))
    cut = info(0, 0, roi=(100, 40, 0, 0), binning=(2, 2))
    near(fitted(cut, 100, 150), PinholeCamera(250, 255, 110, 100))


@pytest.mark.parametrize("factor", [2, 4, 1.25, 0.5])
def test_a_camera_info_of_another_size_is_scaled(factor):
    size = round(480 / factor), round(640 / factor)
    expected = PinholeCamera(
        500 / factor, 510 / factor, (320 + 0.5) / factor - 0.5, (240 + 0.5) / factor - 0.5
    )
    near(fitted(info(), *size), expected)


def test_binning_and_region_count_where_the_image_has_them():
    binned = info(binning=(2, 2))
    near(fitted(binned, 240, 320), PinholeCamera(250, 255, 160, 120))
    near(fitted(binned, 480, 640), PinholeCamera(500, 510, 320, 240))  # the driver did not bin after all
    near(fitted(binned, 120, 160), PinholeCamera(125, 127.5, 160.5 / 2 - 0.5, 120.5 / 2 - 0.5))
    region = info(roi=(100, 40, 200, 300))
    near(fitted(region, 200, 300), PinholeCamera(500, 510, 220, 200))
    near(fitted(region, 480, 640), PinholeCamera(500, 510, 320, 240))
    near(fitted(region, 100, 150), PinholeCamera(250, 255, 220.5 / 2 - 0.5, 200.5 / 2 - 0.5))
    both = info(roi=(100, 40, 200, 300), binning=(2, 2))
    near(fitted(both, 100, 150), PinholeCamera(250, 255, 110, 100))
    near(fitted(both, 240, 320), PinholeCamera(250, 255, 160, 120))


def test_the_projection_is_scaled_too():
    p = [400.0, 0, 310, -20, 0, 405, 230, 0, 0, 0, 1, 0]
    half = fit_camera_info(info(p=p), (240, 320)).p.reshape(3, 4)
    np.testing.assert_allclose(
        half, [[200, 0, 310.5 / 2 - 0.5, -10], [0, 202.5, 230.5 / 2 - 0.5, 0], [0, 0, 1, 0]]
    )
    nothing = fit_camera_info(info(p=np.zeros(12)), (240, 320)).p
    assert not nothing.any()


@pytest.mark.parametrize("size", [(480, 320), (400, 640), (481, 320)])
def test_sides_out_of_proportion_are_refused_with_both_sizes(size):
    with pytest.raises(MessageError, match=f"is {size[1]}x{size[0]} but camera_info is 640x480") as caught:
        fit_camera_info(info(), size)
    assert caught.value.reason == "size_mismatch"


@pytest.mark.parametrize("color_scale", [0.5, 1, 2, 3])
@pytest.mark.parametrize("camera_scale", [0.5, 1, 2])
def test_depth_with_colour_and_camera_of_other_sizes(color_scale, camera_scale):
    """160x120 depth with 320x240 colour, and their relatives."""
    color = board(int(HEIGHT * color_scale), int(WIDTH * color_scale))
    s = camera_scale
    camera = PinholeCamera(50 * s, 52 * s, 20 * s - 0.5, 15 * s - 0.5)
    message = camera_message(int(HEIGHT * s), int(WIDTH * s), camera)
    frame = assemble_frame(depth_message(DEPTH, None, make), image_message(color), message)
    near(frame.camera, PINHOLE)
    np.testing.assert_array_equal(frame.depth_m, DEPTH)
    assert np.abs(frame.color.astype(int) - board(HEIGHT, WIDTH)).max() <= 3


def test_colour_is_averaged_over_the_pixels_of_the_depth():
    color = RNG.integers(0, 256, (60, 80, 3), np.uint8)
    mean = color.reshape(30, 2, 40, 2, 3).mean(axis=(1, 3))
    assert np.abs(scale_color(color, (30, 40)) - mean).max() <= 0.5


def test_colour_out_of_proportion_is_refused():
    with pytest.raises(MessageError, match="depth image is 40x30 but colour image is 80x50, which no scale"):
        assemble_frame(depth_message(DEPTH, None, make), image_message(board(50, 80)), camera_message())


def test_an_organised_cloud_of_half_the_size_keeps_its_grid():
    depth = cv2.resize(DEPTH, (20, 15), interpolation=cv2.INTER_NEAREST)
    points = HALF.rays(15, 20) * depth[..., None]
    frame = assemble_frame(
        range_cloud(points, [1, 2, 3]), image_message(board(HEIGHT, WIDTH)), camera_message()
    )
    np.testing.assert_array_equal(frame.points, points)
    near(frame.camera, HALF)
    assert np.abs(frame.color.astype(int) - board(15, 20)).max() <= 3
    without_size = camera_message(0, 0, HALF)
    near(assemble_frame(range_cloud(points, [1, 2, 3]), None, without_size).camera, HALF)


def test_a_small_cloud_in_proportion_that_is_of_no_camera_is_projected():
    turned = (PINHOLE.rays(15, 20) * 2)[::-1]
    frame = assemble_frame(
        range_cloud(turned, [1, 2, 3]), image_message(board(HEIGHT, WIDTH)), camera_message()
    )
    assert frame.points.shape == (HEIGHT, WIDTH, 3)


def test_a_cloud_of_half_the_size_needs_the_camera_that_relates_the_two():
    points = HALF.rays(15, 20) * 2
    with pytest.raises(
        MessageError, match="cloud is 20x15 but colour image is 40x30, in proportion"
    ) as caught:
        assemble_frame(range_cloud(points, [1, 2, 3]), image_message(board(HEIGHT, WIDTH)), None)
    assert caught.value.reason == "size_mismatch" and "no camera_info" in str(caught.value)
