"""Reading .mat, Arrow and Parquet in a process of its own, one for a folder: a damaged file can end only that process.

The libraries that read these forms (HDF5, Arrow) trust the lengths in a file: a damaged one may end the process that
reads it, and a compressed page or buffer may state any unpacked size. So the process has an upper limit of memory, and
is ended when it takes too long.
"""

import os
import resource
import subprocess
import sys
import weakref
from importlib import import_module
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from threading import Lock

from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.machine import THREAD_COUNTS

TIMEOUT_S = 120
_SPARE_BYTES = 64 << 20
_COPIES = 8
"""How many times the largest file and what it unpacks to may be in memory: received, unpacked, written, sent."""


class ReadingProcess:
    """Calls ``read(content, largest, *limits)`` of ``module`` in another process, which ends with this object."""

    def __init__(self, module: str, largest: int, *limits: int) -> None:
        self._arguments = [module, *map(str, (largest, *limits))]
        self._lock = Lock()
        self._running = False

    def __call__(self, content: bytes) -> bytes:
        """What ``read`` returns; PredictionError as it raises, or where the process ended or took too long."""
        with self._lock:
            if not self._running:
                self._start()
            try:
                self._connection.send_bytes(content)
                if not self._connection.poll(TIMEOUT_S):
                    raise TimeoutError
                problem = self._connection.recv_bytes().decode()
                answer = b"" if problem else self._connection.recv_bytes()
            except (OSError, EOFError) as error:
                self._end()
                self._running = False
                late = f"can't be read within {TIMEOUT_S} s; write it again"
                ended = "is damaged: it ended the process that read it; write it again"
                raise PredictionError(late if isinstance(error, TimeoutError) else ended) from None
        if problem:
            raise PredictionError(problem)
        return answer

    def _start(self) -> None:
        self._connection, theirs = Pipe()
        one_thread = dict.fromkeys(THREAD_COUNTS, "1")  # each thread's stack would count as memory
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", __name__, str(theirs.fileno()), *self._arguments],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **one_thread, "ARROW_DEFAULT_MEMORY_POOL": "system"},
        )
        theirs.close()
        self._end = weakref.finalize(self, _end, self._process, self._connection)
        self._running = True


def _end(process: subprocess.Popen, connection: Connection) -> None:
    connection.close()
    process.kill()
    process.wait()


def _serve(descriptor: int, module: str, largest: int, *limits: int) -> None:
    """The other process: answers each content with an empty message and what was read, or with the problem."""
    connection, read = Connection(descriptor), import_module(module).read
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    most = used + _SPARE_BYTES + _COPIES * largest
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    while True:
        try:
            content = connection.recv_bytes()
        except EOFError:
            return
        try:
            answer = read(content, largest, *limits)
        except PredictionError as error:
            connection.send_bytes(str(error).encode())
        except MemoryError:
            text = f"is too large or damaged: reading it takes more memory than {largest} bytes need; write it again"
            connection.send_bytes(text.encode())
        else:
            connection.send_bytes(b"")
            connection.send_bytes(answer)


if __name__ == "__main__":
    _serve(int(sys.argv[1]), sys.argv[2], *map(int, sys.argv[3:]))
