"""Node manners that rclpy leaves undone: transitions that say what failed, requests that cannot raise,
signals.

Without these an impossible transition, a fault in a conversion or Ctrl-C in the middle of a message would
end a node with a traceback.
"""

from __future__ import annotations

import functools
import signal
from collections.abc import Callable
from typing import Any, TypeVar

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

N = TypeVar("N", bound=LifecycleNode)
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
                if rclpy.ok():
                    on_error(error)

    def _on_signal(self, number: int, stack: Any) -> None:
        if not self._spinning:
            signal.default_int_handler(number, stack)
        self._spinning = False
