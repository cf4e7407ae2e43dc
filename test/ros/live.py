"""Two processes on one isolated ROS domain: the node as users start it, and a peer that publishes and
listens.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PolygonInstanceStamped
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import GetParameters, SetParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, Imu, PointCloud2
from visualization_msgs.msg import MarkerArray

from rcseg_core import PinholeCamera, RangeColorFrame, SegmenterConfig, segment
from rcseg_msgs.msg import ObjectArray, RegionArray, TrackArray
from rcseg_ros.frames.conversions import Header
from rcseg_ros.results.messages import make_rcl
from rcseg_ros.results.outputs import cloud_message, depth_message, header_message, picture_message

INPUTS = {
    "points": PointCloud2,
    "depth": Image,
    "image": Image,
    "camera_info": CameraInfo,
    "depth_camera_info": CameraInfo,
    "imu": Imu,
}
OUTPUTS = {
    "labels": Image,
    "surface_labels": Image,
    "regions": RegionArray,
    "overlay": Image,
    "edges": Image,
    "markers": MarkerArray,
    "reconstruction": PointCloud2,
}
#: What a robot takes of the results; the last three are silent where up is unknown.
WORLD_OUTPUTS = {
    "object_labels": Image,
    "objects": ObjectArray,
    "polygons": PolygonInstanceStamped,
    "labelled_points": PointCloud2,
    "class_mask": Image,
    "ground_points": PointCloud2,
    "obstacle_points": PointCloud2,
}
TRACK_OUTPUTS = {"tracks": TrackArray}


def _own_domain() -> int:
    """A ROS domain that no other test run on this machine has, held until this process ends."""
    for domain in range(1, 101):
        lock = open(Path(tempfile.gettempdir()) / f"rcseg-test-domain-{domain}", "w")  # noqa: SIM115
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            continue
        _HELD.append(lock)
        return domain
    raise RuntimeError("a hundred test runs at a time have all ROS domains")


_HELD: list[Any] = []
DOMAIN = _own_domain()
PROFILE = Path(__file__).parents[2] / "config" / "fastdds_large_messages.xml"
ISOLATED = {
    "ROS_DOMAIN_ID": str(DOMAIN),
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    # Without it an answer that is lost among large messages comes with the next heartbeat, 3 s later.
    "FASTRTPS_DEFAULT_PROFILES_FILE": str(PROFILE),
}
FRAME_ID = "camera_color_optical_frame"
CAMERA = PinholeCamera(180.0, 180.0, 79.5, 59.5)
SECOND = 1_000_000_000
_LIBC = ctypes.CDLL(None)
_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def scene(seed: int = 0, height: int = 120, width: int = 160) -> RangeColorFrame:
    """A tilted two-coloured wall, a box before it, 1 mm of noise and a patch without range."""
    rng = np.random.default_rng(seed)
    rows, cols = np.mgrid[0:height, 0:width]
    inverse_depth = 0.5 + 0.001 * cols + 0.0005 * rows
    box = (abs(rows - height // 2) < height // 5) & (abs(cols - width // 3) < width // 6)
    inverse_depth[box] = 0.9
    depth_m = (1 / inverse_depth + rng.normal(0, 0.001, inverse_depth.shape)).astype(np.float32)
    depth_m[:8, :8] = np.nan
    color = np.where((cols < width // 2)[..., None], (60, 90, 120), (180, 150, 90)).astype(np.int16)
    color[box] = (200, 60, 50)
    color = np.clip(color + rng.normal(0, 2, color.shape), 0, 255).astype(np.uint8)
    return RangeColorFrame.from_depth(depth_m, color, CAMERA)


def expected_labels(frame: RangeColorFrame, **changes: Any) -> np.ndarray:
    """What the library itself says of a frame."""
    return segment(frame, SegmenterConfig().replace(changes)).labels


def header(stamp_ns: int, frame_id: str = FRAME_ID) -> Any:
    return header_message(Header(stamp_ns, frame_id), make_rcl)


def cloud_of(frame: RangeColorFrame, stamp_ns: int, organized: bool = True) -> PointCloud2:
    """The frame's points with its colour in the rgb field; unorganised: one row, in a shuffled order."""
    message = cloud_message(
        frame.points.astype(np.float32),
        frame.color,
        np.zeros(frame.valid.shape, np.int32),
        header(stamp_ns),
        make_rcl,
    )
    if not organized:
        cells = np.frombuffer(message.data, np.uint8).reshape(-1, message.point_step)
        message.data = np.random.default_rng(1).permutation(cells).tobytes()
        message.width, message.height = message.width * message.height, 1
        message.row_step = message.width * message.point_step
    return message


def image_of(frame: RangeColorFrame, stamp_ns: int) -> Image:
    return picture_message(frame.color, header(stamp_ns), make_rcl)


def depth_of(frame: RangeColorFrame, stamp_ns: int) -> Image:
    return depth_message(frame.depth_m, header(stamp_ns), make_rcl)


def camera_info_of(frame: RangeColorFrame, stamp_ns: int, distortion: tuple[float, ...] = ()) -> CameraInfo:
    message = CameraInfo(header=header(stamp_ns), height=frame.height, width=frame.width)
    message.distortion_model = "plumb_bob"
    message.d = [float(d) for d in distortion] or [0.0] * 5
    message.k = CAMERA.matrix().ravel()
    return message


def image_array(message: Image) -> np.ndarray:
    """Pixels of a 16UC1, 8UC1, mono8 or rgb8 output."""
    kinds = {"16UC1": ("<u2", 1), "8UC1": ("u1", 1), "mono8": ("u1", 1), "rgb8": ("u1", 3)}
    kind, channels = kinds[message.encoding]
    pixels = np.frombuffer(message.data, kind).reshape(message.height, message.width, channels)
    return pixels[..., 0] if channels == 1 else pixels


def stamp_of(message: Any) -> int:
    stamp = message.header.stamp if hasattr(message, "header") else message.markers[0].header.stamp
    return stamp.sec * SECOND + stamp.nanosec


def input_topics(node_name: str) -> dict[str, str]:
    """Topics of a node's inputs: the default names for the default node, apart for every other one."""
    return {name: name if node_name == "rcseg" else f"/{node_name}/in/{name}" for name in INPUTS}


def assert_same(one: Any, other: Any, path: str = "message") -> None:
    """Equality of two messages field by field, NaN equal to NaN."""
    if hasattr(one, "get_fields_and_field_types"):
        for name in one.get_fields_and_field_types():
            assert_same(getattr(one, name), getattr(other, name), f"{path}.{name}")
    elif isinstance(one, list):
        assert len(one) == len(other), path
        for i, pair in enumerate(zip(one, other, strict=True)):
            assert_same(*pair, f"{path}[{i}]")
    elif isinstance(one, str):
        assert one == other, path
    else:
        np.testing.assert_array_equal(one, other, path)


def _as_nohup_starts_it() -> None:
    """In the child: SIGINT ignored; and it ends with this run, even where that is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class NodeProcess:
    """The executable segmentation_node, in a process and a session of its own."""

    started: ClassVar[list[NodeProcess]] = []

    def __init__(
        self, log: Path, parameters: dict[str, Any] | None = None, remaps: dict[str, str] | None = None
    ) -> None:
        arguments = ["--ros-args"]
        for key, value in (parameters or {}).items():
            arguments += ["-p", f"{key}:={str(value).lower() if isinstance(value, bool) else value}"]
        for old, new in (remaps or {}).items():
            arguments += ["-r", f"{old}:={new}"]
        self._log = log
        with log.open("wb") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "rcseg_ros.node", *arguments],
                stdout=output, stderr=subprocess.STDOUT, env=environment(), start_new_session=True,
                preexec_fn=_as_nohup_starts_it,
            )  # fmt: skip
        NodeProcess.started.append(self)

    def output(self) -> str:
        return self._log.read_text(errors="replace")

    def wait_for_output(self, text: str, timeout_s: float = 120.0) -> None:
        wait_until(lambda: text in self.output() or self.process.poll() is not None, timeout_s, self.output)
        assert text in self.output(), self.output()

    def stop(self, how: int = signal.SIGINT, timeout_s: float = 10.0) -> tuple[int, float]:
        """Send a signal; return the exit code and the seconds until the process had ended."""
        started = time.monotonic()
        if self.process.poll() is None:
            self.process.send_signal(how)
        try:
            return self.process.wait(timeout_s * patience()), time.monotonic() - started
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            raise AssertionError(
                f"the node ignored signal {how} for {timeout_s} s: {self.output()}"
            ) from None


def environment() -> dict[str, str]:
    """The environment of every process of this run: own domain, nothing beyond this machine."""
    return os.environ | ISOLATED


def patience() -> float:
    """By how much everything may take longer than on a machine with nothing else to do, 1 there to 10."""
    return min(max(os.getloadavg()[0] / (os.cpu_count() or 1), 1.0), 10.0)


def wait_until(
    condition: Callable[[], Any], timeout_s: float, explain: Callable[[], Any] = lambda: ""
) -> Any:
    """Poll until the condition is true and return its value.

    Times are those of an idle machine, and far from what is usual: they only bound a failure. The average
    load knows of other work too late, so each is allowed three times over.
    """
    started = time.monotonic()
    while time.monotonic() < started + 3 * timeout_s * patience():
        value = condition()
        if value:
            return value
        time.sleep(0.01)
    raise AssertionError(f"not within {timeout_s} s: {explain()}")


def _values(message: DiagnosticArray) -> dict[str, str]:
    status = message.status[0]
    texts = {"level": str(status.level), "message": status.message}
    return {value.key: value.value for value in status.values} | texts


class Peer:
    """A node in this process: publishers of the inputs, a record of the outputs, clients of the services."""

    def __init__(
        self,
        node_name: str = "rcseg",
        outputs: tuple[str, ...] = tuple(OUTPUTS),
        reliable: bool = True,
        topics: dict[str, str] | None = None,
    ) -> None:
        os.environ.update(ISOLATED)
        self._context = Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node("peer", context=self._context)
        self.received: dict[str, list[Any]] = defaultdict(list)
        self.arrived_s: dict[str, list[float]] = defaultdict(list)
        reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
        qos = QoSProfile(depth=10, reliability=reliability)
        topics = input_topics(node_name) | (topics or {})
        self.publishers = {
            name: self.node.create_publisher(kind, topics[name], qos) for name, kind in INPUTS.items()
        }
        self._prefix = f"/{node_name}"
        for name in outputs:
            self._listen(name, (OUTPUTS | WORLD_OUTPUTS | TRACK_OUTPUTS)[name], f"/{node_name}/{name}")
        self._listen("diagnostics", DiagnosticArray, "/diagnostics")
        self._clients: dict[str, Any] = {}
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin, daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        with contextlib.suppress(ExternalShutdownException):
            self._executor.spin()

    def _listen(self, name: str, kind: type, topic: str) -> None:
        own = f"{self._prefix[1:]}: "  # the diagnostics of all nodes come over one topic

        def take(message: Any) -> None:
            if kind is DiagnosticArray and not message.status[0].name.startswith(own):
                return
            self.arrived_s[name].append(time.monotonic())
            self.received[name].append(message)

        self.node.create_subscription(kind, topic, take, QoSProfile(depth=50))

    def close(self) -> None:
        self._context.try_shutdown()
        self._thread.join(5)
        self.node.destroy_node()

    def connected(self, *inputs: str, timeout_s: float = 20.0) -> None:
        """Wait until the node reads these inputs and its outputs are heard here."""
        wait_until(lambda: all(self.publishers[i].get_subscription_count() for i in inputs), timeout_s)
        wait_until(lambda: self.node.count_publishers(f"{self._prefix}/labels"), timeout_s)
        # The node's side of the discovery: the listener to diagnostics was announced after all others.
        wait_until(lambda: self.received["diagnostics"], timeout_s)
        time.sleep(0.1 * patience())

    def publish(self, **messages: Any) -> None:
        for name, message in messages.items():
            self.publishers[name].publish(message)

    def send(self, frame: RangeColorFrame, stamp_ns: int, camera: bool = True) -> None:
        """Cloud, image and, unless told otherwise, camera_info of a frame."""
        if camera:
            self.publish(camera_info=camera_info_of(frame, stamp_ns))
        self.publish(points=cloud_of(frame, stamp_ns), image=image_of(frame, stamp_ns))

    def wait_for(self, name: str, stamp_ns: int, timeout_s: float = 20.0) -> Any:
        """The output of that name for the input of that stamp."""
        return wait_until(
            lambda: next((m for m in list(self.received[name]) if stamp_of(m) == stamp_ns), None),
            timeout_s,
            lambda: f"{name} of {stamp_ns}; diagnostics: {self.diagnostics()}",
        )

    def diagnostics(self) -> dict[str, str]:
        """Values of the latest diagnostics, and its level and message under those names."""
        return _values(self.received["diagnostics"][-1]) if self.received["diagnostics"] else {}

    def heard_that(self, condition: Callable[[dict[str, str]], Any]) -> dict[str, str] | None:
        """The first diagnostics for which the condition holds; a later one may say something else."""
        return next((d for d in map(_values, list(self.received["diagnostics"])) if condition(d)), None)

    def diagnosed(
        self, what: str | Callable[[dict[str, str]], Any], timeout_s: float = 20.0
    ) -> dict[str, str]:
        """Wait for diagnostics whose message contains the words, or for which the condition holds."""
        condition = what if callable(what) else lambda values: what in values["message"]
        return wait_until(lambda: self.heard_that(condition), timeout_s, self.diagnostics)

    def count(self, key: str) -> int:
        """A counter of the diagnostics; 0 before it is first counted."""
        return int(self.diagnostics().get(key, "0").split()[0])

    def call(self, kind: Any, service: str, request: Any, timeout_s: float = 20.0) -> Any:
        """Call a service of the node and wait for its answer."""
        if service not in self._clients:
            self._clients[service] = self.node.create_client(kind, f"{self._prefix}/{service}")
            assert self._clients[service].wait_for_service(timeout_s), f"no service {service}"
        future = self._clients[service].call_async(request)
        wait_until(future.done, timeout_s, lambda: f"{service} did not answer")
        return future.result()

    def change_state(self, label: str) -> bool:
        request = ChangeState.Request()
        request.transition.label = label
        return self.call(ChangeState, "change_state", request, 120.0).success

    def state(self) -> str:
        return self.call(GetState, "get_state", GetState.Request()).current_state.label

    def set_parameters(self, **values: Any) -> list[Any]:
        """Set parameters one by one (dots written as double underscores)."""
        request = SetParameters.Request(parameters=_parameter_messages(values))
        return self.call(SetParameters, "set_parameters", request).results

    def set_parameters_atomically(self, **values: Any) -> Any:
        request = SetParametersAtomically.Request(parameters=_parameter_messages(values))
        return self.call(SetParametersAtomically, "set_parameters_atomically", request).result

    def get_parameters(self, *names: str) -> list[Any]:
        return self.call(GetParameters, "get_parameters", GetParameters.Request(names=list(names))).values


def _parameter_messages(values: dict[str, Any]) -> list[Any]:
    return [
        Parameter(name.replace("__", "."), value=value).to_parameter_msg() for name, value in values.items()
    ]
