"""Colcon workspaces in tests, the ROS wheels standing in for an installed ROS."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PREFIX = Path(sys.prefix)
NEEDED = ("rosidl_generator_py", "ament_package")


def need_colcon() -> None:
    """Skip the test where no workspace can be built."""
    if not shutil.which("colcon", path=f"{PREFIX}/bin") or not all(map(importlib.util.find_spec, NEEDED)):
        pytest.skip("needs colcon and the ROS generators: run `make test`")


def build(folder: Path, project: str, timeout_s: float) -> dict[str, str]:
    """`colcon build` there; the environment that has sourced the result.

    `project` has the messages: two definitions make up for the wheels, a ROS installation needs neither.
    """
    libraries = [PREFIX / "lib", *PREFIX.glob("lib/python*/site-packages/ros_*.libs")]
    environment = os.environ | {
        "PATH": f"{PREFIX}/bin{os.pathsep}{os.environ['PATH']}",
        "AMENT_PREFIX_PATH": str(PREFIX),
        "CMAKE_PREFIX_PATH": str(PREFIX),
        "LD_LIBRARY_PATH": os.pathsep.join(map(str, libraries)),
        "COLCON_HOME": str(folder / ".colcon"),
    }
    include = ROOT / "rcseg_msgs" / "cmake" / "drop_missing_includes.cmake"
    command = ["colcon", "build", "--executor", "sequential", "--cmake-args", "-G", "Ninja"]
    command += [f"-DPython3_EXECUTABLE={sys.executable}", f"-DCMAKE_PROJECT_{project}_INCLUDE={include}"]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=timeout_s
    )
    assert done.returncode == 0, done.stdout + done.stderr
    sourced = subprocess.run(
        ["bash", "-c", "source install/setup.bash && env -0"],
        cwd=folder, env=environment, capture_output=True, timeout=60, check=True,
    )  # fmt: skip
    return dict(entry.split("=", 1) for entry in sourced.stdout.decode().split("\0") if "=" in entry)
