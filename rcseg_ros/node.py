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

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from rcseg_core import segment
from rcseg_core.errors import ConfigError, RcsegError
from rcseg_ros.assembly import assemble_frame
from rcseg_ros.conversions import Header, header_of
from rcseg_ros.extrinsic import TransformListener, rigid
from rcseg_ros.health import Health, noise_values
from rcseg_ros.inputs import Inputs
from rcseg_ros.manners import Interrupt, answer_impossible_transitions, told
from rcseg_ros.messages import make_rcl
from rcseg_ros.parameters import NodeParameters
from rcseg_ros.publishers import ResultPublishers
from rcseg_ros.sync import Pair
from rcseg_ros.warmup import warm_up
from rcseg_ros.worker import Worker

SUCCESS = TransitionCallbackReturn.SUCCESS
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
        self._publishing = threading.Lock()  # held while the worker publishes and while publishers go
        self._active = False
        self._configured: list[Any] = []  # what on_configure made, undone in reverse order
        self._inputs: Any = None
        answer_impossible_transitions(self)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Diagnostics go on while simulated time stands still.
        self.create_timer(1.0, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))
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

    # Lifecycle.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            self._set_up()
        except Exception as error:
            self._log_failure("configure", error)
            self._tear_down()
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)

    @told
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._inputs.start()
        self._active = True
        self.get_logger().info(f"active: waiting for {', '.join(self._inputs.topics)}")
        return super().on_activate(state)

    @told
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._active = False
        self._inputs.stop()
        self._worker.clear()
        return super().on_deactivate(state)

    @told
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._tear_down()
        return SUCCESS

    @told
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
        self.get_logger().info(f"configured in {self._compile():.1f} s")
        self._results = ResultPublishers(self)
        self._configured.append(self._destroy_results)
        self._worker = Worker(self._process, "segment")
        self._configured.append(lambda: self._worker.stop(STOP_TIMEOUT_S))
        self._inputs = Inputs(self, parameters, self.health, self._enqueue, self.reject)
        self._configured.append(self._inputs.destroy)

    def _compile(self) -> float:
        """Ready the kernels; seconds. That holds up the executor, so its progress is reported from here."""

        def announce(text: str) -> None:
            self.get_logger().info(text)
            self.health.progress(text)
            self._report()

        try:
            return warm_up(self.parameters.config, announce)
        finally:
            self.health.progress("")

    def _tear_down(self) -> None:
        while self._configured:
            self._configured.pop()()

    def _destroy_results(self) -> None:
        with self._publishing:
            self._results.destroy()

    # Pairs, on the executor's thread: enqueued and no more.

    def _enqueue(self, pair: Pair, arrived_s: float) -> None:
        dropped = self._worker.put(_Task(pair, arrived_s), self.parameters["input.queue"])
        self.health.count("paired")
        self.health.count("dropped.queue", len(dropped))

    def _on_time_jump(self, jump: Any) -> None:
        """Simulated time went back, as when a bag loops: what waits for a partner waits in vain."""
        if self._active:
            self.health.count("time_jumps")
            self._inputs.start_anew()

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
                        lambda: self.health.published(
                            time.monotonic() - task.arrived_s, segment_s, noise_values(result)
                        ),
                    )  # fmt: skip
        except Exception as error:
            if rclpy.ok():
                self.reject(error, "frame")

    def _extrinsic_of(self, pair: Pair) -> Any:
        if self._transforms is None or pair.camera is None:
            return self._extrinsic
        return self._transforms.lookup(header_of(pair.camera).frame_id, header_of(pair.range).frame_id)

    # Health.

    def reject(self, error: Exception, where: str) -> None:
        """Count what cannot be used, and warn of it once a throttle period."""
        known = isinstance(error, RcsegError)
        reason = getattr(error, "reason", "invalid_frame") if known else f"internal_{type(error).__name__}"
        if self.health.reject(reason, str(error), self.parameters["diagnostics.warn_period_s"]):
            self.get_logger().warning(f"{where} rejected ({reason}): {error}")

    def _report(self) -> None:
        if not rclpy.ok():
            return
        drops = self._inputs.drops if self._configured and self._inputs is not None else {}
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


def main(args: list[str] | None = None) -> int:
    """Run the node until it is told to stop; exit code 0, or 2 where a parameter cannot be used."""
    interrupt = Interrupt()
    rclpy.init(args=args)
    node = None
    try:
        node = SegmentationNode()
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.autostart()
        interrupt.spin(executor, lambda error: node.reject(error, "message"))
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
