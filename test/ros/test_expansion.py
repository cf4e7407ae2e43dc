"""What claims to unpack to gigabytes is refused before they are allocated; bombs that keep their word too."""

from __future__ import annotations

import io
import resource
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import cv2
import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, Writer
from recordings import DEPTH, depth_entries, head, write_folder, write_mcap

from rcseg_ros.cli import main
from rcseg_ros.frames import expansion
from rcseg_ros.frames.conversions import MessageError, decode_cloud, decode_depth, decode_image
from rcseg_ros.frames.expansion import (
    ExpansionError,
    allowed_bytes,
    check_expansion,
    claimed_pixels,
    unpack_zstd,
)
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.result_bag import make_message

GIB = 1 << 30


@pytest.fixture
def bounded():
    """Address space for this test alone: half a gigabyte more than is in use."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + GIB // 2, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def _png(width, height, data=b"", depth=8, color=0):
    """A PNG that claims a size, with a body of compressed bytes."""

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    start = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", start) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def _compressed(data, form):
    return make_message(
        "sensor_msgs/msg/CompressedImage", header=head(0), format=form, data=np.frombuffer(data, np.uint8)
    )


def _frame(data):
    return zstandard.ZstdCompressor().compress(data)


def _zeros(size):
    """A zstd frame of so many zeros, made without them."""
    compressor, block = zstandard.ZstdCompressor().compressobj(size=size), bytes(1 << 20)
    return b"".join(compressor.compress(block) for _ in range(size >> 20)) + compressor.flush()


def test_the_bound_follows_from_the_size():
    assert allowed_bytes(0) == 256 << 20
    assert allowed_bytes(10_000_000) - allowed_bytes(0) == 10_240_000_000
    check_expansion(allowed_bytes(7), 7)
    with pytest.raises(ExpansionError, match="7 bytes claim to unpack to"):
        check_expansion(allowed_bytes(7) + 1, 7)


@pytest.mark.parametrize("form", [".png", ".jpg"])
@pytest.mark.parametrize("shape", [(3, 5), (480, 640, 3), (1, 2000)])
def test_pixels_of_pictures_are_those_of_their_heads(form, shape):
    done, data = cv2.imencode(form, np.zeros(shape, np.uint8))
    assert done and claimed_pixels(data.tobytes()) == shape[0] * shape[1]
    for cut in range(24):
        assert claimed_pixels(data.tobytes()[:cut]) in (0, shape[0] * shape[1])


def test_pictures_of_gigabytes(bounded):
    row = zlib.compressobj(9)
    body = row.compress(bytes(20_001 * 100)) + row.flush()
    for data in (_png(20_000, 20_000, body), _png(2**31 - 1, 2**31 - 1), _png(1, 2**31 - 1)):
        with pytest.raises(MessageError) as refusal:
            decode_image(_compressed(data, "rgb8; png compressed rgb8"))
        assert refusal.value.reason == "too_large"
        with pytest.raises(MessageError) as refusal:
            decode_depth(_compressed(bytes(12) + data, "16UC1; compressedDepth png"))
        assert refusal.value.reason == "too_large"


def test_depth_of_gigabytes_in_rvl(bounded):
    for width, height in ((16_384, 16_384), (2**31, 2**31), (1, 2**32 - 1)):
        body = bytes(12) + struct.pack("<II", width, height) + b"\x77\x77\x77\x0f"
        with pytest.raises(MessageError) as refusal:
            decode_depth(_compressed(body, "16UC1; compressedDepth rvl"))
        assert refusal.value.reason == "too_large"


def test_a_frame_of_any_camera_is_taken():
    """4000 x 3000 of one depth: a few kilobytes."""
    done, data = cv2.imencode(".png", np.full((3000, 4000), 1000, np.uint16))
    depth_m = decode_depth(_compressed(bytes(12) + data.tobytes(), "16UC1; compressedDepth png"))
    assert done and depth_m.shape == (3000, 4000) and (depth_m == 1).all()


@pytest.mark.parametrize("claims", [True, False])
def test_zstd_that_unpacks_to_gigabytes(bounded, monkeypatch, claims):
    monkeypatch.setattr(expansion, "FLOOR", 1 << 20)
    bomb = zstandard.ZstdCompressor(
        compression_params=zstandard.ZstdCompressionParameters.from_level(3, write_content_size=claims)
    ).compress(bytes(64 << 20))
    assert len(bomb) < 10_000
    with pytest.raises(ExpansionError):
        unpack_zstd(bomb)
    two = _frame(b"a") + _frame(bytes(64 << 20))
    with pytest.raises(ExpansionError):
        unpack_zstd(two)
    assert unpack_zstd(_frame(b"a") + _frame(b"bc")) == b"abc"


def test_clouds_and_images_of_impossible_sizes(bounded):
    field = make_message("sensor_msgs/msg/PointField", name="x", offset=0, datatype=7, count=1)
    for height, width, step in ((2**31, 2**31, 16), (1, 2**31, 16), (2**32 - 1, 1, 2**32 - 1), (1, 2**31, 0)):
        cloud = make_message(
            "sensor_msgs/msg/PointCloud2", header=head(0), height=height, width=width, fields=[field] * 3,
            is_bigendian=False, point_step=step, row_step=0, data=np.zeros(200, np.uint8), is_dense=True,
        )  # fmt: skip
        image = make_message(
            "sensor_msgs/msg/Image", header=head(0), height=height, width=width, encoding="rgb8",
            is_bigendian=0, step=step, data=np.zeros(200, np.uint8),
        )  # fmt: skip
        for decode, message in ((decode_cloud, cloud), (decode_image, image)):
            with pytest.raises(MessageError):
                decode(message)


def _bomb_mcap(path, compression, claimed=None, size=3 << 28):
    """A recording with good frames, then a chunk that unpacks to gigabytes, or only claims to."""
    write_mcap(path, depth_entries(2), "none", chunk_size=1)
    data = path.read_bytes()
    end = data.rindex(b"\x0f" + struct.pack("<Q", 4))  # DataEnd: the chunk comes before it, the index goes
    pack = {"zstd": _frame, "lz4": lz4.frame.compress, "": bytes}[compression]
    content = pack(bytes(size)) if size < GIB else _zeros(size)
    name = compression.encode()
    body = struct.pack("<QQQI", 0, 0, claimed or size, 0) + struct.pack("<I", len(name)) + name
    body += struct.pack("<Q", len(content)) + content
    path.write_bytes(data[:end] + b"\x06" + struct.pack("<Q", len(body)) + body)
    return path


@pytest.fixture
def bomb_file(tmp_path, request):
    """Made before the memory is bounded."""
    return _bomb_mcap(tmp_path / "bomb.mcap", *request.param)


BOMBS = [
    ("zstd", None, 4 * GIB),
    ("zstd", 100, 4 * GIB),
    ("zstd", 2**62, 10),
    ("lz4", 2**62, 10),
    ("", 2**40, 10),
]


@pytest.mark.parametrize("bomb_file", BOMBS, indirect=True)
def test_chunks_that_unpack_to_gigabytes(bomb_file, bounded):
    with Recording(bomb_file) as recording:
        assert len(list(recording.messages([DEPTH]))) == 2, "the frames before it"
        assert any("claim to unpack" in damage for damage in recording.damage), recording.damage


@pytest.fixture
def indexed_bomb(tmp_path):
    """A recording as a library writes it, with an index, of one message of 768 MB."""
    path = tmp_path / "bomb.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, 1 << 20, CompressionType.ZSTD)
        writer.start("ros2", "test")
        schema = writer.register_schema("std_msgs/msg/Empty", "ros2msg", b"")
        channel = writer.register_channel("/empty", "cdr", schema)
        writer.add_message(channel, 0, bytes(3 << 28), 0)
        writer.finish()
    assert path.stat().st_size < 200_000
    return path


def test_a_chunk_of_an_index_that_unpacks_to_gigabytes(indexed_bomb, bounded, tmp_path, capsys):
    assert main(["inspect", str(indexed_bomb)]) == 2
    assert "claim to unpack" in capsys.readouterr().err


def test_a_file_that_was_compressed_as_a_whole(tmp_path, monkeypatch):
    monkeypatch.setattr(expansion, "FLOOR", 1 << 20)
    folder = write_folder(tmp_path / "in", depth_entries(2))
    data = next(folder.glob("*.mcap")).read_bytes()
    packed = tmp_path / "packed.mcap.zstd"
    packed.write_bytes(_frame(data) + _zeros(200 << 20))
    with Recording(packed) as recording:
        assert any("more than its size allows" in damage for damage in recording.damage), recording.damage


PROGRAM = """
import resource, sys
from rcseg_ros.cli import main
main(["config"])  # all that is loaded
used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 29),) * 2)
sys.exit(main(sys.argv[1:]))
"""


def _npz_that_claims(path, shape):
    """An archive whose array has a header of terabytes, and ten bytes."""
    import zipfile

    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("points.npy", head.getvalue() + bytes(10))
        archive.writestr("color.npy", head.getvalue() + bytes(10))
    return path


BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{new}: &{new} [{','.join([f'*{old}'] * 9)}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize("kind", ["npz", "npz negative", "config", "metadata"])
def test_files_that_claim_or_expand_are_one_line(tmp_path, kind):
    if kind.startswith("npz"):
        shape = (2**40, 3) if kind == "npz" else (-1, 2**62)
        arguments = ["segment", _npz_that_claims(tmp_path / "bomb.npz", shape), "-o", tmp_path / "out"]
    elif kind == "config":
        (tmp_path / "bomb.yaml").write_text(BOMB + "grouping: *i\nnoise: {range_model: *i}\n")
        arguments = ["config", "--config", tmp_path / "bomb.yaml"]
    else:
        folder = write_folder(tmp_path / "in", depth_entries(1))
        (folder / "metadata.yaml").write_text(
            BOMB + "rosbag2_bagfile_information: {relative_file_paths: *i, message_count: *i}\n"
        )
        arguments = ["inspect", folder]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *map(str, arguments)], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("rcseg: ") and done.stderr.count("\n") == 1, done.stderr
    assert len(done.stderr) < 2000


def test_pixels_of_a_picture_after_long_segments():
    done, data = cv2.imencode(".jpg", np.zeros((30, 40), np.uint8))
    picture = data.tobytes()
    exif = b"\xff\xe1" + (700).to_bytes(2, "big") + bytes(698)
    assert done and claimed_pixels(picture[:2] + exif + picture[2:]) == 30 * 40
