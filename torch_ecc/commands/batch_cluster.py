"""The Dask cluster that a batch runs on: one here, one at an address, or a client of the caller's own; and what must be
true of it before any work. Loaded into the workers here, it leaves Ctrl-C to the process that started them."""

from __future__ import annotations

import logging
import secrets
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torch_ecc.commands.batch_unit import DECIDING, WORK, same_versions
from torch_ecc.io.summary import versions

if TYPE_CHECKING:
    from distributed import Client

PATIENCE = 20.0  # s to wait for a scheduler, and for its first worker
CLOSING = 3.0  # s that it may take to say goodbye
GPU = "GPU"  # the resource that a worker with one has
PROFILE = "distributed.worker.profile.enabled"  # what Dask keeps of a long call grows by the second


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
    from distributed import Client, LocalCluster

    with dask.config.set({PROFILE: False}):
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            memory_limit=0,  # frames are streamed: what a recording needs does not grow
            dashboard_address="127.0.0.1:0",
            silence_logs=logging.CRITICAL,
            resources={GPU: 1} if gpu else None,
            preload=[__name__],
        )
    with cluster, Client(cluster, set_as_default=False) as client:
        yield client


def dask_setup(worker: Any) -> None:
    """Called by Dask in the main thread of a worker here: a Ctrl-C in its terminal goes to all processes there."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def cores() -> int:
    """As many as this process may use."""
    from dask.system import CPU_COUNT

    return int(CPU_COUNT)


def check_cluster(client: Client, out: Path, *, gpu: bool) -> None:
    """ValueError, in words, for a cluster without workers, with other versions, without a GPU where one is wanted, or
    that does not see the folder ``out``."""
    from distributed import TimeoutError as Late

    address = client.scheduler.address if client.scheduler else "?"
    nobody = ValueError(f"scheduler: no worker has joined {address}: dask worker {address} starts one")
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    except Late:
        raise nobody from None
    probe = out / WORK / f"probe-{secrets.token_hex(4)}"
    probe.write_text(probe.name)
    try:
        found = client.run(_look, str(probe), on_error="return")
    finally:
        probe.unlink()
    found = {worker: seen for worker, seen in found.items() if not isinstance(seen, OSError)}  # those have left
    if not found:
        raise nobody
    for worker, seen in found.items():
        _check_worker(worker, seen, out)
    if gpu and not any(GPU in seen["resources"] for seen in found.values()):
        raise ValueError(f"device: no worker has the resource {GPU}: dask worker {address} --resources {GPU}=1")


def _look(probe: str, dask_worker: Any) -> dict[str, Any]:
    """What a worker is, and sees of a file."""
    seen = False
    with suppress(OSError):
        path = Path(probe)
        seen = path.read_text() == path.name
    return {"versions": versions(), "seen": seen, "resources": list(dask_worker.state.total_resources)}


def _check_worker(worker: str, seen: Any, out: Path) -> None:
    if isinstance(seen, ModuleNotFoundError):
        raise ValueError(f"scheduler: the worker {worker} cannot import torch_ecc ({seen}): install it there, too")
    if isinstance(seen, BaseException):
        raise ValueError(f"scheduler: the worker {worker} fails: {seen}")
    if not same_versions(seen["versions"], here := versions()):
        told = " and ".join(f"{name} {seen['versions'].get(name)} (here: {here[name]})" for name in DECIDING)
        raise ValueError(f"scheduler: the worker {worker} has {told}: results would depend on who makes them")
    if not seen["seen"]:
        raise ValueError(f"out: the worker {worker} does not see {out}: choose a folder that all computers share")


def dashboard_of(client: Client) -> str | None:
    """Dask's page about the cluster, if there is one: bokeh draws it."""
    there = find_spec("bokeh") if client.cluster else client.scheduler_info().get("services", {}).get("dashboard")
    return str(client.dashboard_link) if there else None
