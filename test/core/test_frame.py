"""The door: what a frame takes, what it refuses and in which words."""

import numpy as np
import pytest

from rcseg_core import InputError, PinholeCamera, RangeColorFrame

CAMERA = PinholeCamera(500.0, 510.0, 31.5, 23.5)
POINTS = np.ones((6, 8, 3), np.float32)
COLOR = np.zeros((6, 8, 3), np.uint8)


@pytest.mark.parametrize(
    ("points", "color", "camera", "text"),
    [
        (None, COLOR, None, "points: expected an array of shape (H, W, 3), got NoneType"),
        ([[1.0]], COLOR, None, "points: expected an array of shape (H, W, 3), got list"),
        (POINTS[..., 0], COLOR, None, "points: expected an array of shape (H, W, 3), got shape (6, 8)"),
        (np.ones((6, 8, 4)), COLOR, None, "got shape (6, 8, 4)"),
        (POINTS.astype(np.int32), COLOR, None, "points: expected float32 or float64 metres, got int32"),
        (POINTS.astype(np.float16), COLOR, None, "points: expected float32 or float64 metres, got float16"),
        (POINTS, COLOR[..., 0], None, "color: expected an array of shape (H, W, 3), got shape (6, 8)"),
        (POINTS, COLOR.tolist(), None, "color: expected an array of shape (H, W, 3), got list"),
        (POINTS, COLOR.astype(float), None, "color: expected uint8 RGB, got float64"),
        (
            POINTS,
            COLOR[:5],
            None,
            "points are 8x6 and color is 8x5: both must be registered in one pixel grid",
        ),
        (POINTS[:2], COLOR[:2], None, "the image is 8x2: at least 3x3 pixels are needed"),
        (POINTS[:, :1], COLOR[:, :1], None, "the image is 1x6: at least 3x3 pixels are needed"),
        (POINTS, COLOR, "camera", "camera: expected a PinholeCamera or None, got str"),
        (POINTS, COLOR, np.eye(3), "camera: expected a PinholeCamera or None, got ndarray"),
        (POINTS * np.nan, COLOR, CAMERA, "no valid pixel: every point is NaN, infinite or (0, 0, 0)"),
        (POINTS * 0, COLOR, CAMERA, "no valid pixel: every point is NaN, infinite or (0, 0, 0)"),
        (POINTS * 0, COLOR, None, "no valid pixel: every point is NaN, infinite or (0, 0, 0)"),
        (-POINTS, COLOR, CAMERA, "no valid pixel: none of the 48 points lies before the camera (z > 0)"),
        (POINTS * [1, 1, 0], COLOR, CAMERA, "no valid pixel: none of the 48 points lies before the camera"),
        (POINTS * np.inf, COLOR, CAMERA, "no valid pixel: every point is NaN, infinite"),
        (POINTS * np.float32(1e30), COLOR, None, "no valid pixel: all 48 points lie beyond what is metres"),
    ],
)
def test_what_is_refused_and_in_which_words(points, color, camera, text):
    with pytest.raises(InputError) as error:
        RangeColorFrame(points, color, camera)
    assert text in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("depth", "camera", "text"),
    [
        (POINTS, CAMERA, "depth: expected an array of shape (H, W), got shape (6, 8, 3)"),
        ([1.0], CAMERA, "depth: expected an array of shape (H, W), got list"),
        (np.ones((6, 8), np.uint16), CAMERA, "depth: expected float32 or float64 metres, got uint16"),
        (np.ones((6, 8)), None, "camera: a depth image needs a PinholeCamera"),
        (np.zeros((6, 8)), CAMERA, "no valid pixel"),
        (np.ones((6, 9)), CAMERA, "points are 9x6 and color is 8x6"),
    ],
)
def test_depth_images_are_checked_alike(depth, camera, text):
    with pytest.raises(InputError) as error:
        RangeColorFrame.from_depth(depth, COLOR, camera)
    assert text in str(error.value)


@pytest.mark.parametrize(
    "intrinsics",
    [
        (0, 1, 0, 0), (1, 0, 0, 0), (-5, 5, 0, 0), (5, -5, 0, 0), (np.nan, 1, 0, 0), (1, np.inf, 0, 0),
        (1, 1, np.nan, 0), (1, 1, 0, -np.inf),
    ],
)  # fmt: skip
def test_cameras_have_finite_positive_focal_lengths(intrinsics):
    with pytest.raises(InputError, match="camera: "):
        PinholeCamera(*intrinsics)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 0.0, -0.0, -1.0])
def test_bad_depth_marks_a_pixel_invalid(dtype, bad):
    depth = np.full((6, 8), 2.0, dtype)
    depth[1, 2] = bad
    frame = RangeColorFrame.from_depth(depth, COLOR, CAMERA)
    assert np.argwhere(~frame.valid).tolist() == [[1, 2]]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize(("channel", "camera"), [(0, None), (1, None), (2, None), (2, CAMERA)])
def test_any_bad_coordinate_marks_a_pixel_invalid(channel, camera, bad):
    points = POINTS.copy()
    points[1, 2, channel] = bad
    assert np.argwhere(~RangeColorFrame(points, COLOR, camera).valid).tolist() == [[1, 2]]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("channel", [0, 1])
def test_with_a_camera_as_well(channel, bad):
    points = POINTS.copy()
    points[1, 2, channel] = bad
    assert np.argwhere(~RangeColorFrame(points, COLOR, CAMERA).valid).tolist() == [[1, 2]]


def test_points_in_the_plane_z_0_are_points_without_a_camera():
    """The floor of a map, the horizon of a lidar; with a camera nothing can be measured there."""
    points = POINTS.copy()
    points[:3, :, 2] = 0
    points[5, 5] = 0
    assert np.argwhere(~RangeColorFrame(points, COLOR, None).valid).tolist() == [[5, 5]]
    beside = RangeColorFrame(points, COLOR, CAMERA)
    assert not beside.valid[:3].any() and beside.valid[3:].sum() == 23


def test_points_behind_a_scanner_are_points():
    points = POINTS.copy()
    points[..., 2] = -1
    assert RangeColorFrame(points, COLOR, None).valid.all()


def test_from_depth_puts_points_on_the_rays_of_the_camera():
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 4, (48, 64))
    frame = RangeColorFrame.from_depth(depth, np.zeros((48, 64, 3), np.uint8), CAMERA)
    assert (frame.height, frame.width) == (48, 64)
    np.testing.assert_allclose(frame.depth_m, depth, rtol=1e-6)
    for row, col in ((0, 0), (47, 63), (20, 31)):
        projected = CAMERA.matrix() @ frame.points[row, col]
        np.testing.assert_allclose(projected[:2] / projected[2], [col, row], atol=1e-3)


def test_every_layout_comes_to_the_kernels_as_one():
    """Numba compiles a kernel for each layout; what fits already is taken as it is."""
    points, color = np.ones((6, 8, 3), np.float32), np.zeros((6, 8, 3), np.uint8)
    frame = RangeColorFrame(points, color)
    assert frame.points is points and frame.color is color
    color.setflags(write=False)
    odd = RangeColorFrame(points[::2, ::-1], color[::2, ::-1])
    for array in (odd.points, odd.color):
        assert array.flags.c_contiguous and array.flags.writeable
    np.testing.assert_array_equal(odd.color, color[::2, ::-1])


def test_a_frame_without_extent_is_refused_in_one_line():
    from rcseg_core import SegmenterConfig, segment

    points = np.zeros((3, 3, 3), np.float32)
    points[..., 0] = np.arange(3)
    frame = RangeColorFrame(points, np.zeros((3, 3, 3), np.uint8))
    with pytest.raises(InputError, match="no extent"):
        segment(frame, SegmenterConfig().replace({"noise.range_model": "kinect_v1"}))
