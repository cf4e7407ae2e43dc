"""Recordings as recorders, players and users leave them: every message comes out in the order of time, or the
loss is told.
"""

import json
import shutil
import sqlite3
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from recordings import (
    COLOR,
    DEPTH,
    HEIGHT,
    INFO,
    WIDTH,
    depth_entries,
    scene,
    write_folder,
    write_mcap,
    write_sqlite,
)
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

from rcseg_core import InputError
from rcseg_ros.cli import main
from rcseg_ros.frames.conversions import decode_camera_info
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.result_bag import definition_text, result_types, serialize
from rcseg_ros.recordings.storage import RawMessage
from rcseg_ros.recordings.topics import find_topics


def read(path):
    """Messages as (topic, log time, bytes), the damage and the warnings."""
    with Recording(path) as recording:
        found = [(raw.topic, raw.log_ns, bytes(raw.data)) for raw in recording.messages(recording.topics)]
        return found, recording.damage, recording.warnings


def expected(entries):
    """The same of entries, in the order of time; those of one time in the order of writing."""
    ordered = sorted(entries, key=lambda entry: entry.log_ns)
    return [(e.topic, e.log_ns, bytes(serialize(e.message))) for e in ordered]


def contents_of(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def leave_log(folder, committed, name="bag_0.db3"):
    """An sqlite3 file of `committed` frames and a log with more, as a recorder that is killed leaves them."""
    entries = depth_entries(4)
    whole = write_sqlite(folder / "whole", entries)
    live = folder / "live.db3"
    shutil.copy(next(whole.glob("*.db3")), live)
    base = sqlite3.connect(live)
    rows = base.execute("SELECT * FROM messages ORDER BY id").fetchall()
    base.execute("DELETE FROM messages")
    base.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows[: 3 * committed])
    base.commit()
    base.execute("PRAGMA journal_mode = WAL")
    base.execute("PRAGMA wal_autocheckpoint = 0")
    base.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows[3 * committed :])
    base.commit()
    bag = folder / "bag"
    bag.mkdir()
    for ending in ("", "-wal", "-shm"):  # copied while it is open: closing would write the log into the file
        shutil.copy(f"{live}{ending}", bag / f"{name}{ending}")
    base.close()
    return bag, entries


@pytest.mark.parametrize("committed", [0, 2])
@pytest.mark.parametrize("own_path", [False, True])
def test_frames_in_the_log_of_a_killed_recorder(committed, own_path, tmp_path):
    bag, entries = leave_log(tmp_path, committed)
    before = contents_of(bag)
    found, damage, _ = read(bag / "bag_0.db3" if own_path else bag)
    assert found == expected(entries) and damage == []
    assert contents_of(bag) == before


def test_the_log_beside_the_file_that_a_link_leads_to(tmp_path):
    bag, entries = leave_log(tmp_path, 2)
    link = tmp_path / "link.db3"
    link.symlink_to(bag / "bag_0.db3")
    assert read(link) == (expected(entries), [], [])


def test_a_transaction_that_was_cut_off_is_taken_back(tmp_path):
    """The rows that were being written when the recorder died, with the journal that undoes them."""
    (file,) = write_sqlite(tmp_path / "bag", depth_entries(2)).glob("*.db3")
    base = sqlite3.connect(file, isolation_level=None)
    base.execute("PRAGMA cache_size = 1")  # so that half a transaction reaches the file
    base.execute("BEGIN")
    base.execute("UPDATE messages SET data = zeroblob(length(data))")
    copy = tmp_path / "copy"
    copy.mkdir()
    for path in (file, file.with_name(file.name + "-journal")):
        shutil.copy(path, copy / path.name)
    base.execute("ROLLBACK")
    base.close()
    assert (copy / file.name).read_bytes() != file.read_bytes()
    assert read(copy)[0] == expected(depth_entries(2))


@pytest.mark.parametrize("writer", [write_mcap, write_sqlite])
def test_split_files_without_metadata_come_in_the_order_of_time(writer, tmp_path):
    entries = depth_entries(12)
    bag = tmp_path / "bag"
    bag.mkdir()
    for i in range(12):
        if writer is write_mcap:
            write_mcap(bag / f"bag_{i}.mcap", entries[3 * i : 3 * i + 3])
        else:
            (file,) = write_sqlite(tmp_path / f"part{i}", entries[3 * i : 3 * i + 3]).glob("*.db3")
            shutil.move(file, bag / f"bag_{i}.db3")
    found, damage, warnings = read(bag)
    assert found == expected(entries) and damage == []
    assert len(warnings) == 1 and "no metadata.yaml" in warnings[0]


def test_files_that_overlap_in_time_are_merged(tmp_path):
    """Two recorders side by side, a topic each; names say nothing of time."""
    entries = depth_entries(5)
    bag = tmp_path / "bag"
    bag.mkdir()
    for name, topic in (("c", INFO), ("a", DEPTH), ("b", COLOR)):
        write_mcap(bag / f"{name}.mcap", [e for e in entries if e.topic == topic], chunk_size=1)
    found, _, _ = read(bag)
    assert sorted(found) == sorted(expected(entries))
    times = [log_ns for _, log_ns, _ in found]
    assert times == sorted(times)


@pytest.mark.parametrize("kind", ["indexed", "no chunks", "no summary", "sqlite3", "cut"])
def test_messages_that_were_written_out_of_order_come_in_the_order_of_time(kind, tmp_path):
    entries = depth_entries(8)
    shuffled = [entries[i] for i in np.random.default_rng(5).permutation(len(entries))]
    if kind == "sqlite3":
        path = write_sqlite(tmp_path / "bag", shuffled)
    else:
        options = {"no chunks": {"use_chunking": False}, "no summary": {
            "use_statistics": False, "use_summary_offsets": False, "repeat_schemas": False,
            "repeat_channels": False}}.get(kind, {})  # fmt: skip
        path = write_mcap(tmp_path / "bag.mcap", shuffled, **options)
    if kind == "cut":
        path.write_bytes(path.read_bytes()[:-100])
    found, _, _ = read(path)
    assert found == expected(shuffled)


def test_changed_bytes_in_a_chunk_are_noticed_by_its_crc(tmp_path):
    entries = depth_entries(6)
    path = write_mcap(tmp_path / "bag.mcap", entries, "none")
    data = bytearray(path.read_bytes())
    pixels = bytes(entries[10].message.data[-200:])  # the fourth depth image
    data[data.index(pixels) + 50] ^= 1
    path.write_bytes(data)
    with Recording(path) as recording:
        assert recording.damage == []  # its index is whole: this is the indexed road
        found = list(recording.messages(recording.topics))
        assert 0 < len(found) < 18 and "crc" in recording.damage[0].lower()
        assert f"{18 - len(found)} messages" in recording.damage[0]


def test_changed_bytes_are_noticed_by_the_crc_of_the_whole_where_chunks_have_none(tmp_path):
    entries = depth_entries(4)
    path = write_mcap(tmp_path / "bag.mcap", entries, "none", enable_crcs=False, enable_data_crcs=True)
    assert read(path) == (expected(entries), [], [])
    data = bytearray(path.read_bytes())
    data[data.index(bytes(entries[7].message.data[-200:])) + 50] ^= 1
    path.write_bytes(data)
    found, damage, _ = read(path)
    assert len(found) == 12 and found != expected(entries)
    assert damage == [f"{path}: bytes have changed: the CRC of its data is not the recorded one"]


def test_changed_bytes_in_the_index_are_noticed_by_its_crc(tmp_path):
    entries = depth_entries(2)
    path = write_mcap(tmp_path / "bag.mcap", entries)
    data = bytearray(path.read_bytes())
    data[data.rindex(COLOR.encode()) + 8] ^= 1  # the topic in the summary
    path.write_bytes(data)
    found, damage, _ = read(path)
    assert found == expected(entries) and "index" in damage[0]


def test_an_index_that_leaves_chunks_out_is_not_trusted(tmp_path):
    """Its chunk indices are removed, its CRC is none: only the count of chunks shows it."""
    entries = depth_entries(6)
    path = write_mcap(tmp_path / "bag.mcap", entries, enable_crcs=False)
    data = path.read_bytes()
    with path.open("rb") as stream:
        last = make_reader(stream).get_summary().chunk_indexes[-1]
    at = data.index(
        struct.pack("<BQ", 8, 0)[:1], data.rindex(struct.pack("<Q", last.chunk_start_offset)) - 25
    )
    length = struct.unpack_from("<Q", data, at + 1)[0] + 9
    summary_start = struct.unpack_from("<Q", data, len(data) - 28)[0]
    assert summary_start < at
    path.write_bytes(data[:at] + data[at + length :])
    found, _, _ = read(path)
    assert found == expected(entries)


def test_names_in_metadata_that_the_files_no_longer_have(tmp_path, capfd):
    bag = write_folder(tmp_path / "bag", depth_entries(2))
    (bag / "bag.mcap").rename(bag / "drive.mcap")
    found, damage, warnings = read(bag)
    assert found == expected(depth_entries(2)) and damage == []
    assert warnings == [f"{bag}: metadata.yaml names bag.mcap; drive.mcap read instead"]
    assert main(["replay", str(bag), "-o", str(tmp_path / "out")]) == 0
    assert "warning" in capfd.readouterr().err
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["warnings"] == warnings


def test_a_folder_without_metadata_is_replayed_with_a_warning(tmp_path, capfd):
    bag = write_sqlite(tmp_path / "bag", depth_entries(2))
    (bag / "metadata.yaml").unlink()
    assert main(["replay", str(bag), "-o", str(tmp_path / "out")]) == 0
    assert "rcseg: warning: " in (error := capfd.readouterr().err) and "no metadata.yaml" in error


@pytest.mark.parametrize("text", ["", "nonsense", "a: [", "rosbag2_bagfile_information: {version: 99}"])
def test_metadata_that_cannot_be_used(text, tmp_path):
    bag = write_folder(tmp_path / "bag", depth_entries(1))
    (bag / "metadata.yaml").write_text(text)
    found, damage, warnings = read(bag)
    assert found == expected(depth_entries(1)) and damage == []
    assert len(warnings) == 1 and "metadata.yaml cannot be used" in warnings[0] and "\n" not in warnings[0]


def test_a_part_that_metadata_names_and_nobody_has_is_a_loss(tmp_path):
    bag = write_folder(tmp_path / "bag", depth_entries(2))
    file = bag / "metadata.yaml"
    about = yaml.safe_load(file.read_text())
    about["rosbag2_bagfile_information"]["relative_file_paths"].append("bag_1.mcap")
    about["rosbag2_bagfile_information"]["message_count"] = 9
    file.write_text(yaml.safe_dump(about))
    found, damage, _ = read(bag)
    assert len(found) == 6
    assert damage == [f"{bag}: bag_1.mcap of metadata.yaml not here, nor 3 of its 9 messages"]


def test_a_part_that_metadata_does_not_know_yet_is_read_too(tmp_path):
    """A recorder that was killed after a split: metadata.yaml is as old as the split."""
    entries = depth_entries(4)
    bag = write_folder(tmp_path / "bag", entries[:6])
    write_mcap(bag / "bag_1.mcap", entries[6:])
    found, damage, warnings = read(bag)
    assert found == expected(entries) and damage == [] and "bag_1.mcap" in warnings[0]


def test_one_unreadable_part_does_not_hide_the_others(tmp_path):
    entries = depth_entries(4)
    bag = tmp_path / "bag"
    bag.mkdir()
    write_mcap(bag / "bag_0.mcap", entries[:6])
    (bag / "bag_1.mcap").write_bytes(b"\x89MCAP0\r\n")
    write_mcap(bag / "bag_2.mcap", entries[6:])
    found, damage, _ = read(bag)
    assert found == expected(entries) and len(damage) == 1 and "bag_1.mcap" in damage[0]


def test_a_log_whose_file_was_renamed_is_a_loss(tmp_path):
    bag, entries = leave_log(tmp_path, 2)
    (bag / "bag_0.db3").rename(bag / "drive.db3")
    found, damage, _ = read(bag)
    assert found == expected(entries)[:6]
    assert damage == [f"{bag}: no file for bag_0.db3-wal, so that its messages are missing"]


def test_a_folder_of_recordings_is_refused_with_their_names(tmp_path):
    for name in ("one", "two"):
        write_folder(tmp_path / name, depth_entries(1))
    with pytest.raises(InputError, match="give one of the recordings in it: one, two"):
        Recording(tmp_path)


@pytest.mark.parametrize("name", ["a b#c?d%20.db3", "bag_0.db3"])
def test_sqlite3_by_its_own_path(name, tmp_path):
    (file,) = write_sqlite(tmp_path / "bag", depth_entries(2)).glob("*.db3")
    path = file.rename(tmp_path / name)
    assert read(path) == (expected(depth_entries(2)), [], [])


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
@pytest.mark.parametrize("with_metadata", [True, False])
def test_compression_of_files_and_of_messages(storage, mode, with_metadata, tmp_path):
    entries = depth_entries(2)
    bag = tmp_path / "bag"
    writer = Rosbag2Writer(bag, version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for e in entries:
            if e.topic not in connections:
                connections[e.topic] = writer.add_connection(
                    e.topic, e.message.__msgtype__, typestore=result_types()
                )
            writer.write(connections[e.topic], e.log_ns, serialize(e.message))
    if not with_metadata:
        (bag / "metadata.yaml").unlink()
    (file,) = (file for file in bag.iterdir() if file.name != "metadata.yaml")
    assert file.name.endswith(".zstd") == (mode == CompressionMode.FILE)
    found, damage, warnings = read(bag)
    assert found == expected(entries) and damage == [] and len(warnings) == (not with_metadata)
    assert read(file) == (expected(entries), [], [])


def test_a_compressed_file_that_was_cut(tmp_path):
    entries = depth_entries(40)
    path = write_mcap(tmp_path / "whole.mcap", entries, "none")
    packed = zstandard.ZstdCompressor().compress(path.read_bytes())
    file = tmp_path / "bag_0.mcap.zstd"
    file.write_bytes(packed[: len(packed) // 2])
    found, damage, _ = read(file)
    assert 3 <= len(found) < len(entries) and found == expected(entries)[: len(found)]
    assert damage and str(file) in damage[0]


@pytest.mark.parametrize("with_metadata", [True, False])
def test_a_file_beside_its_packed_double_is_read_once(with_metadata, tmp_path):
    """With metadata the packed one is whole, and a player unpacked it; without, a recorder was packing it."""
    entries = depth_entries(2)
    bag = write_folder(tmp_path / "bag", entries)
    plain, packed = bag / "bag.mcap", bag / "bag.mcap.zstd"
    packed.write_bytes(zstandard.ZstdCompressor().compress(plain.read_bytes()))
    if with_metadata:
        file = bag / "metadata.yaml"
        file.write_text(file.read_text().replace("bag.mcap", "bag.mcap.zstd"))
        plain.write_bytes(plain.read_bytes()[:1000])
    else:
        (bag / "metadata.yaml").unlink()
        packed.write_bytes(packed.read_bytes()[:1000])
    found, damage, _ = read(bag)
    assert found == expected(entries) and damage == []


def write_with_json(path, entries, **options):
    """An mcap with channels of other encodings beside the wanted ones, one of them under a wanted name."""
    with path.open("wb") as stream:
        writer = Writer(stream, 20_000, CompressionType.ZSTD, **options)
        writer.start(profile="", library="test")
        schema = writer.register_schema("Status", "jsonschema", b'{"type": "object"}')
        others = [writer.register_channel(topic, "json", schema) for topic in ("/status", COLOR)]
        others.append(writer.register_channel("/schemaless", "json", 0))
        channels = {}
        for entry in entries:
            name = entry.message.__msgtype__
            if entry.topic not in channels:
                schema = writer.register_schema(name, "ros2msg", definition_text(name).encode())
                channels[entry.topic] = writer.register_channel(entry.topic, "cdr", schema)
            for other in others:
                writer.add_message(other, entry.log_ns, b'{"ok": true}', entry.log_ns)
            writer.add_message(channels[entry.topic], entry.log_ns, serialize(entry.message), entry.log_ns)
        writer.finish()
    return path


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}], ids=["indexed", "scanned"])
def test_channels_of_another_encoding_are_left_alone(options, tmp_path):
    path = write_with_json(tmp_path / "bag.mcap", depth_entries(2), **options)
    with Recording(path) as recording:
        inputs = find_topics(recording, {})
        assert (inputs.range, inputs.color, inputs.camera_info) == (DEPTH, COLOR, INFO)
        assert recording.topics["/status"].encoding == "json"
        found = [(r.topic, r.log_ns, r.data) for r in recording.messages(inputs.names())]
        assert found == expected(depth_entries(2)) and recording.damage == []
    assert main(["replay", str(path), "-o", str(tmp_path / "out")]) == 0


def test_a_topic_of_another_encoding_cannot_be_named(tmp_path, capfd):
    path = write_with_json(tmp_path / "bag.mcap", depth_entries(1))
    assert main(["replay", str(path), "--topics", "color=/status"]) == 2
    assert "/status (Status, 3, json)" in capfd.readouterr().err


ROS1 = get_typestore(Stores.ROS1_NOETIC)


def write_ros1(path, count=2):
    """The scenes as a ROS 1 bag."""
    types = ROS1.types
    with Rosbag1Writer(path) as bag:
        connections = {
            topic: bag.add_connection(topic, f"sensor_msgs/msg/{kind}", typestore=ROS1)
            for topic, kind in ((DEPTH, "Image"), (COLOR, "Image"), (INFO, "CameraInfo"))
        }
        for i in range(count):
            frame, sec = scene(i), 1_700_000_000 + i
            stamp = types["builtin_interfaces/msg/Time"](sec=sec, nanosec=0)
            header = types["std_msgs/msg/Header"](seq=i, stamp=stamp, frame_id="camera")
            k = frame.camera.matrix().reshape(9)
            roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            depth = np.frombuffer(frame.depth_m.astype(np.float32).tobytes(), np.uint8)
            image = types["sensor_msgs/msg/Image"]
            messages = {
                DEPTH: image(header, HEIGHT, WIDTH, "32FC1", 0, 4 * WIDTH, depth),
                COLOR: image(header, HEIGHT, WIDTH, "rgb8", 0, 3 * WIDTH, frame.color.reshape(-1).copy()),
                INFO: types["sensor_msgs/msg/CameraInfo"](
                    header, HEIGHT, WIDTH, "plumb_bob", np.zeros(5), k, np.eye(3).reshape(9),
                    np.insert(k, [3, 6, 9], 0.0), 0, 0, roi,
                ),
            }  # fmt: skip
            for topic, message in messages.items():
                data = ROS1.serialize_ros1(message, message.__msgtype__)
                bag.write(connections[topic], sec * 10**9, data)
    return path


@pytest.mark.parametrize("in_folder", [False, True])
def test_a_ros1_bag_is_named_with_the_command_that_converts_it(in_folder, tmp_path, capfd, monkeypatch):
    path = write_ros1(tmp_path / "old drive.bag")
    assert main(["replay", str(tmp_path if in_folder else path)]) == 2
    error = capfd.readouterr().err
    assert "a ROS 1 bag" in error
    command = error[error.index("rosbags-convert") :]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=":")
    subprocess.run(command, shell=True, check=True)
    assert main(["replay", "old drive_ros2", "-o", "out"]) == 0
    assert len(json.loads(Path("out/metrics.json").read_text())["frames"]) == 2


def test_camera_info_with_the_names_of_ros1(tmp_path):
    """As converters leave it that keep the definitions: K for k, in the same bytes."""
    path = write_ros1(tmp_path / "old.bag")
    subprocess.run(
        [Path(sys.executable).parent / "rosbags-convert", "--src", path, "--dst", tmp_path / "new"],
        check=True,
    )
    with Recording(tmp_path / "new") as recording:
        camera = decode_camera_info(recording.first(INFO))
    np.testing.assert_allclose(camera.pinhole.matrix(), scene(0).camera.matrix())


def test_an_mcap_of_ros1_messages_is_named_as_such(tmp_path):
    path = tmp_path / "old.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros1", library="test")
        schema = writer.register_schema("sensor_msgs/Image", "ros1msg", b"uint32 height")
        channel = writer.register_channel("/camera/image", "ros1", schema)
        writer.add_message(channel, 5, bytes(40), 5)
        writer.finish()
    with pytest.raises(InputError, match=r"ROS 1 messages.*rosbags-convert --src .*old\.bag"):
        Recording(path)


def test_a_damaged_sqlite3_file_gives_what_comes_before_the_damage(tmp_path):
    entries = depth_entries(20)
    (file,) = write_sqlite(tmp_path / "bag", entries).glob("*.db3")
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * 0.6)])
    found, damage, _ = read(file)
    assert 3 <= len(found) < len(entries) and found == expected(entries)[: len(found)]
    assert damage and all("\n" not in line for line in damage)


@pytest.mark.parametrize("content", [b"", b"rubbish" * 100, b"SQLite format 3\x00" + bytes(4000)])
def test_an_sqlite3_file_with_nothing_to_read_is_refused(content, tmp_path):
    path = tmp_path / "bag.db3"
    path.write_bytes(content)
    with pytest.raises(InputError, match="cannot be read"):
        Recording(path)


@pytest.mark.parametrize(("mark", "order"), [(b"\0\1\0\0", "<"), (b"\0\0\0\0", ">")])
def test_the_stamp_of_a_message_is_that_of_its_header(mark, order):
    def stamped(sec, nanosec):
        return RawMessage("/t", 77, mark + struct.pack(order + "iI", sec, nanosec)).stamp_ns

    assert stamped(3, 5) == 3_000_000_005
    assert stamped(0, 5) == 5
    assert stamped(0, 0) == 77  # the time of recording
    assert RawMessage("/t", 77, mark).stamp_ns == 77


@pytest.mark.parametrize("kind", ["mcap", "sqlite", "cut"])
def test_a_span_holds_its_first_moment_and_not_its_last(kind, tmp_path):
    entries = depth_entries(4)
    path = (write_sqlite if kind == "sqlite" else write_mcap)(tmp_path / "bag.mcap", entries)
    if kind == "cut":  # read without the index
        path.write_bytes(path.read_bytes()[:-8])
    times = sorted({entry.log_ns for entry in entries})
    with Recording(path) as recording:
        found = [raw.log_ns for raw in recording.messages([DEPTH], (times[1], times[3]))]
    assert found == [times[1], times[2]]


def test_topics_of_sqlite3_have_their_definitions(tmp_path):
    with Recording(write_sqlite(tmp_path / "bag", depth_entries(2))) as recording:
        for topic in recording.topics.values():
            assert (topic.count, topic.is_idl, topic.encoding) == (2, False, "cdr")
            assert "std_msgs/Header header" in topic.definition


def test_why_an_unreadable_recording_cannot_be_read(tmp_path):
    path = tmp_path / "bag.db3"
    path.write_bytes(b"rubbish" * 100)
    with pytest.raises(InputError, match=r"cannot be read: readable for 0 messages: \w+"):
        Recording(path)
