"""Folders of mixed content: frames, .npz files and recordings, as one list of sources."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import zstandard
from recordings import COLOR, depth_entries, head, write_mcap, write_sqlite

from rcseg_core.datasets import REGIONS
from rcseg_core.errors import InputError
from rcseg_ros.recordings.recorded import find_sources, group_of, read_recording

BAGS = Path(__file__).resolve().parents[2] / "bags"


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mixed")
    shutil.copytree(BAGS / "tabletop", folder / "recordings" / "tabletop")
    shutil.copy(BAGS / "motorcycle" / "motorcycle.mcap", folder / "alone.mcap")
    np.savez(folder / "plane_1.npz", points=np.ones((8, 9, 3), np.float32))
    (folder / "notes.txt").write_text("nothing")
    return folder


def test_a_mixed_folder_is_one_list(mixed):
    found = [(source.name, source.frames) for source in find_sources(mixed)]
    assert found == [("alone", 1), ("plane_1", 1), ("recordings/tabletop", 12)]
    frames = [frame for source in find_sources(mixed) for frame in source.read()]
    assert [frame.name for frame in frames][:4] == [
        "alone/0",
        "plane_1",
        "recordings/tabletop/0",
        "recordings/tabletop/1",
    ]
    assert len(frames) == 14
    assert frames[0].truth is None and frames[0].frame.camera is not None


def test_a_recording_brings_the_truth_of_both_levels():
    first = next(read_recording(BAGS / "tabletop", "tabletop"))
    assert first.kind == REGIONS
    regions, surfaces = first.truth_of("regions"), first.truth_of("surfaces")
    assert regions.shape == surfaces.shape == (first.frame.height, first.frame.width)
    pairs = {(int(r), int(s)) for r, s in zip(regions.ravel(), surfaces.ravel(), strict=True) if r}
    assert len(pairs) == len({r for r, _ in pairs}), "a region lies on one surface"
    assert len({s for _, s in pairs}) < len(pairs), "some surface has two colours"


def test_patterns_take_recordings_whole_or_by_frame(mixed):
    assert [(s.name, s.frames) for s in find_sources(mixed, "tabletop")] == [("recordings/tabletop", 12)]
    (source,) = find_sources(mixed, "recordings/tabletop/1*")
    assert source.frames == 3
    assert [frame.name.rpartition("/")[2] for frame in source.read()] == ["1", "10", "11"]
    with pytest.raises(InputError, match=r"no frame matches 'q\*'; there are alone, plane_1, recordings/tab"):
        find_sources(mixed, "q*")


@pytest.mark.parametrize("part", ["recordings/tabletop", "alone.mcap", "plane_1.npz"])
def test_one_source_alone(mixed, part):
    (source,) = find_sources(mixed / part)
    assert source.name == Path(part).stem


def test_an_empty_folder_and_a_broken_recording_are_one_clear_line(tmp_path):
    with pytest.raises(InputError, match="no such file or folder"):
        find_sources(tmp_path / "nowhere")
    with pytest.raises(InputError, match="no frame here"):
        find_sources(tmp_path)
    (tmp_path / "x.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(50))
    with pytest.raises(InputError, match=r"x\.mcap"):
        find_sources(tmp_path)


def test_a_damaged_recording_gives_what_comes_before_the_damage(tmp_path):
    data = (BAGS / "tabletop" / "tabletop.mcap").read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[: int(0.7 * len(data))])
    frames = read_recording(path, "cut")
    assert next(frames).name == "cut/0"
    with pytest.raises(InputError, match="damaged"):
        list(frames)


def test_sqlite3_and_packed_recordings_are_found_by_their_own_path_and_in_folders(tmp_path):
    (file,) = write_sqlite(tmp_path / "bag", depth_entries(2)).glob("*.db3")
    data = tmp_path / "data"
    data.mkdir()
    file = file.rename(data / "one.db3")
    plain = write_mcap(tmp_path / "two.mcap", depth_entries(3))
    (data / "two.mcap.zstd").write_bytes(zstandard.ZstdCompressor().compress(plain.read_bytes()))
    assert [(s.name, s.frames) for s in find_sources(data)] == [("one", 2), ("two", 3)]
    (source,) = find_sources(file)
    assert [frame.name for frame in source.read()] == ["one/0", "one/1"]


def test_a_recording_whose_stamps_never_meet_is_told_not_left_out(tmp_path):
    entries = depth_entries(3)
    for entry in entries:
        if entry.topic == COLOR:
            entry.message.header = head(entry.log_ns + 45_000_000)
    (source,) = find_sources(write_mcap(tmp_path / "apart.mcap", entries))
    with pytest.raises(InputError, match=r"apart\.mcap: no frame: .* 45 ms after the range stamp, steadily"):
        list(source.read())


def test_a_ros1_bag_in_place_of_data_is_named_as_such(tmp_path):
    path = tmp_path / "old.bag"
    path.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    with pytest.raises(InputError, match="ROS 1 bag; convert it"):
        find_sources(path)


@pytest.mark.parametrize(
    ("name", "group"),
    [
        ("mosd_learn12", "mosd"),
        ("synpeb/test_500", "synpeb"),
        ("bag/3", "bag"),
        ("planes", "planes"),
        ("7", "7"),
    ],
)
def test_frames_are_pooled_by_their_data_set(name, group):
    assert group_of(name) == group
