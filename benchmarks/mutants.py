"""Do the tests notice faults? Small ones are drawn and put into a copy of the sources, one at a time.

    python benchmarks/mutants.py [--count 200] [--seed 0] [--only sync] [--list]

A fault is another comparison or operator, `or` for `and`, a constant that is one more or less, a negated
condition, a return without its value, a call or an assignment that is left out. The count is spread evenly
over the modules of JUDGES, each judged by the test files named beside it, up to the first that fails; a run
that takes five times the processor time of one without fault, or hangs, has noticed. Kernels run interpreted
at first, without the tests that take minutes so; what escapes there is judged once more, compiled and with
all tests. What no test notices is listed with its line.

Each judgement is a fork of this process, which has the libraries loaded: all that it costs are the tests.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import importlib.util
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from mutations import Fault, count_faults, fault, plain, spoilt

ROOT = Path(__file__).resolve().parents[1]


RECORDINGS = ["ros/test_bag.py", "ros/test_storage.py"]
#: Module and the tests that are to notice.
JUDGES = {
    "rcseg_core/config.py": ["core/test_config.py"],
    "rcseg_core/frame.py": ["core/test_frame.py"],
    "rcseg_core/datasets.py": ["core/test_datasets.py"],
    "rcseg_core/evaluation/hoover.py": ["core/test_evaluation_hoover.py"],
    "rcseg_core/evaluation/metrics.py": ["core/test_evaluation.py"],
    "rcseg_core/models/bezier.py": ["core/test_bezier.py"],
    "rcseg_core/result/description.py": ["core/test_description.py"],
    "rcseg_core/tracking/matching.py": ["core/test_tracking.py"],
    "rcseg_core/tracking/registry.py": ["core/test_tracking.py"],
    "rcseg_core/world/up.py": ["core/test_world_up.py"],
    "rcseg_ros/frames/assembly.py": ["ros/test_assembly.py", "ros/test_cameras.py"],
    "rcseg_ros/frames/cameras.py": ["ros/test_cameras.py", "ros/test_conversions.py"],
    "rcseg_ros/frames/conversions.py": [
        "ros/test_conversions.py", "ros/test_cameras.py", "ros/test_units.py",
    ],
    "rcseg_ros/frames/depth_images.py": ["ros/test_depth_images.py", "ros/test_encodings.py"],
    "rcseg_ros/frames/expansion.py": ["ros/test_expansion.py"],
    "rcseg_ros/frames/images.py": ["ros/test_encodings.py", "ros/test_conversions.py"],
    "rcseg_ros/frames/pixels.py": [
        "ros/test_conversions.py", "ros/test_encodings.py", "ros/test_expansion.py",
    ],
    "rcseg_ros/frames/point_clouds.py": ["ros/test_conversions.py", "ros/test_units.py"],
    "rcseg_ros/frames/rvl.py": ["ros/test_depth_images.py", "ros/test_expansion.py"],
    "rcseg_ros/frames/scaling.py": ["ros/test_scaling.py"],
    "rcseg_ros/frames/sync.py": ["ros/test_sync.py"],
    "rcseg_ros/frames/up.py": ["ros/test_up.py", "ros/test_world_messages.py"],
    "rcseg_ros/live/shared_memory.py": ["ros/test_shared_memory.py"],
    "rcseg_ros/recordings/bag.py": RECORDINGS,
    "rcseg_ros/recordings/layout.py": RECORDINGS,
    "rcseg_ros/recordings/mcap_file.py": RECORDINGS,
    "rcseg_ros/recordings/sqlite_file.py": RECORDINGS,
    "rcseg_ros/recordings/staging.py": ["ros/test_staging.py"],
    "rcseg_ros/recordings/storage.py": RECORDINGS,
    "rcseg_ros/settings.py": ["core/test_config.py", "ros/test_cli.py"],
}  # fmt: skip
#: Modules of kernels likewise.
KERNELS = {
    "rcseg_core/decision/evidence.py": ["core/test_evidence.py", "core/test_grouping.py"],
    "rcseg_core/decision/generalization.py": ["core/test_generalization.py", "core/test_grouping.py"],
    "rcseg_core/graph/adjacency.py": ["core/test_adjacency.py"],
    "rcseg_core/graph/continuity.py": ["core/test_continuity.py"],
    "rcseg_core/graph/grouping.py": ["core/test_grouping.py", "core/test_hierarchy.py"],
    "rcseg_core/graph/hierarchy.py": ["core/test_hierarchy.py", "core/test_grouping.py"],
    "rcseg_core/models/moments.py": ["core/test_moments.py", "core/test_planes.py"],
    "rcseg_core/models/planes.py": ["core/test_planes.py", "core/test_moments.py"],
    "rcseg_core/pixels/borders.py": ["core/test_borders.py"],
    "rcseg_core/pixels/gaps.py": ["core/test_gaps.py"],
    "rcseg_core/registration.py": ["core/test_registration.py"],
    "rcseg_core/result/extents.py": ["core/test_extents.py"],
    "rcseg_core/result/rendering.py": ["core/test_rendering.py"],
    "rcseg_core/signal/cleaning.py": ["core/test_cleaning.py"],
    "rcseg_core/tracking/kernels.py": ["core/test_tracking_kernels.py"],
    "rcseg_core/world/outlines.py": ["core/test_world_outlines.py"],
}
#: Once more for those, compiled.
WHOLE = ["core/test_partition.py", "core/test_segmentation.py", "core/test_pipeline.py"]
#: Loaded once, before the forks.
LIBRARIES = [
    "cv2",
    "hypothesis",
    "matplotlib.figure",
    "mcap.reader",
    "numba",
    "numpy",
    "pytest",
    "rich.console",
    "rosbags.rosbag2",
    "rosbags.typesys",
    "scipy.ndimage",
    "scipy.optimize",
    "scipy.sparse.csgraph",
    "scipy.spatial",
    "scipy.stats",
    "shapely",
    "typer",
    "yaml",
    "zstandard",
]
MEMORY = 8 << 30


class Judgement(NamedTuple):
    """How the tests of a module ended: pytest's exit code, None where they were ended; processor seconds."""

    code: int | None
    seconds: float

    @property
    def noticed(self) -> bool:
        if self.code == 5:
            raise SystemExit("no test was run")
        return self.code != 0


def judge(copied: Path, tests: list[str], interpreted: bool, limit_s: float) -> Judgement:
    """Run the tests in a fork; it is ended after so much processor time, or thirty times that."""
    child = os.fork()
    if not child:
        os.setsid()
        _run(copied, tests, interpreted, limit_s)
    end, waited = time.monotonic() + 30 * limit_s, 0.01
    while True:
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() > end:
            os.killpg(child, signal.SIGKILL)
        time.sleep(waited := min(1.2 * waited, 0.5))
    with contextlib.suppress(ProcessLookupError):  # what the tests started
        os.killpg(child, signal.SIGKILL)
    code = os.waitstatus_to_exitcode(status)
    return Judgement(code if code >= 0 else None, usage.ru_utime + usage.ru_stime)


def _run(copied: Path, tests: list[str], interpreted: bool, limit_s: float) -> None:
    """In the fork: pytest, its words to a file."""
    log = os.open(copied / "log.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(log, stream)
    resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s), int(limit_s) + 5))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    arguments = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-m", "not alone"]
    if interpreted:
        import numba

        os.environ["NUMBA_DISABLE_JIT"] = "1"
        numba.config.DISABLE_JIT = True
        arguments += ["-k", f"not ({_slow(copied)})"]
    code = 70
    try:
        import pytest

        code = int(pytest.main([*arguments, *(f"test/{name}" for name in tests)]))
    finally:
        os._exit(code)


def _slow(copied: Path) -> str:
    """What test_interpreted.py leaves out."""
    tree = ast.parse((copied / "test/core/test_interpreted.py").read_text("utf-8"))
    return next(
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign)
        and isinstance(node.targets[0], ast.Name)
        and node.targets[0].id == "SLOW"
    )


class Bench:
    """The copy, and how long the tests of a module take without a fault."""

    def __init__(self, folder: Path) -> None:
        self.copied = folder / "rcseg"
        ignored = shutil.ignore_patterns(".git", ".venv", "__pycache__", "build", "*.egg-info", ".hypothesis")
        shutil.copytree(ROOT, self.copied, ignore=ignored, symlinks=True)
        compile_all = [sys.executable, "-m", "compileall", "-q", "--invalidation-mode", "unchecked-hash"]
        subprocess.run([*compile_all, "rcseg_core", "rcseg_ros"], cwd=self.copied, check=True)
        os.chdir(self.copied)
        sys.path.insert(0, str(self.copied))
        os.environ |= {"PYTHONPATH": str(self.copied), "PYTHONDONTWRITEBYTECODE": "1"}
        sys.dont_write_bytecode = True
        for name in LIBRARIES:
            importlib.import_module(name)
        assert "rcseg_core" not in sys.modules
        self._limits: dict[tuple[str, bool], float] = {}

    def notices(self, module: str, source: str) -> bool:
        """Whether the tests fail with that source of the module."""
        if module not in KERNELS:
            return self._noticed(module, source, JUDGES[module], False)
        return self._noticed(module, source, KERNELS[module], True) or self._noticed(
            module, source, [*KERNELS[module], *WHOLE], False
        )

    def _noticed(self, module: str, source: str, tests: list[str], interpreted: bool) -> bool:
        key = " ".join(tests), interpreted
        if key not in self._limits:
            without = self._with(module, plain(self.copied / module), tests, interpreted, 1200)
            if without.code != 0:
                print((self.copied / "log.txt").read_text(errors="replace")[-3000:])
                raise SystemExit(f"{module}: its tests fail without any fault")
            self._limits[key] = 5 * without.seconds + 20
        return self._with(module, source, tests, interpreted, self._limits[key]).noticed

    def _with(
        self, module: str, source: str, tests: list[str], interpreted: bool, limit_s: float
    ) -> Judgement:
        file = self.copied / module
        compiled = Path(importlib.util.cache_from_source(str(file)))
        kept, kept_compiled = file.read_bytes(), compiled.read_bytes()
        file.write_text(source, "utf-8")
        compiled.unlink()
        try:
            return judge(self.copied, tests, interpreted, limit_s)
        finally:
            file.write_bytes(kept)
            compiled.write_bytes(kept_compiled)


def drawn(count: int, seed: int, only: str) -> list[Fault]:
    """Faults, evenly from the modules whose name holds a part of `only`."""
    modules = [module for module in [*JUDGES, *KERNELS] if any(part in module for part in only.split(","))]
    found: list[Fault] = []
    for number, module in enumerate(modules):
        possible = count_faults(ROOT, module)
        share = min((count + len(modules) - 1 - number) // len(modules), possible)
        numbers = random.Random(f"{seed} {module}").sample(range(possible), share)
        found += [fault(ROOT, module, number) for number in numbers]
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="parts of modules' names, with commas between")
    parser.add_argument("--list", action="store_true", help="show the faults alone")
    options = parser.parse_args()
    chosen = drawn(options.count, options.seed, options.only)
    total = sum(count_faults(ROOT, module) for module in [*JUDGES, *KERNELS])
    print(f"{len(chosen)} of {total} faults, of {len({one.module for one in chosen})} modules", flush=True)
    if options.list:
        print("\n".join(map(str, chosen)))
        return 0
    started, escaped = time.monotonic(), []
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        for one in chosen:
            found = bench.notices(one.module, spoilt(bench.copied, one))
            escaped += [] if found else [one]
            print(f"{'caught ' if found else 'ESCAPED'} {one}", flush=True)
    caught, minutes = len(chosen) - len(escaped), (time.monotonic() - started) / 60
    print(
        f"{caught} of {len(chosen)} caught, {100 * caught / max(len(chosen), 1):.1f} %, {minutes:.0f} minutes"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
