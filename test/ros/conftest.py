"""Fixtures of the tests over live topics; tests that need no ROS do not use them."""

from __future__ import annotations

import sys

import pytest

from rcseg_ros.live.shared_memory import clear_dead_segments


@pytest.fixture(scope="session", autouse=True)
def shared_memory():
    """Leave nothing in /dev/shm, and no node running: what is killed, then or before, cannot clean up."""
    clear_dead_segments()
    yield
    module = sys.modules.get("live")
    for node in module.NodeProcess.started if module else ():
        node.process.kill()
        node.process.wait()
    clear_dead_segments()


@pytest.fixture(scope="module")
def live():
    """The module test/ros/live.py, or a skip where rclpy or the built messages are missing."""
    pytest.importorskip(
        "rclpy", reason="rclpy is not installed: run `make test`, or source a ROS 2 installation"
    )
    pytest.importorskip(
        "rcseg_msgs.msg", reason="rcseg_msgs is not built: run `make test`, or build it with colcon"
    )
    import live as module

    return module


@pytest.fixture
def run(live, tmp_path):
    """Start nodes of given names, each with a peer; they end with the test, with exit code 0."""
    processes, peers = [], []

    def start(name, parameters=None, outputs=tuple(live.OUTPUTS), *, active=True, **peer_options):
        remaps = {"__node": name, **live.input_topics(name)}
        process = live.NodeProcess(tmp_path / f"{name}.txt", parameters, remaps)
        processes.append(process)  # before anything can fail: it must end with the test
        if active:
            process.wait_for_output("active")
        peers.append(live.Peer(name, outputs, **peer_options))
        return process, peers[-1]

    yield start
    for peer in peers:
        peer.close()
    stopped = [process.stop()[0] for process in processes]  # all of them, before any is judged
    for code, process in zip(stopped, processes, strict=True):
        assert code == 0, process.output()
        assert "Traceback" not in process.output(), process.output()


@pytest.fixture(scope="module")
def node(live, tmp_path_factory):
    """An active node that all tests of a module share."""
    process = live.NodeProcess(tmp_path_factory.mktemp("node") / "log.txt")
    yield process
    code, _ = process.stop()
    assert code == 0, process.output()


@pytest.fixture(scope="module")
def peer(live, node):
    """A peer that is connected to the shared node."""
    node.wait_for_output("active")
    peer = live.Peer()
    peer.connected("points", "image", "camera_info", "depth")
    yield peer
    peer.close()
