"""Where many independent tasks run: in this process, in processes of this machine, or on the nodes
of a Ray cluster.

All three are a ``map`` with results in the order of the tasks. On a cluster, the tasks of a node
that dies run again elsewhere. Ray (extra ``cluster``) is imported only for a cluster.
"""

import logging
import os
import pickle
import platform
import signal
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from importlib import metadata
from multiprocessing import connection, get_context, parent_process
from typing import Any
from urllib.parse import urlsplit
from uuid import uuid4

from fpp_ml_bench.errors import PoolError
from fpp_ml_bench.files import cause_of
from fpp_ml_bench.machine import single_threaded_algebra

RETRIES = 5
"""A task is started again so often when its process or node died."""
CONNECTION_S = 5.0
Map = Callable[..., Iterable[Any]]
_DECIDE_RESULTS = "fpp-ml-bench", "numpy", "torch"
"""Packages that must have one version on all nodes: with others the bytes may differ."""
_work: tuple[str, object] = "", None
"""What this process is at: the name of the run, and its work."""


@contextmanager
def mapping(work: object, workers: int = 1, cluster: str | None = None) -> Iterator[Map]:
    """A ``map`` over so many processes of this machine, or over all CPUs of the Ray cluster at the
    address ``cluster``, for functions whose first argument is ``work``: ``map(function,
    *iterables)``. Each process gets ``work`` once and keeps it, with what it holds. Functions and
    items must be picklable.

    An error of a task is raised as it is. Raises `PoolError` when a worker process dies, and for a
    cluster that can't be reached, dies, or has other versions of the package."""
    if cluster is not None:
        with _on_cluster(cluster, work) as mapped:
            yield mapped
    elif workers == 1:
        yield lambda function, *items: map(partial(function, work), *items)
    else:
        with single_threaded_algebra():
            try:  # what processes share is made here: in /dev/shm on Linux
                pool = ProcessPoolExecutor(workers, get_context("spawn"), _begin, (work,))
            except OSError as error:
                raise PoolError(
                    f"shared memory (/dev/shm) can't be used ({cause_of(error)}); have it mounted "
                    f"writable and with free space (Docker: --shm-size), or give --workers 1"
                ) from error
            try:
                yield lambda function, *items: pool.map(partial(_call, function), *items)
            except BaseException as error:
                for process in list((pool._processes or {}).values()):
                    process.terminate()  # nobody waits for what it is at
                if not isinstance(error, BrokenProcessPool):
                    raise
                raise PoolError(
                    "a worker process died (out of memory?); run the same command again, it "
                    "resumes; --workers 1 "
                    "needs the least memory"
                ) from error
            finally:
                pool.shutdown(cancel_futures=True)


def _begin(work: object) -> None:
    """In a new worker process: its parent alone is interrupted from the keyboard, and when the
    parent ends, however it does, so does this process: an orphan would stay for ever, or write into
    an unlocked folder."""
    global _work
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _work = "", work


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        connection.wait([parent.sentinel])
        os._exit(1)


def _call(function: Callable[..., Any], *items: Any) -> Any:
    return function(_work[1], *items)


@contextmanager
def _on_cluster(address: str, work: object) -> Iterator[Map]:
    import ray

    _check_address(address)
    try:
        # No environment of its own for the job: the package must be installed on the nodes.
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (
        Exception
    ) as error:  # Ray raises errors of many kinds here: its own, grpc's, RuntimeError
        reason = str(error).strip().partition("\n")[0]
        raise PoolError(
            f"--cluster {address}: connecting failed ({reason}); does `ray status` run there?"
        ) from error
    try:
        # As bytes: arrays that Ray itself unpacks are read-only.
        content = ray.put(pickle.dumps(work))
        task = ray.remote(max_retries=RETRIES)(_run_task)
        run, versions = uuid4().hex, _versions()

        def mapped(function: Callable[..., Any], *items: Iterable[Any]) -> Iterator[Any]:
            started = deque(
                task.remote(run, versions, content, function, *group)
                for group in zip(*items, strict=True)
            )
            while started:
                yield ray.get(started.popleft())

        yield mapped
    except ray.exceptions.RayTaskError as error:
        raise error.cause from error
    except (ray.exceptions.RayError, ConnectionError) as error:
        reason = str(error).strip().partition("\n")[0]
        raise PoolError(
            f"--cluster {address}: the cluster failed ({reason}); run the same command again, it "
            f"resumes"
        ) from error
    finally:
        ray.shutdown()


def _check_address(address: str) -> None:
    """Raises `PoolError` where nobody answers: Ray itself would wait long, or end this process."""
    try:
        place = urlsplit(address if "://" in address else f"//{address}")
        host, port = place.hostname, place.port
    except ValueError:
        host, port = None, None
    if not host or not port or place.scheme not in ("", "ray"):
        raise PoolError(
            f"--cluster {address}: expected ray://HOST:PORT, or HOST:PORT on a node of the cluster"
        )
    try:
        socket.create_connection((host, port), CONNECTION_S).close()
    except OSError as error:
        raise PoolError(
            f"--cluster {address}: nobody answers at {host}:{port} ({error.strerror or error}); "
            f"start a cluster with "
            "`ray start --head --ray-client-server-port 10001`, and see that the address is its"
        ) from error


def _versions() -> dict[str, str | None]:
    def version(package: str) -> str | None:
        try:
            return metadata.version(package)
        except metadata.PackageNotFoundError:
            return None

    return {package: version(package) for package in _DECIDE_RESULTS}


def _run_task(
    run: str,
    versions: dict[str, str | None],
    content: bytes,
    function: Callable[..., Any],
    *items: Any,
) -> Any:
    """A task in a worker process of a cluster; the first of a run unpacks its work."""
    global _work
    if _work[0] != run:
        here = _versions()
        others = [name for name in versions if here[name] != versions[name]]
        if others:
            differing = ", ".join(
                f"{name} {here[name]} and not {versions[name]}" for name in others
            )
            raise PoolError(
                f"node {platform.node()} has {differing}: results may differ; install the same "
                f"versions"
            )
        _work = run, pickle.loads(content)
    return function(_work[1], *items)
