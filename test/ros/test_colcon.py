"""A colcon build of the repository as a ROS user runs it, the ROS wheels standing in for an installed ROS."""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PREFIX = Path(sys.prefix)
WORD = "needs colcon and the ROS generators: run `make test`"


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """A copy of the sources, built; returns (folder, environment that has sourced it)."""
    if not shutil.which("colcon", path=f"{PREFIX}/bin"):
        pytest.skip(WORD)
    if not importlib.util.find_spec("rosidl_generator_py") or not importlib.util.find_spec("ament_package"):
        pytest.skip(WORD)
    folder = tmp_path_factory.mktemp("workspace")
    parts = ["rcseg_core", "rcseg_ros", "rcseg_msgs", "launch", "config", "resource"]
    for part in parts:
        ignored = shutil.ignore_patterns("__pycache__", "build", "*.egg-info")
        shutil.copytree(ROOT / part, folder / part, ignore=ignored)
    for name in (
        "setup.py",
        "setup.cfg",
        "package.xml",
        "pyproject.toml",
        "README.md",
        "colcon_defaults.yaml",
    ):
        shutil.copy(ROOT / name, folder)
    libraries = [PREFIX / "lib", *PREFIX.glob("lib/python*/site-packages/ros_*.libs")]
    environment = os.environ | {
        "PATH": f"{PREFIX}/bin{os.pathsep}{os.environ['PATH']}",
        "AMENT_PREFIX_PATH": str(PREFIX),
        "CMAKE_PREFIX_PATH": str(PREFIX),
        "LD_LIBRARY_PATH": os.pathsep.join(map(str, libraries)),
        "COLCON_DEFAULTS_FILE": str(folder / "colcon_defaults.yaml"),
        "COLCON_HOME": str(folder / ".colcon"),
    }
    # The two definitions make up for the wheels; a ROS installation needs neither.
    include = folder / "rcseg_msgs" / "cmake" / "drop_missing_includes.cmake"
    build = ["colcon", "build", "--executor", "sequential", "--cmake-args", "-G", "Ninja"]
    build += [f"-DPython3_EXECUTABLE={sys.executable}", f"-DCMAKE_PROJECT_rcseg_msgs_INCLUDE={include}"]
    done = subprocess.run(build, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    sourced = subprocess.run(
        ["bash", "-c", "source install/setup.bash && env -0"],
        cwd=folder, env=environment, capture_output=True, timeout=60, check=True,
    )  # fmt: skip
    pairs = (entry.split("=", 1) for entry in sourced.stdout.decode().split("\0") if "=" in entry)
    return folder, dict(pairs)


def test_both_packages_are_found_and_built(workspace):
    folder, environment = workspace
    listed = subprocess.run(
        ["colcon", "list"], cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    assert {line.split()[0] for line in listed.stdout.splitlines()} == {"rcseg_msgs", "rcseg_ros"}
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


def test_the_executable_is_where_ros2_run_looks(workspace):
    folder, environment = workspace
    executable = folder / "install" / "rcseg_ros" / "lib" / "rcseg_ros" / "segmentation_node"
    process = subprocess.Popen(
        [executable, "--ros-args", "-p", "autostart:=false"],
        env=environment, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    time.sleep(4)
    assert process.poll() is None, process.stdout.read().decode()
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=10)
    assert process.returncode == 0, output.decode()
