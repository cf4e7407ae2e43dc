"""The rays of grids: found where they pass through one centre, refused where they do not."""

import numpy as np
import pytest
from scans import cast, frame_of, room_scan, spherical_rays, tilt

from rcseg_core import PinholeCamera, RangeColorFrame
from rcseg_core.resampling.rays import SphericalRays, TurnedPinhole, find_rays
from rcseg_core.synthetic import make_scene

OPTICAL = np.eye(3)
LIDAR = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # x ahead, y left, z up
EVEN = (np.linspace(25, -35, 60), np.linspace(-35, 35, 80))
BEAMS = np.array([20, 16, 13, 10, 8, 6, 4.5, 3, 1.5, 0.5, -1, -2.5, -4, -6, -8, -11, -14, -17, -21, -25.0])


def grey(points):
    return RangeColorFrame(points.astype(np.float32), np.full(points.shape, 128, np.uint8))


@pytest.mark.parametrize("axes", [OPTICAL, LIDAR, tilt(10, -25, 40)], ids=["optical", "lidar", "tilted"])
@pytest.mark.parametrize(
    ("elevation", "azimuth"),
    [
        EVEN,
        (EVEN[0][::-1], EVEN[1]),
        (EVEN[0], EVEN[1][::-1]),
        (BEAMS, np.linspace(-50, 50, 200)),
        (np.linspace(8, -8, 40), np.linspace(60, 130, 120)),
    ],
    ids=["even", "upside down", "mirrored", "uneven beams", "to the right"],
)
def test_directions_of_a_spherical_scanner_are_found(axes, elevation, azimuth):
    straight = spherical_rays(elevation, azimuth)
    range_m, _ = cast(straight, planes=[(n, d) for n, d in ROUND])
    truth = straight @ axes.T
    found = find_rays(frame_of(truth, range_m, sigma=0.003))
    assert isinstance(found, SphericalRays)
    least_step = np.deg2rad(min(np.abs(np.diff(elevation)).min(), np.abs(np.diff(azimuth)).min()))
    assert np.abs(found.directions() - truth).max() < 0.02 * least_step


#: A room all round, so that every ray meets something.
ROUND = [((s * x, s * y, s * z), 2.0) for x, y, z in ((1, 0, 0.1), (0, 1, 0), (0.1, 0, 1)) for s in (-1, 1)]


def test_columns_may_have_the_elevations():
    frame, _ = room_scan(60, 80)
    rays, found = find_rays(frame), find_rays(grey(np.ascontiguousarray(frame.points.swapaxes(0, 1))))
    np.testing.assert_allclose(found.directions(), rays.directions().swapaxes(0, 1), atol=1e-6)
    rows, cols = found.locate(found.directions())
    np.testing.assert_allclose(rows, np.arange(80)[:, None] + np.zeros(60), atol=1e-4)
    np.testing.assert_allclose(cols, np.arange(60)[None] + np.zeros((80, 1)), atol=1e-4)


def test_locating_a_direction_is_the_inverse_of_looking_along_it():
    frame, _ = room_scan(60, 80)
    rays = find_rays(frame)
    rows, cols = rays.locate(7.0 * rays.directions())  # the length says nothing
    np.testing.assert_allclose(rows, np.arange(60)[:, None] + np.zeros(80), atol=1e-6)
    np.testing.assert_allclose(cols, np.arange(80)[None] + np.zeros((60, 1)), atol=1e-6)
    halfway = rays.directions()[10, 10] + rays.directions()[10, 11]
    np.testing.assert_allclose(rays.locate(halfway), (10, 10.5), atol=0.01)
    assert np.isnan(rays.locate(np.array([0.0, 0.0, -1.0]))).any()


@pytest.mark.parametrize("trouble", ["drop-out", "impulses", "millimetres", "empty lines", "origin"])
def test_rays_are_found_in_spite_of(trouble):
    frame, _ = room_scan(90, 120)
    rng = np.random.default_rng(1)
    points = frame.points.astype(np.float64)
    if trouble == "drop-out":
        points[rng.random(points.shape[:2]) < 0.4] = np.nan
    elif trouble == "impulses":
        points *= np.where(rng.random(points.shape[:2]) < 0.2, rng.uniform(0.3, 3, points.shape[:2]), 1)[
            ..., None
        ]
    elif trouble == "millimetres":
        points = np.round(points, 3)
    elif trouble == "empty lines":
        points[[0, 1, 40, 89]] = np.nan
        points[:, [0, 60, 61, 62, 119]] = np.nan
    else:
        points[20:40, 20:60] = (0.0, 0.0, 1e-12)
    found = find_rays(grey(points))
    assert isinstance(found, SphericalRays)
    truth = spherical_rays(np.linspace(25, -35, 90), np.linspace(-35, 35, 120))
    assert np.abs(found.directions() - truth).max() < 0.1 * np.deg2rad(60 / 89)


def test_a_depth_camera_without_intrinsics_is_found():
    scene = make_scene("room", 41, width=160, height=120, noise=2.0, dropout=0.2, outliers=0.1)
    found = find_rays(RangeColorFrame(scene.frame.points, scene.frame.color))
    assert isinstance(found, PinholeCamera)
    np.testing.assert_allclose(
        found.matrix(), scene.frame.camera.matrix(), atol=1e-2, err_msg=str(scene.frame.camera)
    )


@pytest.mark.parametrize("family", ["painting", "billiard"])
@pytest.mark.parametrize("seed", range(40, 44))
def test_parallel_rays_have_no_centre(family, seed):
    assert find_rays(make_scene(family, seed, width=320, height=240).frame) is None


@pytest.mark.parametrize("slope", [0.0, 0.01, 0.2])
@pytest.mark.parametrize("lateral_m", [0.0, 1e-4])
def test_a_board_before_a_scanner_of_parallel_rays_has_no_centre(slope, lateral_m):
    # along parallel rays a plane looks as through some pinhole: no reason to leave x, y, z
    rows, cols = np.mgrid[0:120, 0:160]
    x, y = (cols - 79.5) * 1e-3, (rows - 59.5) * 1e-3
    points = np.stack([x, y, 0.6 + slope * (x + 0.5 * y)], -1)
    points[..., :2] += lateral_m * np.random.default_rng(0).normal(size=(120, 160, 2))
    assert find_rays(grey(points)) is None


def test_a_scan_that_was_moved_from_its_centre_has_none_in_the_origin():
    frame, _ = room_scan(60, 80)
    assert find_rays(grey(frame.points + np.array([0.3, -0.2, 0.1]))) is None


def bad_grids():
    rng = np.random.default_rng(0)
    full = room_scan(60, 80)[0].points
    one_row, one_column = np.full_like(full, np.nan), np.full_like(full, np.nan)
    one_row[30], one_column[:, 40] = full[30], full[:, 40]
    one_point = np.full_like(full, np.nan)
    one_point[3, 5] = (0.1, 0.2, 1.0)
    yield "one row", one_row
    yield "one column", one_column
    yield "one point", one_point
    yield "few rows", np.where((np.arange(60) % 10 == 0)[:, None, None], full, np.nan)
    yield "the same point", np.broadcast_to(np.array([0.1, 0.2, 1.0]), full.shape).copy()
    yield "the same row", np.broadcast_to(full[30], full.shape).copy()
    yield "points anywhere", rng.normal(size=full.shape)
    yield "rows in disorder", full[rng.permutation(60)]
    yield "in the origin", np.full_like(full, 1e-12)
    yield "smallest", full[:3, :3]
    yield "on a line", np.linspace(1, 2, 4800).reshape(60, 80, 1) * np.array([0.1, 0.2, 1.0])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("points", [p for _, p in bad_grids()], ids=[name for name, _ in bad_grids()])
def test_bad_grids_have_no_rays(points):
    assert find_rays(grey(points)) is None


@pytest.mark.parametrize(
    "axes", [LIDAR, tilt(10, -25, 40), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])],
    ids=["x ahead", "tilted", "on its side"],
)  # fmt: skip
@pytest.mark.parametrize("family", ["room", "blocks"])
def test_a_depth_camera_in_other_axes_is_found(axes, family):
    scene = make_scene(family, 41, width=160, height=120, noise=2.0, dropout=0.2, outliers=0.1)
    found = find_rays(grey(scene.frame.points @ axes.T))
    assert isinstance(found, TurnedPinhole)
    np.testing.assert_allclose(found.axes, axes.T, atol=1e-5)
    np.testing.assert_allclose(found.camera.matrix(), scene.frame.camera.matrix(), atol=1e-2)


@pytest.mark.parametrize("shift", [(0.3, -0.2, 0.1), (0.0, 0.0, 1.2)])
def test_a_depth_camera_that_was_moved_from_the_origin_is_not(shift):
    scene = make_scene("blocks", 41, width=160, height=120)
    assert find_rays(grey(scene.frame.points @ LIDAR.T + np.array(shift))) is None


def test_a_whole_sweep_of_a_street_is_no_camera(shared_data):
    path = shared_data.parent / "field" / "ouster_os2_1024x128.npz"
    if not path.exists():
        pytest.skip(f"no {path.name}")
    with np.load(path) as arrays:
        frame = RangeColorFrame(arrays["points"], arrays["color"])
    assert frame.valid.mean() > 0.9
    assert not isinstance(find_rays(frame), PinholeCamera | TurnedPinhole)
