"""Build the messages against the ROS wheels of PyPI, so that `pip install ./rcseg_msgs` works without ROS.

setuptools runs the same CMakeLists.txt that colcon runs, installs it into a scratch tree, and ships that
tree: the Python package as the wheel's package, everything else (libraries, headers, ament index) as data
files, which pip lays into the environment's prefix. The environment thereby stays the ament prefix that the
wheels make of it.
"""

import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

HERE = Path(__file__).resolve().parent
PACKAGE = "rcseg_msgs"


def ament_prefix() -> Path:
    """Prefix that the generators' wheels lie in: pip's build environment, not sys.prefix."""
    for module in ("rosidl_adapter", "rosidl_generator_py"):
        spec = find_spec(module)
        for parent in Path(spec.origin).parents if spec and spec.origin else ():
            if (parent / "share" / "ament_index").is_dir():
                return parent
    raise SystemExit(
        "rcseg_msgs: no ROS interface generators found; install with build isolation, or build with colcon"
    )


def build_environment(prefix: Path) -> dict[str, str]:
    """Return os.environ with the variables by which ament and the linker find the wheels' files."""
    environment = dict(os.environ)
    libraries = [prefix / "lib", *prefix.glob("lib/python*/site-packages/ros_*.libs")]
    inherited = environment.get("LD_LIBRARY_PATH", "")
    environment["LD_LIBRARY_PATH"] = os.pathsep.join([*map(str, libraries), inherited]).rstrip(os.pathsep)
    environment["AMENT_PREFIX_PATH"] = environment["CMAKE_PREFIX_PATH"] = str(prefix)
    environment["PATH"] = os.pathsep.join([str(prefix / "bin"), environment["PATH"]])
    return environment


class CMakeBuild(build_ext):
    """Run cmake and turn its install tree into the wheel's package and data files."""

    def run(self) -> None:
        prefix = ament_prefix()
        environment = build_environment(prefix)
        build, stage = Path(self.build_temp).resolve() / "cmake", Path(self.build_temp).resolve() / "stage"
        shutil.rmtree(build, ignore_errors=True)
        shutil.rmtree(stage, ignore_errors=True)
        configure = [
            "cmake", "-S", str(HERE), "-B", str(build), "-G", "Ninja",
            "-DCMAKE_BUILD_TYPE=Release", "-DBUILD_TESTING=OFF", f"-DCMAKE_INSTALL_PREFIX={stage}",
            f"-DPython3_EXECUTABLE={sys.executable}",
            f"-DCMAKE_PROJECT_{PACKAGE}_INCLUDE={HERE / 'cmake' / 'drop_missing_includes.cmake'}",
        ]  # fmt: skip
        subprocess.run(configure, check=True, env=environment)
        subprocess.run(["cmake", "--build", str(build), "--target", "install"], check=True, env=environment)
        self.collect(stage)

    def collect(self, stage: Path) -> None:
        """Copy the generated Python package to build_lib; every other file is data of the prefix."""
        (package,) = stage.rglob(f"*-packages/{PACKAGE}")
        unwanted = shutil.ignore_patterns("__pycache__", "*.c")
        shutil.copytree(package, Path(self.build_lib) / PACKAGE, dirs_exist_ok=True, ignore=unwanted)
        python_tree = package.parent
        folders: dict[str, list[str]] = {}
        for path in sorted(stage.rglob("*")):
            if path.is_file() and python_tree not in path.parents:
                folders.setdefault(str(path.parent.relative_to(stage)), []).append(
                    os.path.relpath(path, HERE)
                )
        self.distribution.data_files = list(folders.items())


setup(
    packages=[],
    ext_modules=[Extension(PACKAGE, sources=[])],  # marks the wheel as compiled and starts CMakeBuild
    cmdclass={"build_ext": CMakeBuild},
)
