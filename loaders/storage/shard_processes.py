"""Shards written by processes of this machine, which go from shard to shard and end with their parent."""

import traceback
from collections import deque
from collections.abc import Callable, Generator
from contextlib import suppress
from multiprocessing import connection, get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol

from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders.storage.shards import Receipt, ShardPlan
from fpp_ml_bench.machine import single_threaded_algebra
from fpp_ml_bench.pool import begin_worker, shared_memory

_POLL_S = 0.2


class Work(Protocol):
    """Picklable; writes shards into ``folder``."""

    @property
    def folder(self) -> Path: ...
    def write(self, plan: ShardPlan, row_done: Callable[[], None]) -> Receipt: ...


def write_in_processes(
    work: Work, plans: list[ShardPlan], workers: int, progress: Callable[[int], None]
) -> Generator[tuple[ShardPlan, Receipt], None, None]:
    """Write the shards in processes that each go from shard to shard; yields each when it is finished, in any order."""
    context = get_context("spawn")
    with shared_memory():
        rows_done, reported = context.Value("q", 0), 0
    # The longest shards first, so that no worker is left with a long shard at the end.
    waiting = deque(sorted(plans, key=lambda plan: -len(plan.samples)))
    pipes, processes, busy = [], [], {}
    try:
        with single_threaded_algebra():
            for _ in range(min(workers, len(plans))):
                pipe, end = context.Pipe()
                pipes.append(pipe)
                processes.append(context.Process(target=_work, args=(end, rows_done, work)))
                processes[-1].start()
                end.close()  # the worker's copy is the only one left: when the worker dies, the pipe ends
        for pipe in pipes:
            busy[pipe] = waiting.popleft()
            pipe.send(busy[pipe])
        while busy:
            ready = connection.wait(list(busy), timeout=_POLL_S)
            done = rows_done.value
            progress(done - reported)
            reported = done
            for pipe in (pipe for pipe in pipes if pipe in ready):
                plan, result = busy.pop(pipe), pipe.recv()
                if isinstance(result, Exception):
                    raise result
                if waiting:
                    busy[pipe] = waiting.popleft()
                    pipe.send(busy[pipe])
                yield plan, result
    except (EOFError, ConnectionError) as error:
        raise BuildError(
            f"{work.folder}: a worker process died (out of memory?); run the same command again, it resumes; with "
            "--workers 1 it needs the least memory"
        ) from error
    finally:
        for pipe in pipes:
            pipe.close()  # a worker ends when it has finished its shard
        for process in processes:
            if busy:
                process.terminate()  # nobody waits for what it is at
            process.join()


def _work(pipe: Connection, rows_done: Any, work: Work) -> None:
    """Write the shards whose plans come through ``pipe``, counting rows in memory shared with the parent."""
    begin_worker()

    def row_done() -> None:
        with rows_done.get_lock():
            rows_done.value += 1

    with suppress(EOFError, ConnectionError):  # the parent wants no more
        while True:
            plan = pipe.recv()
            result: Receipt | Exception
            try:
                result = work.write(plan, row_done)
            except Exception as error:
                error.add_note(traceback.format_exc())
                result = error
            pipe.send(result)
