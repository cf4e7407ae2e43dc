"""A colcon build of the repository as a ROS user runs it, the ROS wheels standing in for an installed ROS."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from workspaces import ROOT, build, need_colcon


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """A workspace laid out as docs/ros.md says, built; (folder, environment that has sourced it)."""
    need_colcon()
    folder = tmp_path_factory.mktemp("workspace")
    source = folder / "src" / "rcseg"
    for part in (
        "rcseg_core",
        "rcseg_ros",
        "rcseg_msgs",
        "launch",
        "config",
        "resource",
        "docs",
        "benchmarks",
    ):
        ignored = shutil.ignore_patterns("__pycache__", "build", "*.egg-info")
        shutil.copytree(ROOT / part, source / part, ignore=ignored, symlinks=True)
    for name in (
        "setup.py",
        "setup.cfg",
        "package.xml",
        "pyproject.toml",
        "README.md",
        "Makefile",
        "colcon_defaults.yaml",
    ):
        shutil.copy(ROOT / name, source)
    (folder / "src" / "rcseg_msgs").symlink_to("rcseg/rcseg_msgs")
    return folder, build(folder, "rcseg_msgs", 900)


@pytest.mark.parametrize("inside", [".", "src", "src/rcseg"])
def test_both_packages_are_found(workspace, inside):
    """From a workspace and inside the repository, without any option."""
    folder, environment = workspace
    listed = subprocess.run(
        ["colcon", "list"], cwd=folder / inside, env=environment, capture_output=True, text=True, check=True
    )
    assert {line.split()[0] for line in listed.stdout.splitlines()} == {"rcseg_msgs", "rcseg_ros"}


def test_both_packages_are_built(workspace):
    folder, _ = workspace
    assert (folder / "install" / "rcseg_msgs" / "share" / "rcseg_msgs" / "package.xml").is_file()
    share = folder / "install" / "rcseg_ros" / "share" / "rcseg_ros"
    for name in (
        "launch/segment.launch.py",
        "config/default.yaml",
        "config/sensors/kinect_v1.yaml",
        "package.xml",
    ):
        assert (share / name).is_file()


def test_the_built_messages_are_used(workspace):
    folder, environment = workspace
    code = (
        "import rcseg_core, rcseg_msgs, rcseg_ros\n"
        "from rclpy.serialization import deserialize_message, serialize_message\n"
        "from rcseg_msgs.msg import Region, RegionArray\n"
        "back = deserialize_message(serialize_message(RegionArray(regions=[Region(label=7)])), RegionArray)\n"
        "print(rcseg_core.__file__, rcseg_msgs.__file__, rcseg_ros.__file__, back.regions[0].label)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd="/", env=environment, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    *files, label = done.stdout.split()
    assert all(Path(file).is_relative_to(folder / "install") for file in files) and label == "7"


def test_a_build_of_links_works_too(workspace, tmp_path):
    folder, environment = workspace
    build = ["colcon", "build", "--symlink-install", "--packages-select", "rcseg_ros"]
    build += ["--executor", "sequential", "--build-base", str(tmp_path / "build")]
    build += ["--install-base", str(tmp_path / "install")]
    shutil.copytree(folder / "install" / "rcseg_msgs", tmp_path / "install" / "rcseg_msgs", symlinks=True)
    done = subprocess.run(build, cwd=folder, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "install" / "rcseg_ros" / "share" / "rcseg_ros" / "launch").is_dir()
    build = tmp_path / "build" / "rcseg_ros"
    assert (build / "rcseg_core" / "py.typed").is_file()
    code = (
        "from rcseg_ros.recordings.result_bag import definition_text\n"
        "print(definition_text('rcseg_msgs/msg/Region'))"
    )
    linked = {**environment, "PYTHONPATH": f"{build}{os.pathsep}{environment['PYTHONPATH']}"}
    done = subprocess.run([sys.executable, "-c", code], env=linked, capture_output=True, text=True)
    assert "BezierPatch range_patch" in done.stdout, done.stderr


def test_the_executable_is_where_ros2_run_looks(workspace):
    folder, environment = workspace
    executable = folder / "install" / "rcseg_ros" / "lib" / "rcseg_ros" / "segmentation_node"
    process = subprocess.Popen(
        [executable, "--ros-args", "-p", "autostart:=false", "-p", "no.such:=1"],
        env=environment, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    # Said when the node is made: from then on a signal ends it without a traceback.
    assert b"unknown parameter no.such" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0, output.decode()
