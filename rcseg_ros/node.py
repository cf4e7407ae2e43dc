"""The lifecycle node `rcseg`: wiring of topics, pairing, worker and publishers; all else is in modules of
its own.

The executor's thread only pairs and enqueues. One worker thread decodes, segments and publishes the labels,
another the results that follow, so services and timers answer while a frame is in work. Nothing that arrives
on a topic ends the node: it is counted by its reason, shown in /diagnostics and warned of once a throttle
period.
"""

from __future__ import annotations

import os
import sys
import time
from dataclasses import dataclass
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType, JumpThreshold
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from rcseg_core.errors import ConfigError, RcsegError
from rcseg_ros.frames.assembly import assemble
from rcseg_ros.frames.conversions import Header, header_of
from rcseg_ros.frames.extrinsic import rigid
from rcseg_ros.frames.reading import Reading
from rcseg_ros.frames.registration import Surroundings
from rcseg_ros.frames.sync import Pair
from rcseg_ros.live.bridges import NodeBridges
from rcseg_ros.live.health import Health, noise_values
from rcseg_ros.live.hearing import Complaint
from rcseg_ros.live.inputs import Inputs
from rcseg_ros.live.manners import (
    Interrupt,
    answer_during_transitions,
    answer_impossible_transitions,
    answer_meanwhile,
    in_short,
    shut_down,
    told,
)
from rcseg_ros.live.naming import Naming
from rcseg_ros.live.parameters import NodeParameters
from rcseg_ros.live.publishers import OVERRIDABLE, ResultPublishers
from rcseg_ros.live.shared_memory import clear_dead_segments, clear_own_segments
from rcseg_ros.live.transforms import TransformListener
from rcseg_ros.live.transport import prepare_transport
from rcseg_ros.live.up import UpListener, settings_of
from rcseg_ros.live.worker import Worker
from rcseg_ros.results.messages import make_rcl
from rcseg_ros.warmup import warm_up

SUCCESS = TransitionCallbackReturn.SUCCESS
STOP_TIMEOUT_S = 0.5  # for each of the two workers


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
        self._active = False
        self._configured: list[Any] = []  # what on_configure made, undone in reverse order
        self._inputs: Any = None
        answer_impossible_transitions(self)
        answer_during_transitions(self)
        self._diagnostics = self.create_publisher(
            DiagnosticArray, "/diagnostics", 10, qos_overriding_options=OVERRIDABLE
        )
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
        """Release everything, in whatever state; a frame in work is given up after a second at most."""
        self._active = False
        self._tear_down()

    # Lifecycle.

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            self._set_up()
        except Exception as error:
            if self.context.ok():  # else it was told to end in the middle of it
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
        self.health.count("dropped.deactivated", len(self._worker.clear()))
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
        self._geometry = ""
        self._extrinsic = rigid(
            parameters["input.extrinsic_translation"], parameters["input.extrinsic_rotation"]
        )
        self._transforms = TransformListener(self, moving=parameters["input.use_tf"])
        self._configured.append(self._transforms.destroy)
        self._up = UpListener(self, settings_of(parameters), self._transforms, parameters["qos.depth"])
        self._configured.append(self._up.destroy)
        self._up.review(parameters.config.world.up_from)
        self.get_logger().info(f"configured in {self._compile():.1f} s")
        self._naming = Naming(self, parameters, self._transforms.tree)
        self._configured.append(self._naming.destroy)
        self._results = ResultPublishers(self, NodeBridges(parameters))
        self._configured.append(self._results.destroy)
        self._finisher = Worker(self._finish, "publish")
        self._configured.append(lambda: self._finisher.stop(STOP_TIMEOUT_S))
        self._worker = Worker(self._process, "segment")
        self._configured.append(lambda: self._worker.stop(STOP_TIMEOUT_S))
        self._inputs = Inputs(self, parameters, self.health, self._enqueue, self.reject)
        self._configured.append(self._inputs.destroy)

    def _compile(self) -> float:
        """Ready the kernels; seconds. Services and diagnostics answer meanwhile."""

        def announce(text: str) -> None:
            self.get_logger().info(text)
            self.health.progress(text)

        try:
            return answer_meanwhile(self, lambda: warm_up(self.parameters.config, announce))
        finally:
            self.health.progress("")

    def _tear_down(self) -> None:
        while self._configured:
            self._configured.pop()()
        self._inputs = None

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
            pair, reading = task.pair, Reading.of(self.parameters.__getitem__)
            made = assemble(
                pair.range, pair.color, pair.camera, pair.range_camera, self._surroundings(pair), reading
            )
            started_s = time.monotonic()
            header = Header(header_of(pair.range).stamp_ns, made.frame_id)
            result = self._naming.segment(made.frame, header, config)
            segment_s = time.monotonic() - started_s
            if self._active:
                if str(made.geometry) != self._geometry:
                    self._geometry = str(made.geometry)
                    self.get_logger().info(f"camera: {self._geometry}")
                up = self._up.source.at(config.world.up_from, header.frame_id, header.stamp_ns)
                messages = self._results.messages(header, made.frame, result, str(made.geometry), up)
                if not self.parameters["tracks.label_images"]:  # names are not waited for
                    self._results.publish_labels(messages)
                messages.named = self._naming.name(messages, header, result, self._results.wants_tracks)
                if self.parameters["tracks.label_images"]:
                    self._results.publish_labels(messages)
                latency_s = time.monotonic() - task.arrived_s
                self.health.published(latency_s, segment_s, made.geometry.values() | noise_values(result))
                self._finisher.put_in_turn(messages)
            else:
                self.health.count("dropped.deactivated")
        except Exception as error:
            self.reject(error, "frame")

    def _finish(self, messages: Any) -> None:
        """All but the labels, on a thread of its own: the next frame is segmented meanwhile."""
        try:
            self._results.publish_rest(messages)
            if messages.known_world is not None:
                self._up.judge(messages.known_world, messages.told, self.health)
        except Exception as error:
            self.reject(error, "frame")

    def _surroundings(self, pair: Pair) -> Surroundings:
        """What is known beside the messages of a pair."""
        parameters, inputs = self.parameters, self._inputs
        return Surroundings(
            range_topic=inputs.name_of("points" if hasattr(pair.range, "fields") else "depth"),
            color_topic=inputs.name_of("image"),
            images=parameters["input.images"],
            assume_registered=parameters["input.assume_registered"],
            extrinsic=self._extrinsic,
            transforms=self._transforms.tree,
            prefer_image=parameters["input.color_from"] == "image",
        )

    # Health.

    def reject(self, error: Exception, where: str) -> None:
        """Count what cannot be used, and warn of it once a throttle period."""
        if (
            not self.context.ok()
        ):  # it was told to end, so that calls of the middleware fail: no fault of the input
            return
        known = isinstance(error, RcsegError)
        reason = getattr(error, "reason", "invalid_frame") if known else f"internal_{type(error).__name__}"
        if self.health.reject(reason, str(error), self.parameters["diagnostics.warn_period_s"]):
            self.get_logger().warning(f"{where} rejected ({reason}): {error}")

    def _report(self) -> None:
        if not self.context.ok():
            return
        listening = self._inputs is not None
        drops = self._inputs.drops if listening else {}
        complaint = self._review() if listening else None
        if self.health.complain(complaint):
            self.get_logger().warning(complaint.text)
        status = self.health.status(f"{self.get_name()}: segmentation", self._state(), drops, make_rcl)
        stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(
            DiagnosticArray(header=make_rcl("std_msgs/msg/Header", stamp=stamp), status=[status])
        )

    def _review(self) -> Complaint | None:
        """Fit the subscriptions to what there is; why nothing is published, or what is doubtful, if so."""
        try:
            self._up.review(self.parameters.config.world.up_from)
        except ConfigError as error:  # asked for while active
            return Complaint("up_unheard", str(error))
        return self._inputs.review() or (None if self.health.silent else self._up.complaint)

    def _state(self) -> str:
        return str(self._state_machine.current_state[1])

    def _log_failure(self, what: str, error: Exception) -> None:
        known = isinstance(error, RcsegError)
        self.get_logger().error(f"cannot {what}: {error if known else repr(error)}")


def main(args: list[str] | None = None) -> int:
    """Run the node until it is told to stop; exit code 0, or 2 where an argument cannot be used."""
    interrupt = Interrupt()
    prepare_transport(os.environ)
    clear_dead_segments()
    try:
        rclpy.init(args=args)
    except Exception as error:  # arguments are parsed there, parameter files read
        print(f"segmentation_node: {in_short(error)}", file=sys.stderr)
        return 2
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
    except Exception:
        if rclpy.ok():  # else it was told to end in the middle of a transition, which cannot be published now
            raise
    finally:
        if node is not None:
            node.close()
            node.destroy_node()
        shut_down()
    # Python would wait for the threads of a frame that was given up, and take a second to free the kernels.
    sys.stdout.flush()
    sys.stderr.flush()
    clear_own_segments()  # a transition in work keeps the participant alive
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
