"""Node manners that rclpy leaves undone: transitions that say what failed and let others be answered,
requests that cannot raise, signals.

Without these an impossible transition, a fault in a conversion or Ctrl-C in the middle of a message would
end a node with a traceback.
"""

from __future__ import annotations

import contextlib
import functools
import re
import signal
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, TypeVar

import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

N = TypeVar("N", bound=LifecycleNode)
T = TypeVar("T")
Transition = Callable[[N, LifecycleState], TransitionCallbackReturn]


def told(transition: Transition[N]) -> Transition[N]:
    """Say what a transition raised: rclpy turns it into an error without a word, then calls on_error."""

    @functools.wraps(transition)
    def telling(node: N, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(node, state)
        except Exception as error:
            node.get_logger().error(f"{transition.__name__} failed: {error!r}")
            return TransitionCallbackReturn.ERROR

    return telling


def answer_impossible_transitions(node: LifecycleNode) -> None:
    """Answer them with failure: rclpy would let them raise in the executor, and end the node."""
    service = node._service_change_state
    change_state = service.callback

    def guarded(request: Any, response: Any) -> Any:
        try:
            return change_state(request, response)
        except Exception as error:
            node.get_logger().warning(f"transition refused: {error}")
            response.success = False
            return response

    service.callback = guarded


def answer_during_transitions(node: LifecycleNode) -> None:
    """Give requests for transitions a group of their own, so that one does not lock out all else."""
    service, group = node._service_change_state, MutuallyExclusiveCallbackGroup()
    service.callback_group.entities.discard(weakref.ref(service))
    service.callback_group = group
    group.add_entity(service)


def answer_meanwhile(node: LifecycleNode, work: Callable[[], T]) -> T:
    """Do long work on a thread while the node's executor goes on; its result, or what it raised."""
    outcome: Future[T] = Future()

    def run() -> None:
        try:
            outcome.set_result(work())
        except BaseException as error:
            outcome.set_exception(error)

    threading.Thread(target=run, name="work of a transition", daemon=True).start()
    while not outcome.done() and node.executor is not None:
        node.executor.spin_once(timeout_sec=0.05)
    return outcome.result()


def in_short(error: Exception) -> str:
    """What rcl says of arguments that it cannot read, in a line and without places in its sources."""
    text = re.sub(r",? at \S+:\d+", "", " ".join(str(error).split()))
    return text.removeprefix("failed to initialize rcl: ")


def shut_down() -> None:
    """End rclpy; a signal's handler on its own thread may be faster between rclpy's look and its act."""
    with contextlib.suppress(rclpy_implementation.RCLError):
        rclpy.try_shutdown()


class Interrupt:
    """SIGINT as KeyboardInterrupt, but for the first while the node spins, which rclpy itself ends then.

    An exception in the middle of a message's conversion would come out as a fault of that message. Make it
    before `rclpy.init`, which passes signals on.
    """

    def __init__(self) -> None:
        self._spinning = False
        signal.signal(signal.SIGINT, self._on_signal)

    def spin(self, executor: SingleThreadedExecutor, on_error: Callable[[Exception], None]) -> None:
        """Spin until the context is shut down; what the executor raises is told, and spinning goes on."""
        self._spinning = True
        while rclpy.ok():
            try:
                executor.spin_once()
            except ExternalShutdownException:
                return
            except Exception as error:
                on_error(error)

    def _on_signal(self, number: int, stack: Any) -> None:
        if not self._spinning:
            signal.default_int_handler(number, stack)
        self._spinning = False
