"""Runners: processes that die cost their unit a try and nothing else, and kill -9 costs the units in work."""

import itertools
import multiprocessing
import os
import random
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
from recordings import depth_entries, write_mcap

pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'rcseg[test]'")

from test_batch import rows_of, run, same_tables

from rcseg_core.errors import InputError
from rcseg_ros.batch.runners import LocalRunner
from rcseg_ros.batch.work import OUT_OF_MEMORY, WORK, Outcome

RECORDINGS = 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    for i in range(RECORDINGS):
        write_mcap(folder / f"r{i}.mcap", depth_entries(3))
    (folder / "bad.mcap").write_bytes(b"nothing")
    return folder


@pytest.fixture(scope="module")
def undisturbed(folder, tmp_path_factory):
    output = tmp_path_factory.mktemp("undisturbed") / "out"
    assert len(run(folder, output).faulty) == 1
    return output


#: Audit events of calls that touch files; each is a moment between two states on the disk.
TOUCHES = ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "tempfile.mkdtemp", "shutil.rmtree")


def killed_at_touch(number, folder, output):
    """True where a run in a child died by kill -9 at that touch of a file, false where it was done before."""
    child = os.fork()  # compiled kernels and all: it is at work at once
    if child:
        status = os.waitpid(child, 0)[1]
        assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0
        return os.WIFSIGNALED(status)
    left = number

    def die(event, arguments):
        nonlocal left
        if event in TOUCHES and str(output) in str(arguments[0]):
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(die)
    status = 1
    try:
        status = len(run(folder, output).faulty) - 1
    finally:
        os._exit(status)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a forked child")
def test_after_kill_9_at_ten_moments_the_tables_are_those_of_an_undisturbed_run(
    folder, undisturbed, tmp_path
):
    moments, kills = random.Random(5), 0
    outputs = (tmp_path / f"out{i}" for i in itertools.count())
    while kills < 10:
        output = next(outputs)
        # A unit takes some 40 touches. A run that has no unit left is done, and the next begins anew.
        while kills < 10 and killed_at_touch(moments.randint(1, 120), folder, output):
            kills += 1
        (fault,) = run(folder, output).faulty
        assert fault.unit == "bad-00000"
        same_tables(undisturbed, output)
        assert not list((output / WORK).iterdir())


class Killer(LocalRunner):
    """Kills a worker after each of the first frames that it hears of."""

    def __init__(self, times):
        self.left = times
        super().__init__(2, on_frame=self.kill)

    def kill(self):
        if self.left:
            self.left -= 1
            victim = next(worker for worker in self._workers if worker.task is not None)
            os.kill(victim.process.pid, signal.SIGKILL)


def test_a_worker_that_is_killed_costs_its_unit_a_try_and_nothing_else(folder, undisturbed, tmp_path):
    runner = Killer(2)
    try:
        summary = run(folder, tmp_path / "out", runner, retries=2)
    finally:
        runner.close()
    assert [one.unit for one in summary.faulty] == ["bad-00000"]
    assert runner.left == 0
    # A try for each of seven, two more for the bad one, one for each that died unless it was done by then.
    assert 9 <= sum(one.attempt for one in summary.outcomes.values()) <= 11
    same_tables(undisturbed, tmp_path / "out")


def test_memory_is_bounded_and_who_needs_more_is_told(folder, tmp_path):
    runner = LocalRunner(1, memory_mb=60)
    try:
        (fault,) = run(folder / "r0.mcap", tmp_path / "out", runner, retries=0).faulty
    finally:
        runner.close()
    assert "memory" in fault.reason.lower() or "worker process" in fault.reason, fault.reason


def test_workers_end_when_their_parent_is_killed(folder, tmp_path):
    program = (
        "import os, sys\nfrom rcseg_ros.batch.runners import LocalRunner\n"
        "if __name__ == '__main__':\n"
        "    runner = LocalRunner(1)\n    print(runner._workers[0].process.pid, flush=True)\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    (tmp_path / "program.py").write_text(program)
    done = subprocess.run([sys.executable, tmp_path / "program.py"], capture_output=True, text=True)
    worker = int(done.stdout)
    for _ in range(200):
        try:
            os.kill(worker, 0)
        except ProcessLookupError:
            return
        if b"(defunct)" in subprocess.run(["ps", "-p", str(worker)], capture_output=True).stdout:
            return
        time.sleep(0.1)
    pytest.fail("the worker lives on")


def test_ctrl_c_ends_with_130_and_what_is_done_stays(folder, undisturbed, tmp_path):
    command = [
        sys.executable,
        "-m",
        "rcseg_ros.cli",
        "batch",
        folder,
        "-o",
        tmp_path / "out",
        "--workers",
        "1",
    ]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    while not list((tmp_path / "out" / "tables").glob("*/*/unit.json")) and process.poll() is None:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode in (130, 3), errors  # 3: all was done by then
    assert "Traceback" not in errors
    run(folder, tmp_path / "out")
    same_tables(undisturbed, tmp_path / "out")


@pytest.fixture(scope="module")
def ray_cluster():
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'rcseg[ray]'")
    from ray.cluster_utils import Cluster

    memory = {"object_store_memory": 80 * 2**20, "memory": 8 * 10**9}
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 3, "include_dashboard": False, **memory}
    )
    yield cluster.address
    ray.shutdown()
    cluster.shutdown()


def test_a_ray_cluster_gives_the_same_tables_with_workers_killed_twice(
    ray_cluster, folder, undisturbed, tmp_path
):
    from rcseg_ros.batch.ray_runner import RayRunner

    class RayKiller(RayRunner):
        """Kills the process that did a unit, most likely with another in work, twice."""

        left, victims = 2, []

        def wait(self):
            outcome = super().wait()
            if self.left and outcome.process and self._tasks:
                self.left -= 1
                self.victims.append(outcome.process)
                os.kill(outcome.process, signal.SIGKILL)
            return outcome

    runner = RayKiller(ray_cluster, cpus=1, memory_mb=1000)
    try:
        assert runner.slots == 3
        summary = run(folder, tmp_path / "out", runner, retries=3)
    finally:
        runner.close()
    assert [one.unit for one in summary.faulty] == ["bad-00000"]
    assert len(set(runner.victims)) == 2
    same_tables(undisturbed, tmp_path / "out")
    assert {row["recording"] for row in rows_of(tmp_path / "out", "frames")} == {f"r{i}" for i in range(6)}


def test_an_address_without_a_cluster_is_refused_in_a_line():
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'rcseg[ray]'")
    from rcseg_ros.batch.ray_runner import RayRunner

    with pytest.raises(InputError, match=r"^--address 127.0.0.1:1: no Ray cluster answers there"):
        RayRunner("127.0.0.1:1")


def test_a_worker_that_ran_out_of_memory_is_another_afterwards():
    runner = LocalRunner(1)
    try:
        worker = runner._workers[0]
        worker.pipe.close()
        worker.pipe, there = multiprocessing.Pipe()
        worker.task = task = SimpleNamespace(unit="r0-00000", attempt=1)
        there.send(Outcome(task.unit, f"{OUT_OF_MEMORY}: give each worker more"))
        outcome = runner.wait()
        assert outcome.reason.startswith("out of memory")
        assert not worker.process.is_alive()
        assert runner._workers[0].process.is_alive() and runner._workers[0].task is None
    finally:
        runner.close()
