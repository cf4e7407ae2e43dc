"""The lifecycle node `rcseg`: wiring of topics, pairing, worker and publishers; all else is in modules of
its own.

The executor's thread only pairs and enqueues. One worker thread decodes, segments and publishes, so
services and timers answer while a frame is in work. Nothing that arrives on a topic ends the node: it is
counted by its reason, shown in /diagnostics and warned of once a throttle period.
"""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import CameraInfo, Image, PointCloud2

from rcseg_core import PinholeCamera, RangeColorFrame, segment
from rcseg_core.errors import ConfigError, RcsegError
from rcseg_ros.assembly import assemble_frame
from rcseg_ros.conversions import Header, header_of
from rcseg_ros.extrinsic import TransformListener, rigid
from rcseg_ros.health import Health
from rcseg_ros.messages import make_rcl
from rcseg_ros.parameters import NodeParameters
from rcseg_ros.publishers import ResultPublishers
from rcseg_ros.subscriptions import AdaptiveSubscription
from rcseg_ros.sync import FrameSync, Pair
from rcseg_ros.worker import Worker

SUCCESS, ERROR = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.ERROR
STOP_TIMEOUT_S = 1.0


@dataclass(frozen=True)
class _Task:
    """A paired frame on its way to the worker; arrived_s is the monotonic time of its last message."""

    pair: Pair
    arrived_s: float


class SegmentationNode(LifecycleNode):
    """Segments paired range and colour messages and publishes regions; topics and parameters: docs/ros.md."""

    def __init__(self, **node_options: Any) -> None:
        super().__init__("rcseg", **node_options)
        self.parameters = NodeParameters(self, lambda: self._state() == "unconfigured")
        for sentence in self.parameters.unknown():
            self.get_logger().warning(sentence)
        self.health = Health()
        self._publishing = (
            threading.Lock()
        )  # held while the worker publishes and while publishers come and go
        self._active = False
        self._configured: list[Any] = []  # what on_configure made, undone in reverse order
        self._guard_change_state()
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        steady = Clock(
            clock_type=ClockType.STEADY_TIME
        )  # diagnostics go on while simulated time stands still
        self.create_timer(1.0, self._report, clock=steady)
        backward = JumpThreshold(
            min_forward=None, min_backward=Duration(nanoseconds=-1), on_clock_change=True
        )
        self._jump = self.get_clock().create_jump_callback(backward, post_callback=self._on_time_jump)

    def autostart(self) -> None:
        """Configure and activate, if the parameter says so."""
        if self.parameters["autostart"] and self.trigger_configure() == SUCCESS:
            self.trigger_activate()

    def close(self) -> None:
        """Release everything, in whatever state; a frame in work is given up after a second."""
        self._active = False
        self._tear_down()

    # Lifecycle: rclpy swallows exceptions of these callbacks, so each says itself what went wrong.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            self._set_up()
        except Exception as error:
            self._log_failure("configure", error)
            self._tear_down()
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._sync = self._new_sync()
        self._source = self.parameters["input.range_from"]
        self._active = True
        self.get_logger().info("active: waiting for " + ", ".join(s.topic for s in self._inputs.values()))
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._active = False
        self._worker.clear()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._tear_down()
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.close()
        return SUCCESS

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.get_logger().error(f"recovering from an error in {state.label}: unconfigured again")
        self.close()
        return SUCCESS

    def _set_up(self) -> None:
        parameters = self.parameters
        self.health = Health()
        self._extrinsic = rigid(
            parameters["input.extrinsic_translation"], parameters["input.extrinsic_rotation"]
        )
        self._transforms = None
        if parameters["input.use_tf"]:
            self._transforms = TransformListener(self)
            self._configured.append(self._transforms.destroy)
        started_s = time.monotonic()
        self.get_logger().info("configuring: compiling (up to a minute the first time, then cached)")
        _warm_up(parameters.config)
        self.get_logger().info(f"configured in {time.monotonic() - started_s:.1f} s")
        self._results = ResultPublishers(self)
        self._configured.append(self._results.destroy)
        self._worker = Worker(self._process, "segment")
        self._configured.append(lambda: self._worker.stop(STOP_TIMEOUT_S))
        self._sync = self._new_sync()
        self._source = parameters["input.range_from"]
        self._inputs: dict[str, AdaptiveSubscription] = {}
        for topic, kind in (
            ("points", PointCloud2),
            ("depth", Image),
            ("image", Image),
            ("camera_info", CameraInfo),
        ):
            if self._source in ("auto", topic) or topic in ("image", "camera_info"):
                self._inputs[topic] = AdaptiveSubscription(
                    self, kind, topic, lambda message, topic=topic: self._on_message(topic, message),
                    parameters["qos.reliability"], parameters["qos.depth"],
                )  # fmt: skip
                self._configured.append(self._inputs[topic].destroy)

    def _tear_down(self) -> None:
        while self._configured:
            undo = self._configured.pop()
            with self._publishing if undo == self._results.destroy else threading.Lock():
                undo()

    # Topics, on the executor's thread: pair and enqueue, nothing more.

    def _on_message(self, topic: str, message: Any) -> None:
        if not self._active:
            return
        arrived_s = time.monotonic()
        self.health.count(f"received.{topic}")
        # Drivers without a clock stamp zero: then the time of arrival pairs.
        stamp_ns = header_of(message).stamp_ns or time.time_ns()
        try:
            pairs = self._pair(topic, stamp_ns, message)
        except Exception as error:
            self._reject(error, topic)
            return
        for pair in pairs:
            dropped = self._worker.put(_Task(pair, arrived_s), self.parameters["input.queue"])
            self.health.count("paired")
            self.health.count("dropped.queue", len(dropped))

    def _pair(self, topic: str, stamp_ns: int, message: Any) -> list[Pair]:
        color_from, camera = self.parameters["input.color_from"], self.parameters["input.camera"]
        if topic == "camera_info":
            return [] if camera == "none" else self._sync.add_camera(stamp_ns, message)
        if topic == "image":
            return [] if color_from == "cloud" else self._sync.add_color(stamp_ns, message)
        if self._source == "auto":
            self._source = topic
        if topic != self._source:
            self.health.count(f"dropped.second_source_{topic}")
            return []
        listed = self._inputs["image"].publishers() > 0
        self._sync.with_color = color_from == "image" or topic == "depth" or (color_from == "auto" and listed)
        self._sync.needs_camera = camera == "required" or (
            camera == "auto" and self._inputs["camera_info"].publishers() > 0
        )
        return self._sync.add_range(stamp_ns, message)

    def _new_sync(self) -> FrameSync:
        slop_ns = round(self.parameters["sync.slop_ms"] * 1e6)
        return FrameSync(slop_ns=slop_ns, queue_size=self.parameters["sync.queue"], live=True)

    def _on_time_jump(self, jump: Any) -> None:
        """Simulated time went back, as when a bag loops: what waits for a partner waits in vain."""
        if self._active:
            self.health.count("time_jumps")
            self._sync = self._new_sync()

    # Frames, on the worker's thread.

    def _process(self, task: _Task) -> None:
        config = self.parameters.config  # one read: a change of parameters falls between two frames
        try:
            extrinsic = self._extrinsic_of(task.pair)
            frame = assemble_frame(task.pair.range, task.pair.color, task.pair.camera, extrinsic)
            started_s = time.monotonic()
            result = segment(frame, config)
            segment_s = time.monotonic() - started_s
            header = header_of(task.pair.range)
            if extrinsic is not None:  # the points were moved into the camera's frame
                header = Header(header.stamp_ns, header_of(task.pair.camera).frame_id)
            with self._publishing:
                if self._active:
                    self._results.publish(
                        header, frame, result,
                        lambda: self.health.published(time.monotonic() - task.arrived_s, segment_s),
                    )  # fmt: skip
        except Exception as error:
            if rclpy.ok():
                self._reject(error, "frame")

    def _extrinsic_of(self, pair: Pair) -> Any:
        if self._transforms is None or pair.camera is None:
            return self._extrinsic
        return self._transforms.lookup(header_of(pair.camera).frame_id, header_of(pair.range).frame_id)

    # Health.

    def _reject(self, error: Exception, where: str) -> None:
        known = isinstance(error, RcsegError)
        reason = getattr(error, "reason", "invalid_frame") if known else f"internal_{type(error).__name__}"
        if self.health.reject(reason, str(error), self.parameters["diagnostics.warn_period_s"]):
            self.get_logger().warning(f"{where} rejected ({reason}): {error}")

    def _report(self) -> None:
        if not rclpy.ok():
            return
        drops = self._sync.drops if self._configured else {}
        status = self.health.status(f"{self.get_name()}: segmentation", self._state(), drops, make_rcl)
        stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(
            DiagnosticArray(header=make_rcl("std_msgs/msg/Header", stamp=stamp), status=[status])
        )

    def _state(self) -> str:
        return str(self._state_machine.current_state[1])

    def _log_failure(self, what: str, error: Exception) -> None:
        known = isinstance(error, RcsegError)
        self.get_logger().error(f"cannot {what}: {error if known else repr(error)}")

    def _guard_change_state(self) -> None:
        """Answer an impossible transition with failure: rclpy would let it raise and end the node."""
        service = self._service_change_state
        change_state = service.callback

        def guarded(request: Any, response: Any) -> Any:
            try:
                return change_state(request, response)
            except Exception as error:
                self.get_logger().warning(f"transition refused in state {self._state()}: {error}")
                response.success = False
                return response

        service.callback = guarded


def _warm_up(config: Any) -> None:
    """Compile, or load from the cache, all that a frame needs: both signals, on a small tilted plane."""
    rows, cols = np.mgrid[0:96, 0:128]
    camera = PinholeCamera(120.0, 120.0, 63.5, 47.5)
    depth_m = (2.0 / (1.0 + 0.002 * cols + 0.001 * rows)).astype(np.float32)
    color = np.where(cols[..., None] < 64, 60, 180).repeat(3, axis=2).astype(np.uint8)
    with_camera = RangeColorFrame.from_depth(depth_m, color, camera)
    for frame in (with_camera, RangeColorFrame(with_camera.points, color)):
        segment(frame, config)


def main(args: list[str] | None = None) -> int:
    """Run the node until it is told to stop; exit code 0, or 2 where a parameter cannot be used."""
    rclpy.init(args=args)
    node = None
    try:
        node = SegmentationNode()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.autostart()
        executor.spin()
    except ConfigError as error:
        print(f"segmentation_node: {error}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if node is not None:
            node.close()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
