"""Package rcseg: for pip by this file alone, for colcon (ROS package rcseg_ros) together with package.xml."""

from glob import glob
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py

ROS_PACKAGE = "rcseg_ros"
SOURCES = Path(__file__).resolve().parent  # colcon build --symlink-install runs a link to this file
GENERATORS = [
    "ament-cmake",
    "ament-cmake-gmock",
    "ament-cmake-gtest",
    "ament-cmake-include-directories",
    "ament-cmake-pytest",
    "ament-cmake-ros",
    "ament-package",
    "domain-coordinator",
    "fastrtps-cmake-module",
    "gmock-vendor",
    "gtest-vendor",
    "python-cmake-module",
    "rosidl-core-generators",
    "rosidl-default-generators",
    "rosidl-typesupport-fastrtps-c",
    "rosidl-typesupport-fastrtps-cpp",
]


class BuildWithDefinitions(build_py):
    """The message definitions travel with the package as rcseg_ros/msg: result bags are written by them."""

    def run(self) -> None:
        super().run()
        if not getattr(self, "editable_mode", False):  # an editable install finds them where they are
            folder = Path(self.build_lib) / ROS_PACKAGE / "msg"
            self.mkpath(str(folder))
            for file in sorted((SOURCES / "rcseg_msgs" / "msg").glob("*.msg")):
                self.copy_file(str(file), str(folder / file.name))


setup(
    name="rcseg",
    version="0.1.0",
    description="Segments registered range and colour images into Bezier patches",
    long_description=(SOURCES / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    author="rcseg maintainers",
    author_email="rcseg@example.org",
    license="Apache-2.0",
    python_requires=">=3.10",
    packages=find_packages(include=["rcseg_core", "rcseg_core.*", "rcseg_ros", "rcseg_ros.*"]),
    package_data={"rcseg_core": ["py.typed"], "rcseg_ros.commands": ["page.html"]},
    cmdclass={"build_py": BuildWithDefinitions},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{ROS_PACKAGE}"]),
        (f"share/{ROS_PACKAGE}", ["package.xml"]),
        (f"share/{ROS_PACKAGE}/launch", glob("launch/*.launch.py")),
        (f"share/{ROS_PACKAGE}/config", glob("config/*.*")),
        (f"share/{ROS_PACKAGE}/config/sensors", glob("config/sensors/*.yaml")),
    ],
    install_requires=[
        "numpy>=1.26",
        "scipy>=1.10",
        "numba>=0.59",
        "opencv-python-headless>=4.6",
        "matplotlib>=3.6",
        "shapely>=2.0",
        "pyyaml>=6.0",
        "typer>=0.9",
        "rich>=13.0",
        "rosbags>=0.11",
        "mcap>=1.1",
        "zstandard>=0.19",
    ],
    extras_require={
        "test": [
            "pytest>=8.0",
            "pytest-xdist>=3.5",
            "hypothesis>=6.90",
            "mcap-ros2-support>=0.5",
            "imgviz>=2.0",
            "foxglove-sdk>=0.16",
            # Runs over many recordings, on a Ray cluster too, and queries of their tables.
            "pyarrow>=15",
            "ray>=2.9",
            "fsspec>=2024.2",
            "duckdb>=1.0",
            "polars>=1.0",
            # Only these wheels go with numpy 2; tests that compare with it are skipped elsewhere.
            'gtsam>=4.3; python_version >= "3.11" and platform_machine == "x86_64"',
        ],
        "dev": ["ruff>=0.6", "mypy>=1.10", "import-linter>=2.0", "codespell>=2.2", "pre-commit>=3.5"],
        "batch": ["pyarrow>=15"],
        "ray": ["pyarrow>=15", "ray>=2.9"],
        "remote": ["fsspec>=2024.2"],
        "view": ["foxglove-sdk>=0.16"],
        # Triangles of polygons where shapely is older than 2.1, as in Ubuntu 24.04.
        "triangles": ["mapbox_earcut>=1.0"],
        # A peer of `rcseg bench`; it takes Open3D too where that is installed, which is too heavy to ask for.
        "bench": ["scikit-image>=0.22"],
        "ros": ["ros-jazzy-rclpy[fastrtps]", "ros-jazzy-common-interfaces"],
        # What `colcon build` needs of a ROS installation, as wheels: only to test that build.
        "colcon": [
            "catkin_pkg",
            "cmake>=3.20,<4",
            "colcon-common-extensions>=0.3",
            "colcon-defaults>=0.2.7",
            "ninja",
            *(f"ros-jazzy-{name}" for name in GENERATORS),
        ],
    },
    entry_points={
        "console_scripts": [
            "rcseg = rcseg_ros.cli:main",
            "segmentation_node = rcseg_ros.node:main",
        ]
    },
    zip_safe=False,
)
