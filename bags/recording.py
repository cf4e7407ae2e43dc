"""What the three scripts share: camera messages, and a folder that replaces an older one."""

import shutil
from pathlib import Path

import numpy as np

from rcseg_core import PinholeCamera
from rcseg_ros.frames.conversions import Header
from rcseg_ros.recordings.result_bag import BagWriter, make_message, serialize
from rcseg_ros.results.outputs import header_message

HERE = Path(__file__).resolve().parent


class InputBag:
    """Writes messages of sensors into bags/NAME, each at its own stamp."""

    def __init__(self, name: str) -> None:
        shutil.rmtree(HERE / name, ignore_errors=True)
        self._bag = BagWriter(HERE / name)

    def add(self, topic: str, message: object, stamp_ns: int) -> None:
        self._bag.write(topic, message.__msgtype__, serialize(message), stamp_ns)

    def __enter__(self) -> "InputBag":
        return self

    def __exit__(self, *_: object) -> None:
        self._bag.close()


def camera_info(
    header: Header, camera: PinholeCamera, height: int, width: int, distortion=(0.0,) * 5
) -> object:
    """CameraInfo of a camera; its projection matrix P is K, as for an image that is not rectified further."""
    k = camera.matrix()
    return make_message(
        "sensor_msgs/msg/CameraInfo",
        header=header_message(header, make_message),
        height=height,
        width=width,
        distortion_model="plumb_bob",
        d=np.asarray(distortion, np.float64),
        k=k.reshape(9),
        r=np.eye(3).reshape(9),
        p=np.c_[k, np.zeros(3)].reshape(12),
        binning_x=0,
        binning_y=0,
        roi=make_message(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        ),
    )
