"""A run over 200 recordings, ten of them damaged: killed and restarted, on Ray, beside other engines.

    python benchmarks/batch.py kill      # kill -9 at ten random moments: the tables are those of a quiet run
    python benchmarks/batch.py ray       # the same on a Ray cluster of three nodes, a worker killed twice
    python benchmarks/batch.py engines   # local, job array, Ray, Dask: seconds, processes, their memory
    python benchmarks/batch.py rate      # the local runner beside segment() alone; on a quiet machine
    python benchmarks/batch.py plan      # planning and listing of a thousand recordings; what a unit costs

Recordings are cuts of bags/tabletop, every n-th pixel of it (--step), and copies of the other bundled ones.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from rcseg_core import SegmenterConfig, segment
from rcseg_core.compute.parallel import cores
from rcseg_ros.batch.inputs import find_inputs
from rcseg_ros.batch.options import BatchOptions
from rcseg_ros.batch.run import BatchRequest, plan_batch, run_batch
from rcseg_ros.batch.runners import LocalRunner, single_thread
from rcseg_ros.batch.work import Outcome, Task, run_unit
from rcseg_ros.recordings.bag import Recording
from rcseg_ros.recordings.result_bag import BagWriter, serialize
from rcseg_ros.recordings.topics import find_topics
from rcseg_ros.tables.parquet import open_table
from rcseg_ros.tables.schema import TABLES, columns
from rcseg_ros.warmup import warm_up

BAGS = Path(__file__).resolve().parents[1] / "bags"
CONFIG = SegmenterConfig.preset("fast")
DAMAGED = 10


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("what", choices=("kill", "ray", "engines", "plan", "rate"))
    options.add_argument("--count", type=int, default=200, help="recordings")
    options.add_argument("--frames", type=int, default=2, help="most frames of one")
    options.add_argument("--step", type=int, default=2, help="every n-th pixel")
    options.add_argument("--kills", type=int, default=10)
    given = options.parse_args()
    warm_up(CONFIG, print)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if given.what == "rate":
            rate(folder, max(given.frames, 12))
            return
        many = given.what == "plan"
        make_recordings(folder / "in", 20 if many else given.count, given.frames, given.step)
        {"kill": kill, "ray": on_ray, "engines": engines, "plan": planning}[given.what](folder, given)


def make_recordings(folder: Path, count: int, frames: int, step: int) -> None:
    """`count` recordings, the last ten of them damaged, each in another way."""
    folder.mkdir()
    moments = small_frames(step)
    choose = random.Random(0)
    for i in range(count):
        first, number = choose.randrange(len(moments) - frames + 1), choose.randint(1, frames)
        write(folder / f"r{i:04d}", moments[first : first + number])
    for i, damage in enumerate(damages()):
        target = folder / f"r{count - 1 - i:04d}"
        damage(target, next(target.glob("*.mcap")))


def small_frames(step: int) -> list[list[tuple[Any, int, Any]]]:
    """Topic, time and message of every frame of bags/tabletop, with every n-th pixel."""
    moments: dict[int, list[tuple[Any, int, Any]]] = {}
    with Recording(BAGS / "tabletop") as recording:
        for raw in recording.messages(find_topics(recording, {}).names()):
            message, topic = recording.decode(raw), recording.topics[raw.topic]
            if topic.type.endswith("CameraInfo"):
                message.k = message.k / np.r_[[step] * 6, [1] * 3]
                message.p = message.p / np.r_[[step] * 8, [1] * 4]
            else:
                rows = np.asarray(message.data).reshape(message.height, -1, message.step // message.width)
                rows = np.ascontiguousarray(rows[::step, ::step])
                message.data, message.step = rows.reshape(-1), rows.shape[1] * rows.shape[2]
            message.height, message.width = message.height // step, message.width // step
            moments.setdefault(raw.stamp_ns, []).append((topic, raw.log_ns, message))
    return list(moments.values())


def write(target: Path, moments: list[list[tuple[Any, int, Any]]]) -> None:
    with BagWriter(target) as bag:
        for topic, log_ns, message in (entry for moment in moments for entry in moment):
            bag.write(topic.name, topic.type, serialize(message), log_ns)


def damages() -> list[Any]:
    """Ten ways to damage a recording: a folder and its mcap."""

    def changed(change: Any) -> Any:
        def apply(folder: Path, file: Path) -> None:
            data = bytearray(file.read_bytes())
            file.write_bytes(bytes(change(data)))

        return apply

    def overwritten(data: bytearray) -> bytearray:
        data[len(data) // 4 : len(data) // 2] = bytes(len(data) // 4)
        return data

    def gone(folder: Path, file: Path) -> None:
        file.unlink()

    def twice(folder: Path, file: Path) -> None:
        text = (folder / "metadata.yaml").read_text().replace("message_count: ", "message_count: 9")
        (folder / "metadata.yaml").write_text(text.replace(file.name, "lost.mcap"))

    return [
        changed(lambda data: data[: len(data) // 2]),
        changed(lambda data: data[:40]),
        changed(lambda data: b""),
        changed(lambda data: b"no recording " * 100),
        changed(lambda data: bytes(len(data))),
        changed(lambda data: data[: len(data) * 9 // 10]),
        changed(lambda data: data[len(data) // 10 :]),
        changed(overwritten),
        gone,
        twice,
    ]


def request_for(folder: Path, output: Path, retries: int = 1) -> BatchRequest:
    return BatchRequest((str(folder / "in"),), output, BatchOptions(CONFIG), retries)


def command(folder: Path, output: Path, *more: str) -> list[str]:
    start = [sys.executable, "-m", "rcseg_ros.cli", "batch", str(folder / "in")]
    return [*start, "-o", str(output), "--preset", "fast", *more]


def kill(folder: Path, given: argparse.Namespace) -> None:
    quiet = folder / "quiet"
    start = time.perf_counter()
    done = subprocess.run(command(folder, quiet), capture_output=True, text=True)
    seconds = time.perf_counter() - start
    print(done.stdout)
    assert done.returncode == 3, done.stderr
    figures(quiet)
    choose, killed = random.Random(1), []
    whole = units(quiet)
    for after in sorted(choose.sample(range(1, whole - 1), given.kills)):
        process = subprocess.Popen(
            command(folder, folder / "killed"), start_new_session=True, stdout=-3, stderr=-3
        )
        while process.poll() is None and units(folder / "killed") < after:
            time.sleep(0.01)
        time.sleep(choose.uniform(0, seconds / whole))  # somewhere in the units that come next
        assert process.poll() is None, "it ended before it could be killed"
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        killed.append(units(folder / "killed"))
    again = subprocess.run(command(folder, folder / "killed"), capture_output=True, text=True)
    assert again.returncode == 3, again.stderr
    print(f"units that were whole after each kill -9: {killed}")
    compare(quiet, folder / "killed")


def units(output: Path) -> int:
    return len(list((output / "tables").glob("*/*/unit.json")))


def compare(one: Path, other: Path) -> None:
    """Row for row, all columns but those that are measured anew."""
    for table in TABLES:
        names = [column.name for column in columns(table) if not column.varies]
        rows = [open_table(output, table).to_table(columns=names).to_pylist() for output in (one, other)]
        np.testing.assert_equal(rows[0], rows[1], err_msg=table)
        print(f"  {table}: {len(rows[0])} rows, the same in both")


def figures(output: Path) -> None:
    """What units cost, as they say themselves."""
    documents = [json.loads(file.read_text()) for file in (output / "tables").glob("*/*/unit.json")]
    done = [document["outcome"] for document in documents]
    size = sum(sum(document["files"].values()) for document in documents)
    frames = sum(one["frames"] for one in done)
    spent = {name: sum(one[name] for one in done) for name in ("cpu_s", "segment_cpu_s")}
    print(
        f"{len(done)} units, {frames} frames; a unit beside its frames "
        f"{1e3 * median(one['overhead_s'] for one in done):.0f} ms (median of wall time); processor time a "
        f"frame {1e3 * spent['cpu_s'] / frames:.1f} ms, of it segment() "
        f"{1e3 * spent['segment_cpu_s'] / frames:.1f}; {size / frames / 1e3:.1f} kB of tables a frame; "
        f"at most {max(one['peak_mb'] for one in done):.0f} MB"
    )


def on_ray(folder: Path, given: argparse.Namespace) -> None:
    from ray.cluster_utils import Cluster

    from rcseg_ros.batch.ray_runner import RayRunner

    class Killer(RayRunner):
        """Kills a process that has done a unit and is at another, twice, a third of the way apart."""

        seen, at, victims = 0, [given.count // 3, 2 * given.count // 3], []

        def wait(self) -> Outcome:
            outcome = super().wait()
            self.seen += 1
            if self.at and self.seen >= self.at[0] and outcome.process:
                self.at.pop(0)
                self.victims.append(outcome.process)
                os.kill(outcome.process, signal.SIGKILL)
            return outcome

    run(folder, folder / "quiet")
    room = {"object_store_memory": 80 * 2**20, "memory": 4 * 10**9, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **room})
    for _ in range(3):
        cluster.add_node(num_cpus=1, **room)
    runner = Killer(cluster.address, memory_mb=1000)
    summary = run(folder, folder / "ray", runner, retries=3)
    cluster.shutdown()
    twice = [one.unit for one in summary.outcomes.values() if one.attempt > 1 and not one.reason]
    print(f"killed processes {runner.victims}; units that were tried again and done: {twice}")
    compare(folder / "quiet", folder / "ray")


def run(folder: Path, output: Path, runner: Any = None, retries: int = 1) -> Any:
    request = request_for(folder, output, retries)
    plan = plan_batch(request)
    runner = runner or LocalRunner(2)
    try:
        summary = run_batch(request, plan, runner)
    finally:
        runner.close()
    print(f"{len(summary.outcomes)} units, {len(summary.faulty)} faulty, {summary.seconds:.1f} s")
    return summary


def rate(folder: Path, frames: int) -> None:
    """Frames a second of the local runner, tables written, beside processors x segment() of one thread."""
    from replay_rate import decoded, lengthen

    config, number = SegmenterConfig(), cores()
    warm_up(config, print)
    lengthen(None, folder / "warm" / "r0", 1)
    lengthen(None, folder / "in" / "r0", frames)
    for i in range(1, 2 * number):
        shutil.copytree(folder / "warm" / "r0", folder / "warm" / f"r{i}")
        shutil.copytree(folder / "in" / "r0", folder / "in" / f"r{i}")
    single_thread()
    images = [frame for _, frame, _ in decoded(folder / "in" / "r0")]
    segment(images[0], config)
    start = time.perf_counter()
    for image in images:
        segment(image, config)
    alone = len(images) / (time.perf_counter() - start)
    runner = LocalRunner(number)
    try:
        for what in ("warm", "in"):  # workers load kernels and libraries with the first
            request = BatchRequest((str(folder / what),), folder / f"{what}_out", BatchOptions(config))
            summary = run_batch(request, plan_batch(request), runner)
    finally:
        runner.close()
    reached = summary.frames / summary.seconds
    print(
        f"segment() alone, one thread: {alone:.2f} frames/s; {number} workers with tables: {reached:.2f}, "
        f"{reached / (number * alone):.0%} of {number} x that"
    )
    figures(folder / "in_out")


class DaskRunner:
    """Dask behind the same calls, to compare; not part of rcseg."""

    slots = 2

    def __init__(self) -> None:
        from distributed import Client, LocalCluster

        self._cluster = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
        self._client = Client(self._cluster)
        self._tasks: dict[Any, Task] = {}

    def submit(self, task: Task) -> None:
        self._tasks[self._client.submit(run_unit, task, pure=False, retries=0)] = task

    def wait(self) -> Outcome:
        from distributed import wait

        done = next(iter(wait(list(self._tasks), return_when="FIRST_COMPLETED").done))
        task = self._tasks.pop(done)
        error = done.exception()
        return done.result() if error is None else Outcome(task.unit, repr(error), attempt=task.attempt)

    def close(self) -> None:
        self._client.close()
        self._cluster.close()


def engines(folder: Path, given: argparse.Namespace) -> None:
    """Each engine with two workers on the same recordings: start, run, memory of what it keeps running."""
    import psutil

    from rcseg_ros.batch.ray_runner import RayRunner

    makers = {
        "local": lambda: LocalRunner(2),
        "dask": DaskRunner,
        "ray": lambda: RayRunner(workers=2, memory_mb=1000),
    }
    shards = [command(folder, folder / "array", "--workers", "1", "--shard", f"{i}/2") for i in (1, 2)]
    start = time.perf_counter()
    for process in [subprocess.Popen(shard, stdout=-3, stderr=-3) for shard in shards]:
        process.wait()
    print(f"array   {time.perf_counter() - start:6.1f} s in all, no process beside the workers")
    for name, make in makers.items():
        start = time.perf_counter()
        runner = make()
        ready = time.perf_counter() - start
        request = request_for(folder, folder / name)
        summary = run_batch(request, plan_batch(request), runner)
        whole = time.perf_counter() - start
        children = psutil.Process().children(recursive=True)
        memory = sum(child.memory_full_info().uss for child in children) / 1e6
        number = len(children)
        runner.close()
        print(
            f"{name:7s} {whole:6.1f} s in all, ready after {ready:.1f} s; {len(summary.faulty)} faulty; "
            f"{number} processes, {memory:.0f} MB of their own"
        )
        compare(folder / "array", folder / name)


def planning(folder: Path, given: argparse.Namespace) -> None:
    for i in range(20, given.count):
        shutil.copytree(folder / "in" / f"r{i % 10:04d}", folder / "in" / f"r{i:04d}")
    start = time.perf_counter()
    found = find_inputs([str(folder / "in")])
    listed = time.perf_counter() - start
    request = request_for(folder, folder / "out")
    times = []
    for _ in range(3):
        start = time.perf_counter()
        plan_batch(request)
        times.append(time.perf_counter() - start)
    shutil.copytree(folder / "in" / "r0000", folder / "in" / "more")
    start = time.perf_counter()
    plan_batch(request)
    added = time.perf_counter() - start
    print(
        f"{len(found)} recordings: listed in {listed:.2f} s, planned in {times[0]:.2f} s, again in "
        f"{times[-1]:.2f} s, with one more in {added:.2f} s"
    )


if __name__ == "__main__":
    main()
