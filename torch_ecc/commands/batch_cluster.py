"""The Dask cluster that a batch runs on: one here, one at an address, or a client of the caller's own; and what must be
true of it before any work. Loaded into the workers here, it leaves Ctrl-C to the process that started them."""

from __future__ import annotations

import asyncio
import concurrent.futures
import logging
import secrets
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from multiprocessing import current_process
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch_ecc.commands.batch_unit import DECIDING, WORK, same_versions
from torch_ecc.io.summary import versions

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

CANCELLED = (asyncio.CancelledError, concurrent.futures.CancelledError)  # either, when a scheduler goes
PATIENCE = 20.0  # s to wait for a scheduler, and for its first worker
CLOSING = 3.0  # s that it may take to say goodbye
GPU = "GPU"  # the resource that a worker with one has
HERE = {
    "distributed.worker.profile.enabled": False,  # what Dask keeps of a long call grows by the second
    "distributed.deploy.lost-worker-timeout": "1 day",  # one that takes longer to start again would never be replaced
}


def need_dask() -> None:
    """ValueError, in words, where it is not installed."""
    if find_spec("distributed") is None:
        raise ValueError("batch: Dask is not installed: pip install 'torch-ecc[cluster]'")


@contextmanager
def connected(scheduler: str | None, workers: int, *, gpu: bool) -> Iterator[Client]:
    """A client of the cluster at the address ``scheduler``, or of one here with so many ``workers`` of one thread each,
    which ends with it."""
    if scheduler is None:
        with _here(workers, gpu=gpu) as client:
            yield client
        return
    from distributed import Client
    from distributed import TimeoutError as Late

    with _quiet():
        try:
            client = Client(scheduler, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError) as error:
            how = "dask scheduler starts one, and says its address"
            raise ValueError(f"scheduler: nobody answers at {scheduler} ({how}; {type(error).__name__})") from error
        try:
            yield client
        finally:
            with suppress(Late):  # it is looking for a scheduler that is gone
                client.close(timeout=CLOSING)


@contextmanager
def _quiet() -> Iterator[None]:
    """What Dask would say is said in other words here."""
    logger = logging.getLogger("distributed.client")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)


@contextmanager
def _here(workers: int, *, gpu: bool) -> Iterator[Client]:
    import dask
    from distributed import Client

    with dask.config.set(HERE), _workers(workers, gpu=gpu) as cluster, Client(cluster, set_as_default=False) as client:
        yield client


def _workers(count: int, *, gpu: bool) -> LocalCluster:
    """Processes here. ValueError if they cannot be started."""
    from distributed import LocalCluster

    try:
        return LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            memory_limit=0,  # frames are streamed: what a recording needs does not grow
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
            resources={GPU: 1} if gpu else None,
            preload=[__name__],
        )
    except RuntimeError as error:
        how = "in a script, the call must stand under if __name__ == '__main__':"
        raise ValueError(f"workers: they cannot be started here ({error}); {how}") from None


def leave_bootstrapping() -> None:
    """End a process that is being started as a worker here and runs the script that started it, down to its batch."""
    if getattr(current_process(), "_inheriting", False):
        sys.exit(1)


def dask_setup(worker: Any) -> None:
    """Called by Dask in the main thread of a worker here: a Ctrl-C in its terminal goes to all processes there."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def cores() -> int:
    """As many as this process may use."""
    from dask.system import CPU_COUNT

    return int(CPU_COUNT)


def check_cluster(client: Client, out: Path, say: Callable[[str], None], *, gpu: bool) -> Guard:
    """Wait until there is a worker; what it gives looks at those that come later. ValueError, in words, for a cluster
    with workers of other versions, without a GPU where one is wanted, or that do not see the folder ``out``."""
    address = client.scheduler.address if client.scheduler else "?"
    _wait_for_one(client, lambda: say(f"No worker has joined {address} yet: dask worker {address} starts one. Waiting"))
    found = _seen(client, out, list(client.nthreads()))
    for worker, seen in found.items():
        if wrong := _misfit(worker, seen, out):
            raise ValueError(wrong)
    if gpu and not any(GPU in seen["resources"] for seen in found.values()):
        raise ValueError(f"device: no worker has the resource {GPU}: dask worker {address} --resources {GPU}=1")
    return Guard(client, out, say, set(found))


def _wait_for_one(client: Client, late: Callable[[], None]) -> None:
    """By a call for it: some clusters have workers only while there is work. ``late`` is called if it takes long."""
    from distributed import TimeoutError as Late

    name = ("torch_ecc.first", secrets.token_hex(4))
    try:
        first = client.submit(bool, key=name, pure=False)
        try:
            first.result(timeout=PATIENCE)
        except Late:
            late()
            first.result()
    except CANCELLED as error:
        raise ConnectionError("scheduler: it is gone") from error


@dataclass
class Guard:
    """The workers of ``client`` that are ``known`` to fit; others may join at any time."""

    client: Client
    out: Path
    say: Callable[[str], None]
    known: set[str]

    def __call__(self) -> None:
        """Send those away that have joined and do not fit: they would be done with everything in no time."""
        now = set(self.client.nthreads())
        for worker, seen in _seen(self.client, self.out, list(now - self.known)).items():
            if wrong := _misfit(worker, seen, self.out):
                self.say(f"Sent away: {wrong}")
                self.client.retire_workers([worker])
        self.known = now


def _seen(client: Client, out: Path, workers: list[str]) -> dict[str, Any]:
    """What those of ``workers`` say that have not left."""
    if not workers:
        return {}
    probe = out / WORK / f"probe-{secrets.token_hex(4)}"
    probe.write_text(probe.name)
    try:
        found = client.run(_look, str(probe), workers=workers, on_error="return")
    finally:
        probe.unlink()
    return {worker: seen for worker, seen in found.items() if not isinstance(seen, OSError)}


def _look(probe: str, dask_worker: Any) -> dict[str, Any]:
    """What a worker is, and sees of a file."""
    seen = False
    with suppress(OSError):
        path = Path(probe)
        seen = path.read_text() == path.name
    return {"versions": versions(), "seen": seen, "resources": list(dask_worker.state.total_resources)}


def _misfit(worker: str, seen: Any, out: Path) -> str | None:
    """What is wrong with a worker; None if nothing is."""
    if isinstance(seen, ModuleNotFoundError):
        return f"scheduler: the worker {worker} cannot import torch_ecc ({seen}): install it there, too"
    if isinstance(seen, BaseException):
        return f"scheduler: the worker {worker} fails: {seen}"
    if not same_versions(seen["versions"], here := versions()):
        told = " and ".join(f"{name} {seen['versions'].get(name)} (here: {here[name]})" for name in DECIDING)
        return f"scheduler: the worker {worker} has {told}: results would depend on who makes them"
    if not seen["seen"]:
        return f"out: the worker {worker} does not see {out}: choose a folder that all computers share"
    return None


def dashboard_of(client: Client) -> str | None:
    """Dask's page about the cluster, if there is one: bokeh draws it."""
    there = find_spec("bokeh") if client.cluster else client.scheduler_info().get("services", {}).get("dashboard")
    return str(client.dashboard_link) if there else None
