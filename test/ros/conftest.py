"""Fixtures of the tests over live topics; tests that need no ROS do not use them."""

from __future__ import annotations

import pytest


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
    started = []

    def start(name, parameters=None, outputs=tuple(live.OUTPUTS), *, active=True, **peer_options):
        remaps = {"__node": name, **live.input_topics(name)}
        process = live.NodeProcess(tmp_path / f"{name}.txt", parameters, remaps)
        if active:
            process.wait_for_output("active")
        peer = live.Peer(name, outputs, **peer_options)
        started.append((process, peer))
        return process, peer

    yield start
    for _, peer in started:
        peer.close()
    for process, _ in started:
        code, _ = process.stop()
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
