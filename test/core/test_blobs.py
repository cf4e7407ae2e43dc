"""False blobs: what counts as one on a wall whose noise and things are known."""

import numpy as np
import pytest

from rcseg_core import PinholeCamera, RangeColorFrame
from rcseg_core.evaluation.blobs import find_blobs

HEIGHT, WIDTH = 120, 160
CAMERA = PinholeCamera(150.0, 150.0, 79.5, 59.5)
SIGMA_M = 0.002


def wall(things=(), *, quantum_m=0.0, camera=CAMERA, curved=False):
    """A slanted wall near 2 m with noise, and boxes (rows, cols) that stand out of it by some metres."""
    rng = np.random.default_rng(7)
    rays = CAMERA.rays(HEIGHT, WIDTH)
    depth = 1 / (0.5 + 0.08 * rays[..., 0] + 0.05 * rays[..., 1])
    if curved:
        depth = depth - 0.5 * rays[..., 0] ** 2
    depth = depth + rng.normal(0, SIGMA_M, depth.shape)
    for (rows, cols), height_m in things:
        depth[rows, cols] -= height_m
    if quantum_m:
        depth = np.round(depth / quantum_m) * quantum_m
    points = rays * depth[..., None].astype(np.float32)
    return RangeColorFrame(points, np.full(points.shape, 90, np.uint8), camera)


def labels_with(*boxes):
    labels = np.ones((HEIGHT, WIDTH), np.int32)
    for number, (rows, cols) in enumerate(boxes, start=2):
        labels[rows, cols] = number
    return labels


MIDDLE = (slice(50, 70), slice(60, 80))
CORNER = (slice(95, 120), slice(0, 25))


@pytest.mark.parametrize("curved", [False, True])
@pytest.mark.parametrize("camera", [CAMERA, None])
def test_a_piece_of_the_wall_is_a_blob_and_told_where(camera, curved):
    (blob,) = find_blobs(labels_with(MIDDLE), wall(camera=camera, curved=curved), 100)
    assert (blob.label, blob.host, blob.pixel_count) == (2, 1, 400)
    assert blob.box == (50, 60, 69, 79)
    assert 58 <= blob.row <= 61 and 68 <= blob.col <= 71


def test_what_stands_out_is_none_until_the_noise_hides_it():
    assert not find_blobs(labels_with(MIDDLE), wall([(MIDDLE, 0.04)]), 100)
    assert find_blobs(labels_with(MIDDLE), wall([(MIDDLE, 0.004)]), 100)


def test_less_than_a_step_of_a_quantised_sensor_is_no_thing():
    """Steps of 5 cm: a piece 3 cm nearer differs by one step in places, one 15 cm nearer stands out."""
    assert find_blobs(labels_with(MIDDLE), wall([(MIDDLE, 0.03)], quantum_m=0.05), 100)
    assert not find_blobs(labels_with(MIDDLE), wall([(MIDDLE, 0.15)], quantum_m=0.05), 100)


def test_a_corner_of_the_image_counts_with_two_sides():
    assert len(find_blobs(labels_with(CORNER), wall(), 100)) == 1


def test_small_parts_and_parts_between_two_surfaces_are_none():
    assert not find_blobs(labels_with(MIDDLE), wall(), 401)
    halves = labels_with(MIDDLE)
    halves[:, :70][halves[:, :70] == 1] = 3
    assert not find_blobs(halves, wall(), 100)


def test_a_piece_amid_unknown_pixels_is_none():
    labels = labels_with(MIDDLE)
    labels[45:75, 55:85] = np.where(labels[45:75, 55:85] == 2, 2, 0)
    assert not find_blobs(labels, wall(), 100)


def test_every_part_of_a_surface_is_judged_by_itself():
    other = (slice(20, 35), slice(100, 120))
    labels = labels_with(MIDDLE)
    labels[other] = 2
    found = find_blobs(labels, wall([(other, 0.1)]), 100)
    assert [blob.box for blob in found] == [(50, 60, 69, 79)]
    assert [blob.pixel_count for blob in find_blobs(labels, wall(), 100)] == [400, 300]


def test_the_larger_of_two_is_never_the_blob():
    """All neighbours of both are the other; the smaller is the one too many."""
    labels = np.full((HEIGHT, WIDTH), 2, np.int32)
    labels[10:-10, 10:-10] = 1
    assert [blob.label for blob in find_blobs(labels, wall(), 100)] == [2]


def test_a_surface_that_is_not_smooth_explains_nothing():
    """The host steps by half a metre all round the piece: no quadratic with noise, whatever its spread."""
    steps = [((slice(None), slice(col, col + 10)), 0.5) for col in range(0, WIDTH, 20)]
    assert not find_blobs(labels_with(MIDDLE), wall(steps), 100)
