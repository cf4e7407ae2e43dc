"""Which topics are taken, in recordings like those of real drivers: by encodings, frames and names."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from recordings import (
    COLOR,
    DEPTH,
    INFO,
    Entry,
    cloud_entries,
    depth_entries,
    info_message,
    scene,
    stamps,
    write_folder,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rcseg_core import InputError, SegmenterConfig
from rcseg_ros.cli import main
from rcseg_ros.commands.replay import ReplayRequest, replay
from rcseg_ros.frames.conversions import Header
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.result_bag import BagWriter, make_message, serialize
from rcseg_ros.recordings.topics import InputTopics, find_topics
from rcseg_ros.results.outputs import cloud_message, depth_message, header_message, picture_message

STAMP = stamps(1)[0]
HEIGHT, WIDTH = 48, 64


def head(frame_id):
    return header_message(Header(STAMP, frame_id), make_message)


def image(topic, encoding, frame_id="optical", size=(HEIGHT, WIDTH)):
    """An image of zeros; its bytes matter to nobody here."""
    sizes = {"16uc1": 2, "mono16": 2, "32fc1": 4, "32sc1": 4, "rgb8": 3, "bgr8": 3, "bgra8": 4}
    channels = sizes.get(encoding.lower(), 1)
    height, width = size
    return Entry(topic, make_message(
        "sensor_msgs/msg/Image", header=head(frame_id), height=height, width=width, encoding=encoding,
        is_bigendian=0, step=width * channels, data=np.zeros(height * width * channels, np.uint8),
    ), STAMP)  # fmt: skip


def compressed(topic, form, picture, frame_id="optical", ahead=b""):
    """A picture as PNG or JPEG file under a format as drivers write it."""
    suffix = ".jpg" if "jp" in form else ".png"
    data = np.frombuffer(ahead + cv2.imencode(suffix, picture)[1].tobytes(), np.uint8)
    kind = "sensor_msgs/msg/CompressedImage"
    return Entry(topic, make_message(kind, header=head(frame_id), format=form, data=data), STAMP)


def info(topic, frame_id="optical", size=(HEIGHT, WIDTH)):
    return Entry(topic, replace(info_message(STAMP, *size), header=head(frame_id)), STAMP)


def cloud(topic, frame_id="optical", size=(HEIGHT, WIDTH)):
    shape = (*size, 3)
    points = np.ones(shape, np.float32)
    color, labels = np.zeros(shape, np.uint8), np.zeros(size, np.int32)
    return Entry(topic, cloud_message(points, color, labels, head(frame_id), make_message), STAMP)


DEEP = np.full((HEIGHT, WIDTH), 1500, np.uint16)
GREY = np.full((HEIGHT, WIDTH), 90, np.uint8)
RGB = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
BIG = np.full((2 * HEIGHT, 2 * WIDTH, 3), 90, np.uint8)
HALF = (HEIGHT // 2, WIDTH // 2)

CASES = {
    "a depth stream's own compressed transport is not the colour": (
        [
            image("/cam/depth/image", "16UC1"),
            compressed("/cam/depth/image/compressed", "16UC1; png compressed ", DEEP),
            compressed("/cam/rgb/image/compressed", "bgr8; jpeg compressed bgr8", BIG),
        ],
        ("/cam/depth/image", "/cam/rgb/image/compressed"),
    ),
    "nor in 8 bit, where the real colour has another size": (
        [
            image("/cam/depth/image", "16UC1"),
            compressed("/cam/depth/image/compressed", "16UC1; jpeg compressed ", GREY),
            image("/cam/rgb/image", "rgb8", size=(2 * HEIGHT, 2 * WIDTH)),
        ],
        ("/cam/depth/image", "/cam/rgb/image"),
    ),
    "nor without an encoding in its format": (
        [
            image("/cam/depth/image", "16UC1"),
            compressed("/cam/depth/image/compressed", "png", DEEP),
            image("/cam/rgb/image", "rgb8", size=(2 * HEIGHT, 2 * WIDTH)),
        ],
        ("/cam/depth/image", "/cam/rgb/image"),
    ),
    "compressedDepth alone": (
        [
            compressed(
                "/cam/depth/image/compressedDepth", "16UC1; compressedDepth png", DEEP, ahead=bytes(12)
            ),
            image("/cam/rgb/image", "rgb8"),
        ],
        ("/cam/depth/image/compressedDepth", "/cam/rgb/image"),
    ),
    "compressedDepth by its topic": (
        [
            compressed("/cam/depth/image/compressedDepth", "16UC1", DEEP, ahead=bytes(12)),
            image("/cam/rgb/image", "rgb8"),
        ],
        ("/cam/depth/image/compressedDepth", "/cam/rgb/image"),
    ),
    "a coloured picture of depth is not the colour": (
        [
            image("/cam/depth/image", "16UC1"),
            image("/cam/depth/image_colored", "bgr8"),
            image("/cam/image", "rgb8", size=(2 * HEIGHT, 2 * WIDTH)),
        ],
        ("/cam/depth/image", "/cam/image"),
    ),
    "but a depth camera's colour image is": (
        [image("/depth_camera/depth", "32FC1"), image("/depth_camera/image_raw", "rgb8")],
        ("/depth_camera/depth", "/depth_camera/image_raw"),
    ),
    "infrared in the depth's grid is not the colour": (
        [
            image("/cam/depth/image", "16UC1", "depth"),
            image("/cam/infra1/image", "mono8", "depth"),
            image("/cam/ir/image", "mono16", "depth"),
            image("/cam/color/image", "rgb8", "color"),
        ],
        ("/cam/depth/image", "/cam/color/image"),
    ),
    "infrared and confidence are no depth": (
        [
            image("/a/ir/image", "16UC1"),
            image("/b/confidence", "32FC1"),
            image("/c/depth", "16UC1"),
            image("/d/rgb", "rgb8"),
        ],
        ("/c/depth", "/d/rgb"),
    ),
    "mono16 is depth by its name": (
        [image("/cam/left", "mono16"), image("/cam/depth", "mono16"), image("/cam/rgb", "rgb8")],
        ("/cam/depth", "/cam/rgb"),
    ),
    "depth in any case of letters": (
        [image("/cam/a", "16uc1"), image("/cam/rgb", "RGB8")],
        ("/cam/a", "/cam/rgb"),
    ),
    "depth in 32 bits": ([image("/cam/a", "32SC1"), image("/cam/rgb", "rgb8")], ("/cam/a", "/cam/rgb")),
    "mono16 is depth where nothing else is": (
        [image("/cam/z16", "mono16"), image("/cam/rgb", "rgb8")],
        ("/cam/z16", "/cam/rgb"),
    ),
    "of two depth images the one in the colour's frame": (
        [
            image("/cam/a_depth/image", "16UC1", "depth_frame"),
            image("/cam/b_depth/image", "16UC1", "/color_frame"),
            image("/cam/rgb/image", "rgb8", "color_frame"),
        ],
        ("/cam/b_depth/image", "/cam/rgb/image"),
    ),
    "of two colour images the one in the depth's frame": (
        [
            image("/a_webcam/image", "rgb8", "webcam"),
            image("/cam/depth/image", "16UC1", "cam"),
            image("/cam/image", "rgb8", "cam"),
        ],
        ("/cam/depth/image", "/cam/image"),
    ),
    "of two colour images without frames the one of its name": (
        [
            image("/a_webcam/color/image", "rgb8", ""),
            image("/robot/cam/depth/image", "16UC1", ""),
            image("/robot/cam/color/image", "rgb8", ""),
        ],
        ("/robot/cam/depth/image", "/robot/cam/color/image"),
    ),
    "a cloud's own colour rather than a picture of another frame": (
        [cloud("/cam/points", "depth"), image("/cam/rgb/image", "rgb8", "color")],
        ("/cam/points", None),
    ),
    "a depth image in the colour's frame rather than a cloud in another": (
        [
            cloud("/zed/points", "left_camera_frame"),
            image("/zed/depth", "32FC1", "left_camera_optical_frame"),
            image("/zed/rgb", "bgra8", "left_camera_optical_frame"),
        ],
        ("/zed/depth", "/zed/rgb"),
    ),
    "a lidar is not the camera's cloud": (
        [
            cloud("/a_lidar/points", "lidar", (16, 900)),
            image("/cam/depth", "16UC1", "depth", HALF),
            image("/cam/rgb", "rgb8", "color"),
        ],
        ("/cam/depth", "/cam/rgb"),
    ),
    "rectified colour with rectified depth": (
        [
            image("/cam/depth_registered/image_rect", "16UC1"),
            image("/cam/rgb/image_raw", "rgb8"),
            image("/cam/rgb/image_rect_color", "rgb8"),
        ],
        ("/cam/depth_registered/image_rect", "/cam/rgb/image_rect_color"),
    ),
    "raw colour with raw depth": (
        [
            image("/cam/aligned_depth_to_color/image_raw", "16UC1"),
            image("/cam/color/image_a_rect", "rgb8"),
            image("/cam/color/image_raw", "rgb8"),
        ],
        ("/cam/aligned_depth_to_color/image_raw", "/cam/color/image_raw"),
    ),
    "a label image is neither": (
        [
            image("/a/semantic/labels", "mono16"),
            image("/a/segmentation/image", "rgb8"),
            image("/cam/depth", "16UC1"),
            image("/cam/rgb", "rgb8"),
        ],
        ("/cam/depth", "/cam/rgb"),
    ),
}


def find(path, named=None, range_from="auto", lines=None):
    with Recording(path) as recording:
        return find_topics(recording, named or {}, range_from, (lines if lines is not None else []).append)


@pytest.mark.parametrize("case", CASES)
def test_range_and_colour(case, tmp_path):
    entries, expected = CASES[case]
    found = find(write_folder(tmp_path / "bag", [info("/cam/camera_info"), *entries]))
    assert (found.range, found.color) == expected


def test_the_camera_of_the_same_frame(tmp_path):
    """Two cameras of one size, whose names tell nothing."""
    entries = [
        image("/depth", "16UC1", "front"), image("/image", "rgb8", "front"),
        info("/a/camera_info", "rear"), info("/b/camera_info", "front"),
    ]  # fmt: skip
    assert find(write_folder(tmp_path / "bag", entries)) == InputTopics("/depth", "/image", "/b/camera_info")


def test_two_cameras_are_not_mixed(tmp_path):
    entries = []
    for name in ("left", "right"):
        entries += [
            image(f"/{name}/depth/image", "16UC1", name),
            image(f"/{name}/color/image", "rgb8", name),
            info(f"/{name}/color/camera_info", name),
        ]
    bag = write_folder(tmp_path / "bag", entries)
    expected = InputTopics("/right/depth/image", "/right/color/image", "/right/color/camera_info")
    assert find(bag, {"range": "/right/depth/image"}) == expected
    assert find(bag).names() == [name.replace("right", "left") for name in expected.names()]


def test_a_picture_that_came_once_is_not_the_stream(tmp_path):
    """A latched preview beside the compressed stream."""
    entries = [e for e in depth_entries(5) if e.topic != COLOR]
    entries.append(image(COLOR, "rgb8", "camera_optical_frame"))
    for entry in depth_entries(5):
        if entry.topic == COLOR:
            message = compressed(f"{COLOR}/compressed", "rgb8; jpeg compressed bgr8", RGB).message
            message.header = entry.message.header
            entries.append(Entry(f"{COLOR}/compressed", message, entry.log_ns))
    assert find(write_folder(tmp_path / "bag", entries)).color == f"{COLOR}/compressed"


def test_results_under_another_name_are_no_inputs(tmp_path):
    bag = write_folder(tmp_path / "bag", cloud_entries(1) + [e for e in depth_entries(1) if e.topic == INFO])
    replay(ReplayRequest(bag, tmp_path / "out", SegmenterConfig()))
    entries = depth_entries(1)
    with Recording(tmp_path / "out") as result:
        for raw in result.messages(result.topics):
            entries.append(Entry(raw.topic.replace("/rcseg", "/a_node"), result.decode(raw), raw.log_ns))
    assert find(write_folder(tmp_path / "both", entries)) == InputTopics(DEPTH, COLOR, INFO)


def test_a_first_message_that_is_broken_does_not_hide_its_topic(tmp_path):
    entries = depth_entries(3)
    bag = write_folder(tmp_path / "bag", entries)
    assert find(bag) == InputTopics(DEPTH, COLOR, INFO)

    with BagWriter(tmp_path / "broken") as writer:
        writer.write(DEPTH, "sensor_msgs/msg/Image", b"\x00\x01\x00\x00rubbish", STAMP - 1)
        for e in entries:
            writer.write(e.topic, e.message.__msgtype__, serialize(e.message), e.log_ns)
    assert find(tmp_path / "broken") == InputTopics(DEPTH, COLOR, INFO)


def test_the_choice_is_explained(tmp_path, capfd):
    entries, _ = CASES["infrared in the depth's grid is not the colour"]
    bag = write_folder(tmp_path / "bag", [info("/cam/camera_info", "color"), *entries])
    lines = []
    find(bag, lines=lines)
    told = dict(line.split(": ", 1) for line in lines)
    assert told["/cam/depth/image"].endswith(
        "16UC1 image 64x48 in depth, 1 messages; taken as range: the only one"
    )
    assert "taken as color: the best" in told["/cam/color/image"]
    assert "not as color: its name says infra" in told["/cam/infra1/image"]
    assert "taken as camera_info: the only one" in told["/cam/camera_info"]
    main(["replay", str(bag), "-o", str(tmp_path / "out"), "--verbose"])
    shown = capfd.readouterr().out
    assert all(line in shown for line in lines)


def test_the_choice_is_explained_where_it_fails(tmp_path, capfd):
    bag = write_folder(tmp_path / "bag", [image("/cam/depth", "16UC1"), info("/cam/camera_info")])
    assert main(["replay", str(bag), "-v"]) == 2
    shown = capfd.readouterr()
    assert "/cam/depth: 16UC1 image" in shown.out and "no colour image" in shown.err


@dataclass
class Video:
    """How drivers record a video: type, definition and the fields that name its codec."""

    kind: str
    definition: str
    fields: dict


VIDEOS = {
    "H.264": Video(
        "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
        "bool is_bigendian\nuint8[] data\n",
        {"width": 64, "height": 48, "encoding": "h264;yuv420p;bgr8;bgr8", "pts": 0, "flags": 0,
         "is_bigendian": False},
    ),
    "H.265": Video(
        "foxglove_msgs/msg/CompressedVideo",
        "std_msgs/Header header\nstring frame_id\nuint8[] data\nstring format\n",
        {"frame_id": "optical", "format": "h265"},
    ),
}  # fmt: skip


@pytest.mark.parametrize("codec", VIDEOS)
def test_videos_are_named_as_such(codec, tmp_path, capfd):
    video = VIDEOS[codec]
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(video.definition, video.kind))
    depth = depth_message(scene(0).depth_m, head("optical"), make_message)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        for topic, message in (
            ("/cam/depth", depth),
            ("/cam/camera_info", info_message(STAMP)),
            ("/cam/video", store.types[video.kind](
                header=head("optical"), data=np.zeros(9, np.uint8), **video.fields)),
        ):  # fmt: skip
            connection = bag.add_connection(topic, message.__msgtype__, typestore=store)
            bag.write(connection, STAMP, store.serialize_cdr(message, message.__msgtype__))
    assert main(["replay", str(tmp_path / "bag")]) == 2
    error = capfd.readouterr().err
    assert "no colour image" in error and f"/cam/video is {codec} video" in error and "republish" in error
    assert main(["replay", str(tmp_path / "bag"), "--topics", "color=/cam/video"]) == 2
    assert f"/cam/video is {codec} video" in capfd.readouterr().err


def test_a_compressed_cloud_is_named_as_such(tmp_path):
    kind = "point_cloud_interfaces/msg/CompressedPointCloud2"
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("std_msgs/Header header\nstring format\nuint8[] data\n", kind))
    message = store.types[kind](header=head("optical"), format="zstd", data=np.zeros(9, np.uint8))
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection("/cam/points/zstd", kind, typestore=store)
        bag.write(connection, STAMP, store.serialize_cdr(message, kind))
    with pytest.raises(InputError, match=r"/cam/points/zstd is a compressed cloud.*in_transport:=zstd"):
        find(tmp_path / "bag")


def test_a_video_in_the_clothes_of_a_compressed_image(tmp_path):
    entry = compressed("/cam/image/compressed", "h264", RGB)
    bag = write_folder(tmp_path / "bag", [image("/cam/depth", "16UC1"), info("/cam/camera_info"), entry])
    with pytest.raises(InputError, match=r"no colour image.*/cam/image/compressed is H\.264 video"):
        find(bag)


def test_colour_of_a_picture_that_is_there_in_both_forms(tmp_path):
    entries = [*depth_entries(1), compressed(f"{COLOR}/compressed", "rgb8; jpeg compressed bgr8", RGB)]
    entries.append(Entry("/a/image", picture_message(scene(0).color, head("elsewhere"), make_message), STAMP))
    assert find(write_folder(tmp_path / "bag", entries)) == InputTopics(DEPTH, COLOR, INFO)
