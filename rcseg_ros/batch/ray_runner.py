"""Ray as a runner: tasks go to the processes of a cluster, rows of figures come back.

No image passes through Ray's object store: a task reads its recording from storage that all nodes see, and
writes its tables there.
"""

from __future__ import annotations

import socket
from typing import Any

from rcseg_core.errors import InputError
from rcseg_ros.batch.work import Outcome, Task, run_unit
from rcseg_ros.tables.extras import need_ray


class RayRunner:
    """The processors of a Ray cluster.

    Parameters
    ----------
    address : of the cluster, as ray.init takes it ("auto", "ray://head:10001"); empty: one of this machine
    workers : most tasks at a time; 0: as many as the cluster has processors for, also when nodes come and go
    cpus, memory_mb : that Ray sets aside for each task

    Raises
    ------
    InputError
        If there is no Ray, or no cluster at the address.
    """

    def __init__(self, address: str = "", workers: int = 0, cpus: float = 1.0, memory_mb: int = 2000) -> None:
        need_ray()
        import ray

        self._ray = ray
        self._owner = not ray.is_initialized()
        _reach(address)
        try:
            if self._owner:
                ray.init(
                    address or None,
                    num_cpus=None if address else workers or None,
                    include_dashboard=None if address else False,
                    log_to_driver=False,
                )
        except Exception as error:  # no server, another version, another Python
            raise InputError(
                f"--address {address or 'local'}: no Ray cluster: {' '.join(str(error).split())}"
            ) from None
        self._most, self._cpus = workers, cpus
        # Tried again by whoever submits, as with every runner: so all failures are counted alike.
        self._run = ray.remote(num_cpus=cpus, memory=memory_mb * 10**6, max_retries=0)(_run_alone)
        self._tasks: dict[Any, Task] = {}

    @property
    def slots(self) -> int:
        there = int(self._ray.cluster_resources().get("CPU", 0) / self._cpus)
        return max(1, min(self._most or there, there))

    def submit(self, task: Task) -> None:
        self._tasks[self._run.remote(task)] = task

    def wait(self) -> Outcome:
        (done, *_), _ = self._ray.wait(list(self._tasks))
        task = self._tasks.pop(done)
        try:
            outcome: Outcome = self._ray.get(done)
        except self._ray.exceptions.RayError as error:
            what = " ".join(str(error).split()) or type(error).__name__
            return Outcome(task.unit, f"{type(error).__name__}: {what[:300]}", attempt=task.attempt)
        return outcome

    def close(self) -> None:
        for reference in self._tasks:
            self._ray.cancel(reference, force=True)
        self._tasks.clear()
        if self._owner:
            self._ray.shutdown()


def _reach(address: str) -> None:
    """Raise InputError where nobody answers at HOST:PORT; Ray itself would go on trying for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        return
    try:
        socket.create_connection((host, int(port)), timeout=10).close()
    except OSError as error:
        raise InputError(
            f"--address {address}: no Ray cluster answers there: {error.strerror or error}; `ray status` on "
            "its head tells the address"
        ) from None


def _run_alone(task: Task) -> Outcome:
    """A task in a process of the cluster, which shares its processors with others."""
    from rcseg_ros.batch.runners import single_thread

    single_thread()
    return run_unit(task)
