"""What pip installs is complete: packages, message definitions, ament files, commands; versions agree."""

import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Folder of an unpacked wheel, built from a copy so that the source tree stays clean."""
    folder = tmp_path_factory.mktemp("wheel")
    unwanted = shutil.ignore_patterns(
        ".*", "build", "install", "log", "demo", "bags", "test", "*.egg-info", "__pycache__"
    )
    shutil.copytree(REPOSITORY, folder / "source", ignore=unwanted)
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--no-deps",
        "--quiet",
        "--wheel-dir",
        folder,
        folder / "source",
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (file,) = folder.glob("rcseg-*.whl")
    with zipfile.ZipFile(file) as archive:
        archive.extractall(folder / "unpacked")
    return folder / "unpacked"


def test_the_wheel_holds_all_modules_and_message_definitions(wheel):
    for package in ("rcseg_core", "rcseg_ros"):
        for module in (REPOSITORY / package).rglob("*.py"):
            assert (wheel / module.relative_to(REPOSITORY)).is_file(), module
    for message in (REPOSITORY / "rcseg_msgs" / "msg").glob("*.msg"):
        assert (wheel / "rcseg_ros" / "msg" / message.name).read_bytes() == message.read_bytes()
    assert not (wheel / "test").exists() and not (wheel / "rcseg_msgs").exists()


def test_the_wheel_holds_what_ament_looks_for(wheel):
    (data,) = wheel.glob("rcseg-*.data/data")
    assert (data / "share/ament_index/resource_index/packages/rcseg_ros").is_file()
    assert (data / "share/rcseg_ros/package.xml").is_file()
    for file in [*(REPOSITORY / "launch").glob("*.launch.py"), *(REPOSITORY / "config").rglob("*.*")]:
        assert (data / "share/rcseg_ros" / file.relative_to(REPOSITORY)).is_file(), file


def test_both_commands_are_installed(wheel):
    (info,) = wheel.glob("rcseg-*.dist-info")
    entries = (info / "entry_points.txt").read_text()
    assert "rcseg = rcseg_ros.cli:main" in entries
    assert "segmentation_node = rcseg_ros.node:main" in entries


def test_the_installed_package_finds_its_message_definitions(wheel):
    program = (
        "from rcseg_ros.recordings.result_bag import definition_text\n"
        "print(definition_text('rcseg_msgs/msg/Region'))"
    )
    environment = {**os.environ, "PYTHONPATH": str(wheel)}
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=wheel, env=environment, capture_output=True, text=True
    )
    assert "BezierPatch range_patch" in done.stdout, done.stderr


def test_versions_agree():
    versions = {
        ElementTree.parse(REPOSITORY / folder / "package.xml").findtext("version")
        for folder in (".", "rcseg_msgs")
    }
    (version,) = versions
    assert f'version="{version}"' in (REPOSITORY / "setup.py").read_text()
    assert f'version = "{version}"' in (REPOSITORY / "rcseg_msgs" / "pyproject.toml").read_text()
