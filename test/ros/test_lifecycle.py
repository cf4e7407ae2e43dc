"""Lifecycle manners: cycles that leave nothing behind, impossible requests survived, clean exits in
mid-frame."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import numpy as np
import pytest

SECOND = 1_000_000_000
T0 = 1_710_000_000 * SECOND


@pytest.fixture
def idle(run):
    """A node that was not started by itself, with its peer."""
    process, peer = run("idle", {"autostart": False}, active=False)
    return peer, process


def test_cycles_leave_nothing_behind(live, idle):
    peer, process = idle
    frame = live.scene()
    assert peer.state() == "unconfigured"
    # its services may be found before its name is
    live.wait_until(lambda: "idle" in peer.node.get_node_names(), 20)
    topics_before = sorted(peer.node.get_publisher_names_and_types_by_node("idle", "/"))
    for cycle in range(2):
        assert peer.change_state("configure") and peer.state() == "inactive"
        assert peer.change_state("activate") and peer.state() == "active"
        peer.connected("points", "image", "camera_info")
        stamp = T0 + cycle * SECOND
        peer.send(frame, stamp)
        labels = live.image_array(peer.wait_for("labels", stamp))
        np.testing.assert_array_equal(labels, live.expected_labels(frame))
        assert peer.change_state("deactivate") and peer.state() == "inactive"
        received = len(peer.received["labels"])
        peer.send(frame, stamp + SECOND // 2)
        time.sleep(0.5)
        assert len(peer.received["labels"]) == received, "an inactive node published"
        assert peer.change_state("cleanup") and peer.state() == "unconfigured"
        live.wait_until(lambda: not peer.publishers["points"].get_subscription_count(), 10)
        live.wait_until(
            lambda: sorted(peer.node.get_publisher_names_and_types_by_node("idle", "/")) == topics_before, 10
        )
    assert "Traceback" not in process.output()


def test_reactivation_without_cleanup(live, idle):
    peer, _ = idle
    frame = live.scene()
    assert peer.change_state("configure")
    for cycle in range(3):
        assert peer.change_state("activate")
        peer.connected("points", "image", "camera_info")
        peer.send(frame, T0 + cycle)  # the same second each time: pairing starts anew
        peer.wait_for("labels", T0 + cycle)
        assert peer.change_state("deactivate")


def test_impossible_transitions_are_answered_and_survived(idle):
    peer, process = idle
    for label in ("activate", "cleanup", "no such transition"):
        assert not peer.change_state(label)
    assert peer.state() == "unconfigured"
    assert "Traceback" not in process.output()


def test_configure_that_fails_says_why_and_can_be_mended(idle):
    peer, process = idle
    assert peer.set_parameters(input__extrinsic_rotation=[0.0, 0.0, 0.0, 0.0])[0].successful
    assert not peer.change_state("configure")
    assert peer.state() == "unconfigured"
    assert "expected a quaternion that is not zero" in process.output()
    assert peer.set_parameters(input__extrinsic_rotation=[0.0, 0.0, 0.0, 1.0])[0].successful
    assert peer.change_state("configure") and peer.state() == "inactive"


def test_shutdown_transition_ends_the_work_not_the_process(idle):
    peer, process = idle
    assert peer.change_state("configure") and peer.change_state("activate")
    assert peer.change_state("shutdown")
    assert peer.state() == "finalized"
    assert process.process.poll() is None


def test_an_error_in_a_transition_is_told_and_recovered_from(live, monkeypatch, capfd):
    import rclpy
    from rclpy.context import Context

    from rcseg_ros.live.inputs import Inputs
    from rcseg_ros.node import SegmentationNode

    monkeypatch.setenv("ROS_DOMAIN_ID", str(live.DOMAIN))
    context = Context()
    rclpy.init(context=context)
    node = SegmentationNode(context=context)
    monkeypatch.setattr(Inputs, "start", lambda self: 1 / 0)
    node.trigger_configure()
    node.trigger_activate()
    assert node._state_machine.current_state[1] == "unconfigured"
    assert "on_activate failed: ZeroDivisionError" in capfd.readouterr().err
    monkeypatch.undo()
    node.trigger_configure()
    node.trigger_activate()
    assert node._state_machine.current_state[1] == "active"
    node.close()
    node.destroy_node()
    context.try_shutdown()


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_signals_in_mid_frame(live, run, how):
    process, peer = run("doomed", {}, ("labels",))
    peer.connected("points", "image", "camera_info")
    big = live.scene(height=480, width=640)
    for i in range(5):
        peer.send(big, T0 + i * SECOND)
    time.sleep(0.05)
    code, seconds = process.stop(how)
    assert code == 0, process.output()
    assert seconds < 2.0 * live.patience()
    assert "Traceback" not in process.output()
    assert "rejected" not in process.output(), "what fails since the node ends is no fault of a message"


def test_signal_while_unconfigured(live, run):
    process, peer = run("sleeper", {"autostart": False}, (), active=False)
    assert peer.state() == "unconfigured"
    code, seconds = process.stop(signal.SIGTERM)
    assert code == 0 and seconds < 2.0 * live.patience(), process.output()


# A node that is told to end before it spins, and a context that the handler of the signal shuts down between
# the look of try_shutdown and its act.
FASTER_HANDLER = """
import os, signal, sys
from rclpy.context import Context
from rcseg_ros.node import SegmentationNode, main

class Overtaken:
    def __init__(self, handle): self.handle = handle
    def __enter__(self): return self.handle.__enter__()
    def __exit__(self, *what): return self.handle.__exit__(*what)
    def ok(self):
        if self.handle.ok():
            self.handle.shutdown()
        return True
    def shutdown(self):
        print("shut down once more", flush=True)
        self.handle.shutdown()

def overtaken(context):
    context._Context__context = Overtaken(context._Context__context)
    try_shutdown(context)

try_shutdown, Context.try_shutdown = Context.try_shutdown, overtaken
SegmentationNode.autostart = lambda node: os.kill(os.getpid(), signal.SIGINT)
sys.exit(main([]))
"""


def test_a_signal_handler_that_is_faster_is_no_error(live):
    command = [sys.executable, "-c", FASTER_HANDLER]
    done = subprocess.run(command, env=live.environment(), capture_output=True, text=True, timeout=60)
    assert "shut down once more" in done.stdout
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"sync.slop_ms": "wide"}, "sync.slop_ms = 'wide': expected float 0.0 to 10000.0 ms"),
        ({"sync.offset_ms": "later"}, "sync.offset_ms = 'later': expected a number or auto"),
        ({"grouping.range_tolerance": 7.0}, "grouping.range_tolerance = 7.0: expected float 0.0 to 0.5"),
        (
            {"qos.reliability": "perhaps"},
            "qos.reliability = 'perhaps': expected one of auto, reliable, best_effort",
        ),
        ({"preset": "quick"}, "preset = 'quick': expected one of fast, balanced, accurate"),
        ({"seeds.min_window": 13}, "seeds.min_window = 13 is larger than seeds.max_window = 11"),
    ],
)
def test_a_wrong_parameter_at_start_is_one_line_and_exit_code_2(live, tmp_path, parameters, words):
    process = live.NodeProcess(tmp_path / "log.txt", parameters)
    assert process.process.wait(30) == 2
    assert words in process.output()
    assert len(process.output().strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--params-file", "/nowhere.yaml"], "/nowhere.yaml'. Error: Error opening YAML file"),
        (["-p", "input.extrinsic_translation:=[0.5, 0, 1]"], "Sequence should be of same type"),
    ],
)
def test_arguments_that_cannot_be_read_are_one_line_and_exit_code_2(live, arguments, words):
    command = [sys.executable, "-m", "rcseg_ros.node", "--ros-args", *arguments]
    done = subprocess.run(command, env=live.environment(), capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    ours = [line for line in done.stderr.splitlines() if "[rcl]" not in line]  # which says its part first
    assert len(ours) == 1 and words in ours[0], done.stderr


def test_a_misspelt_parameter_is_named(live, tmp_path):
    process = live.NodeProcess(tmp_path / "log.txt", {"autostart": False, "grouping.range_tolerence": 0.01})
    process.wait_for_output("did you mean grouping.range_tolerance?")
    assert process.stop()[0] == 0
