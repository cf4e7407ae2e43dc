"""Pictures: colours that stay, boundaries that are there, sizes that fit."""

from time import perf_counter

import cv2
import numpy as np
import pytest

from rcseg_core.errors import InputError
from rcseg_core.result import drawing


def two_labels():
    labels = np.zeros((40, 60), np.int32)
    labels[5:30, 5:30] = 1
    labels[5:30, 30:55] = 2
    return labels


def test_a_label_keeps_its_colour_and_zero_is_black():
    colors = drawing.label_colors(500)
    assert colors.shape == (501, 3)
    assert colors.dtype == np.uint8
    assert (colors[:11] == drawing.label_colors(10)).all()
    assert (colors[0] == 0).all()


def test_labels_close_in_number_are_far_apart_in_colour():
    colors = drawing.label_colors(300).astype(int)
    for step in (1, 2, 3, 4):
        difference = np.abs(colors[1 + step :] - colors[1:-step]).max(axis=1)
        assert difference.min() >= 60


def test_labels_picture_looks_colours_up():
    labels = two_labels()
    picture = drawing.labels_picture(labels)
    assert (picture == drawing.label_colors(2)[labels]).all()
    assert (drawing.labels_picture(np.zeros((3, 4), np.uint16)) == 0).all()


def test_overlay_blends_and_draws_white_boundaries():
    labels = two_labels()
    color = np.full((40, 60, 3), 100, np.uint8)
    picture = drawing.overlay(color, labels, opacity=0.5)
    assert picture.shape == color.shape
    assert picture.dtype == np.uint8
    assert (picture[10, 29] == 255).all()
    inner = 0.5 * drawing.label_colors(2)[1].astype(float) + 50
    assert np.abs(picture[10, 10] - inner).max() <= 1
    assert (picture[35, 5] == 50).all()
    assert (color == 100).all()


def naive_boundaries(labels):
    """Pixel by pixel: the next labelled pixel to the right or below, over one hole at most, is another's."""
    height, width = labels.shape
    edge = np.zeros((height, width), bool)
    for row in range(height):
        for col in range(width):
            for down, right in ((0, 1), (1, 0)):
                ahead = [
                    labels[row + step * down, col + step * right]
                    for step in (1, 2)
                    if row + step * down < height and col + step * right < width
                ]
                other = next((label for label in ahead if label), 0)
                edge[row, col] |= labels[row, col] > 0 and other > 0 and other != labels[row, col]
    return edge


def test_missing_pixels_have_no_borders_and_break_none():
    rng = np.random.default_rng(3)
    labels = two_labels()
    whole = drawing.boundaries(labels)
    labels[rng.random(labels.shape) < 0.2] = 0
    found = drawing.boundaries(labels)
    assert (found == naive_boundaries(labels)).all()
    one = np.where(labels > 0, 1, 0)
    assert not drawing.boundaries(one).any()
    color = np.full((*labels.shape, 3), 100, np.uint8)
    white = (drawing.overlay(color, one) == 255).all(axis=2)
    assert not white.any()
    assert 0.8 * whole.sum() < found.sum() < 1.2 * whole.sum()


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1), (2, 2), (7, 9)])
def test_boundaries_of_small_and_random_images(shape):
    labels = np.random.default_rng(1).integers(0, 4, shape).astype(np.uint16)
    assert (drawing.boundaries(labels) == naive_boundaries(labels)).all()


def test_overlay_of_images_that_do_not_fit_is_refused():
    with pytest.raises(InputError, match="overlay"):
        drawing.overlay(np.zeros((4, 5, 3), np.uint8), np.zeros((5, 4), np.int32))


@pytest.mark.alone
def test_an_overlay_costs_less_than_a_boolean_index_of_the_image():
    """In the same run, since machines differ: an overlay is .3 to .5 of it."""
    labels = np.random.default_rng(0).integers(0, 50, (12, 16)).repeat(40, 0).repeat(40, 1).astype(np.int32)
    color = np.zeros((480, 640, 3), np.uint8)
    times = {"overlay": [], "index": []}
    for _ in range(15):
        start = perf_counter()
        drawing.overlay(color, labels)
        middle = perf_counter()
        color[labels > 3]
        times["overlay"].append(middle - start)
        times["index"].append(perf_counter() - middle)
    assert min(times["overlay"]) < min(times["index"])


def test_edge_bits_have_their_colours():
    picture = drawing.edges_picture(np.array([[0, 1, 2, 4, 7]], np.uint8))
    assert (picture[0, 0] == 0).all()
    for column, bit in ((1, 1), (2, 2), (3, 4)):
        assert tuple(picture[0, column]) == drawing.EDGE_COLORS[bit]
    assert (picture[0, 4] == 255).all()


def test_depth_picture_marks_invalid_black_and_orders_near_to_far():
    depth = np.linspace(1, 3, 200).reshape(10, 20)
    depth[0, 0], depth[0, 1], depth[0, 2] = np.nan, 0.0, -1.0
    picture = drawing.depth_picture(depth)
    assert (picture[0, :3] == 0).all()
    assert picture[0, 5, 0] > picture[0, 5, 2]
    assert picture[-1, -3, 2] >= picture[-1, -3, 0]
    assert (drawing.depth_picture(np.full((4, 4), np.nan)) == 0).all()
    flat = drawing.depth_picture(np.full((4, 4), 2.0))
    assert (flat == flat[0, 0]).all()


def test_contact_sheet_holds_every_panel():
    red, tall = np.full((30, 40, 3), (255, 0, 0), np.uint8), np.full((60, 40, 3), 9, np.uint8)
    sheet = drawing.contact_sheet([("one", red), ("two", red), ("three", tall)], columns=2, panel_width=80)
    height = 120 + drawing.TITLE_HEIGHT_PX
    assert sheet.shape == (2 * height, 160, 3)
    assert (sheet[drawing.TITLE_HEIGHT_PX + 10, 40] == (255, 0, 0)).all()
    assert (sheet[height + drawing.TITLE_HEIGHT_PX + 100, 40] == 9).all()
    assert sheet[: drawing.TITLE_HEIGHT_PX, :80].max() > 200, "the title is missing"
    with pytest.raises(InputError, match="no pictures"):
        drawing.contact_sheet([])


def test_png_files_come_back_as_they_were(tmp_path):
    labels = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000
    drawing.write_png(tmp_path / "l.png", labels)
    assert (cv2.imread(str(tmp_path / "l.png"), cv2.IMREAD_UNCHANGED) == labels).all()
    rgb = np.random.default_rng(0).integers(0, 256, (3, 4, 3)).astype(np.uint8)
    drawing.write_png(tmp_path / "c.png", rgb)
    assert (cv2.imread(str(tmp_path / "c.png"))[..., ::-1] == rgb).all()


def test_an_unwritable_png_is_one_clear_line(tmp_path):
    with pytest.raises(InputError, match=r"no/such/x\.png: cannot be written"):
        drawing.write_png(tmp_path / "no" / "such" / "x.png", np.zeros((2, 2, 3), np.uint8))


def test_surfaces_are_painted_by_their_kind():
    labels = np.zeros((6, 9), np.int32)
    labels[:, 3:6], labels[:, 6:] = 1, 2
    picture = drawing.kinds_picture(labels, ["sphere", "none"])
    assert (picture[:, :3] == 0).all()
    assert (picture[:, 3:5] == drawing.KIND_COLORS["sphere"]).all() and (
        picture[:, 6:] == drawing.KIND_COLORS["none"]
    ).all()
    assert (picture[:, 5] == drawing.BOUNDARY_COLOR).all()
