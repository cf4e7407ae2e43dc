"""Folders of recorded frames: what is read, what truth means, what is said of bad files."""

import json

import cv2
import numpy as np
import pytest

from rcseg_core.datasets import OBJECTS, PLAIN_GREY, REGIONS, find_frames, load_frame, load_frames
from rcseg_core.errors import InputError

META = {"fx": 100.0, "fy": 101.0, "cx": 7.5, "cy": 5.5, "depth_unit_m": 0.001}


def write_frame(folder, meta=META, *, depth=None, color=True, labels=None):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "meta.json").write_text(json.dumps(meta) if isinstance(meta, dict) else meta)
    depth = np.full((12, 16), 1500, np.uint16) if depth is None else depth
    cv2.imwrite(str(folder / "depth.png"), depth)
    if color:
        bgr = np.zeros((12, 16, 3), np.uint8)
        bgr[:] = (10, 20, 200)
        cv2.imwrite(str(folder / "rgb.png"), bgr)
    if labels is not None:
        cv2.imwrite(str(folder / "labels.png"), labels)
    return folder


def test_a_frame_folder_gives_metres_colour_camera_and_truth(tmp_path):
    depth = np.full((12, 16), 1500, np.uint16)
    depth[0, 0] = 0
    labels = np.full((12, 16), 20, np.uint8)
    labels[6:] = 300 % 256
    frame = load_frame(write_frame(tmp_path / "a", depth=depth, labels=labels))
    assert frame.name == "a"
    assert frame.frame.depth_m[5, 5] == pytest.approx(1.5)
    assert not frame.frame.valid[0, 0]
    assert frame.frame.valid.sum() == 12 * 16 - 1
    assert tuple(frame.frame.color[3, 3]) == (200, 20, 10)
    assert frame.frame.camera.fy == 101
    assert np.unique(frame.truth).tolist() == [20, 44]
    assert (frame.kind, frame.background, frame.has_color) == (OBJECTS, (), True)


def test_depth_units_and_invalid_values_come_from_the_meta_data(tmp_path):
    depth = np.full((12, 16), 3000, np.uint16)
    depth[2, 2] = 65535
    meta = {**META, "depth_unit_m": 0.0002, "depth_invalid": 65535}
    frame = load_frame(write_frame(tmp_path / "a", meta, depth=depth)).frame
    assert frame.depth_m[5, 5] == pytest.approx(0.6)
    assert not frame.valid[2, 2]


def test_an_npz_of_whole_numbers_is_millimetres_and_its_largest_number_is_no_depth(tmp_path):
    depth = np.full((12, 16), 1500, np.uint16)
    depth[0, 0], depth[1, 1] = 0, 65535
    np.savez(tmp_path / "a.npz", depth=depth, K=np.array([[100.0, 0, 7.5], [0, 100, 5.5], [0, 0, 1]]))
    frame = load_frame(tmp_path / "a.npz").frame
    assert frame.depth_m[5, 5] == pytest.approx(1.5)
    assert not frame.valid[0, 0] and not frame.valid[1, 1] and frame.valid.sum() == 12 * 16 - 2


def test_truth_of_mosd_knows_its_table(tmp_path):
    labels = np.full((12, 16), 20, np.uint8)
    meta = {**META, "source": "github PointCloudLibrary/data@5c26bdd segmentation/mOSD/learn/learn2.pcd"}
    assert load_frame(write_frame(tmp_path / "a", meta, labels=labels)).background == tuple(range(1, 10))
    meta = {**META, "background_labels": [4], "truth_kind": "regions"}
    frame = load_frame(write_frame(tmp_path / "b", meta, labels=labels))
    assert frame.background == (4,)
    assert frame.kind == REGIONS
    short = load_frame(write_frame(tmp_path / "c", {**META, "truth": "regions"}, labels=labels))
    assert short.kind == REGIONS, "the short name of the same key"


def test_without_colour_and_truth_the_frame_is_grey_and_says_so(tmp_path):
    frame = load_frame(write_frame(tmp_path / "a", color=False))
    assert (frame.frame.color == PLAIN_GREY).all()
    assert not frame.has_color
    assert frame.truth is None


def test_npz_files_with_points_or_depth(tmp_path):
    rng = np.random.default_rng(0)
    points = rng.uniform(1, 2, (8, 9, 3)).astype(np.float32)
    color = rng.integers(0, 255, (8, 9, 3)).astype(np.uint8)
    labels = np.ones((8, 9), np.int64)
    k = np.array([[50, 0, 4], [0, 51, 3.5], [0, 0, 1.0]])
    np.savez(tmp_path / "p.npz", points=points, color=color, labels=labels)
    frame = load_frame(tmp_path / "p.npz")
    assert (frame.frame.points == points).all()
    assert frame.frame.camera is None
    assert (frame.kind, frame.truth.dtype) == (REGIONS, np.int32)
    np.savez(tmp_path / "d.npz", depth=np.full((8, 9), 2.0), color=color, K=k)
    frame = load_frame(tmp_path / "d.npz")
    assert (frame.frame.camera.fy, frame.frame.camera.cx) == (51, 4)
    assert frame.frame.points[2, 3] == pytest.approx([(3 - 4) / 50 * 2, (2 - 3.5) / 51 * 2, 2.0])


def test_synpeb_becomes_an_optical_frame_with_planes_from_ten(tmp_path):
    xyz = np.zeros((6, 7, 3), np.float32)
    xyz[..., 0], xyz[..., 1], xyz[..., 2] = 3.0, 0.5, -0.25  # ahead, left, up
    labels = np.full((6, 7), 12, np.uint8)
    labels[0] = 3
    np.savez(tmp_path / "test_1.npz", xyz=xyz, labels=labels)
    frame = load_frame(tmp_path / "test_1.npz")
    assert frame.frame.points[2, 2].tolist() == [-0.5, 0.25, 3.0]
    assert np.unique(frame.truth).tolist() == [0, 12]
    assert not frame.has_color


def test_frames_are_found_by_name_at_any_depth(tmp_path):
    write_frame(tmp_path / "mosd_b")
    write_frame(tmp_path / "mosd_a")
    write_frame(tmp_path / "deep" / "er" / "c")
    np.savez(tmp_path / "deep" / "x.npz", points=np.ones((4, 4, 3)))
    (tmp_path / "bag").mkdir()
    names = [name for name, _ in find_frames(tmp_path)]
    assert names == ["deep/er/c", "deep/x", "mosd_a", "mosd_b"]
    assert [name for name, _ in find_frames(tmp_path, "mosd_*")] == ["mosd_a", "mosd_b"]
    assert [name for name, _ in find_frames(tmp_path, "deep/*")] == ["deep/er/c", "deep/x"]
    assert [frame.name for frame in load_frames(tmp_path / "mosd_a")] == ["mosd_a"]
    assert [frame.name for frame in load_frames(tmp_path / "deep" / "x.npz")] == ["x"]


def spoilt(tmp_path, what):
    """A data set with one thing wrong."""
    folder = write_frame(tmp_path / "f", labels=np.ones((12, 16), np.uint8))
    if what == "no depth":
        (folder / "depth.png").unlink()
    elif what == "truncated depth":
        data = (folder / "depth.png").read_bytes()
        (folder / "depth.png").write_bytes(data[:20])
    elif what == "8-bit depth":
        cv2.imwrite(str(folder / "depth.png"), np.ones((12, 16), np.uint8))
    elif what == "other colour":
        cv2.imwrite(str(folder / "rgb.png"), np.ones((6, 8, 3), np.uint8))
    elif what == "other labels":
        cv2.imwrite(str(folder / "labels.png"), np.ones((6, 8), np.uint8))
    elif what == "no json":
        (folder / "meta.json").write_text("{oops")
    elif what == "no fx":
        (folder / "meta.json").write_text(json.dumps({**META, "fx": None}))
    elif what == "bad camera":
        (folder / "meta.json").write_text(json.dumps({**META, "fx": -1}))
    elif what == "kind":
        (folder / "meta.json").write_text(json.dumps({**META, "truth_kind": "things"}))
    elif what == "all invalid":
        cv2.imwrite(str(folder / "depth.png"), np.zeros((12, 16), np.uint16))
    return folder


@pytest.mark.parametrize(
    ("what", "text"),
    [
        ("no depth", "depth.png: cannot be read (No such file"),
        ("truncated depth", "depth.png: is no readable image"),
        ("8-bit depth", "16-bit image of one channel, got shape (12, 16), uint8"),
        ("other colour", "depth.png is (12, 16) and rgb.png is (6, 8)"),
        ("other labels", "labels of shape (12, 16)"),
        ("no json", "meta.json: is no valid JSON"),
        ("no fx", "fx must be a number, got None"),
        ("bad camera", "fx and fy must be positive"),
        ("kind", "truth_kind must be 'objects' or 'regions', got 'things'"),
        ("all invalid", "no valid pixel"),
    ],
)
def test_a_spoilt_frame_is_one_clear_line_with_its_path(tmp_path, what, text):
    folder = spoilt(tmp_path, what)
    with pytest.raises(InputError) as error:
        load_frame(folder)
    assert text in str(error.value)
    assert str(folder) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("arrays", "text"),
    [
        ({"cloud": np.ones((4, 4, 3))}, "found cloud"),
        ({"points": np.ones((4, 4))}, "shape (H, W, 3), got (4, 4)"),
        ({"depth": np.ones((4, 4))}, "needs the camera matrix K"),
        ({"points": np.ones((4, 4, 3)), "K": np.ones(4)}, "K of shape (3, 3)"),
        ({"points": np.ones((4, 4, 3)), "labels": np.ones((4, 4))}, "integer labels"),
        ({"points": np.ones((4, 4, 3)), "color": np.ones((4, 4, 3))}, "expected uint8 RGB"),
    ],
)
def test_a_spoilt_npz_is_one_clear_line_with_its_path(tmp_path, arrays, text):
    path = tmp_path / "x.npz"
    np.savez(path, **arrays)
    with pytest.raises(InputError) as error:
        load_frame(path)
    assert text in str(error.value)
    assert str(path) in str(error.value)


def test_a_truncated_npz_is_said(tmp_path):
    path = tmp_path / "x.npz"
    np.savez(path, points=np.ones((40, 40, 3)))
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(InputError, match=r"x\.npz: not an \.npz archive of arrays"):
        load_frame(path)


def test_paths_without_frames_are_said(tmp_path):
    with pytest.raises(InputError, match="no such file or folder"):
        find_frames(tmp_path / "nowhere")
    with pytest.raises(InputError, match="no frame here"):
        find_frames(tmp_path)
    (tmp_path / "x.txt").write_text("x")
    with pytest.raises(InputError, match=r"expected a frame folder .* or an \.npz"):
        load_frame(tmp_path / "x.txt")
    write_frame(tmp_path / "a")
    with pytest.raises(InputError, match="no frame matches 'q\\*'; there are a"):
        find_frames(tmp_path, "q*")


def test_shared_data_are_read(shared_data):
    frames = list(load_frames(shared_data, "mosd_*"))
    assert len(frames) >= 10
    for frame in frames:
        assert frame.kind == OBJECTS
        assert (frame.truth > 0).sum() == frame.frame.valid.sum()
        assert set(np.unique(frame.truth)) & set(frame.background)
