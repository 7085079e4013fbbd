"""Where studies and fleets run: processes here, or a Dask cluster, both as executors of concurrent.futures."""

from __future__ import annotations

import logging
import os
import signal
import socket
from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import active_children, get_context, parent_process, resource_tracker
from multiprocessing.process import BaseProcess
from threading import Thread
from typing import Any

from accelcal_cli import __version__
from accelcal_cli.errors import DataError

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
ANSWER_TIME = 10.0
"""Seconds that a cluster has to answer."""

LONGEST_GREETING = 1 << 20
"""Bytes of the greeting of a Dask scheduler, at most."""


@contextmanager
def local_pool(jobs: int) -> Iterator[Executor]:
    """Open a pool of processes on this machine, one BLAS thread each; it does not outlive an interruption.

    The worker processes are new ones (spawn): a fork would copy locks and threads in whatever state they are.
    """
    others = active_children()
    with _undisturbed():
        resource_tracker.ensure_running()  # by itself: its start lifts the mask of the interrupt key
    pool = ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=_work)
    try:
        with _worker_surroundings():
            for _ in range(jobs):
                pool.submit(os.getpid)  # starts a worker
        yield pool
    except BaseException:
        with _undisturbed():  # a second key press waits until the workers have gone
            for process in active_children():
                if process not in others:
                    process.terminate()
            pool.shutdown(wait=True, cancel_futures=True)
        raise
    pool.shutdown()


@contextmanager
def _worker_surroundings() -> Iterator[None]:
    """Set what processes started meanwhile inherit: one BLAS thread, no interrupt key and no hangup."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        with _undisturbed():
            yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Hold back what a terminal sends to all processes; those that are started meanwhile never get it."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGHUP})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _work() -> None:
    """Set up a worker: it ends when its parent is gone, however that ended."""
    parent = parent_process()
    if parent is not None:
        Thread(target=_leave_with, args=(parent,), daemon=True).start()


def _leave_with(parent: BaseProcess) -> None:
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)


@contextmanager
def cluster(address: str) -> Iterator[Executor]:
    """Open a Dask cluster as an executor of the concurrent.futures kind.

    Raises:
        DataError: dask is not installed, the address is none, nothing answers there, no worker is there, one runs
            another version of accelcal, or the cluster is lost on the way.
    """
    try:
        import distributed
        from distributed.comm.addressing import get_address_host_port
        from distributed.scheduler import KilledWorker
    except ImportError:
        raise DataError("--cluster needs dask: python -m pip install distributed") from None
    where = f"--cluster {address}"
    try:
        # A client with an address that is none fails too, but is heard once more when it is collected.
        host, port = get_address_host_port(address)
    except ValueError as error:
        raise DataError(f"{where}: expected tcp://host:port ({error})") from None
    if not 0 < port < 65536:
        raise DataError(f"{where}: expected tcp://host:port with a port from 1 to 65535")
    if address.startswith("tls://"):
        _check_certificates(where)
    else:
        _check_speaks(where, host, port)
    connect: Any = distributed.Client
    with _silent("distributed", "distributed.client"):
        try:
            client = connect(address, timeout=ANSWER_TIME, set_as_default=False)
        except OSError as error:
            raise DataError(f"{where}: no Dask scheduler answers there ({error})") from None
        with client:
            _check_workers(client, where)
            try:
                yield client.get_executor(pure=False)
            except KilledWorker:
                raise DataError(f"{where}: a part of the work ends every worker that runs it") from None
            except (CancelledError, OSError):
                raise DataError(f"{where}: the scheduler was lost") from None


def _check_certificates(where: str) -> None:
    """Raise DataError where the configuration of Dask names no certificates, without which tls:// cannot be spoken."""
    import dask.config

    if dask.config.get("distributed.comm.tls.ca-file", None) is None:
        raise DataError(
            f"{where}: tls:// needs certificates; name them in the configuration of Dask "
            "(distributed.comm.tls: ca-file, client.cert, client.key)"
        )


def _check_speaks(where: str, host: str, port: int) -> None:
    """Raise DataError where what answers is no Dask scheduler: it speaks first, the size of its greeting in 8 bytes.

    A client of Dask would wait for minutes.
    """
    try:
        with socket.create_connection((host, port), timeout=ANSWER_TIME) as answering:
            answering.settimeout(ANSWER_TIME)
            head = answering.recv(8, socket.MSG_WAITALL)
    except TimeoutError:
        raise DataError(f"{where}: no Dask scheduler answers there, in {ANSWER_TIME:g} s") from None
    except OSError:
        return  # a scheduler that is just starting: the client waits for it, and tells if it waited in vain
    if len(head) < 8 or int.from_bytes(head, "little") > LONGEST_GREETING:
        raise DataError(f"{where}: another server answers there, not a Dask scheduler")


@contextmanager
def _silent(*names: str) -> Iterator[None]:
    """Keep loggers from printing what is raised as an error anyway."""
    loggers = [logging.getLogger(name) for name in names]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _check_workers(client: Any, where: str) -> None:
    try:
        client.wait_for_workers(1, timeout=ANSWER_TIME)
        versions = set(client.run(_version).values())
    except TimeoutError:
        raise DataError(f"{where}: the scheduler has no workers") from None
    except ImportError as error:
        raise DataError(f"{where}: the workers need accelcal {__version__} ({error})") from None
    if versions != {__version__}:
        other = ", ".join(sorted(versions - {__version__}))
        raise DataError(f"{where}: a worker has accelcal {other}; expected {__version__} as here")


def _version() -> str:
    return __version__
