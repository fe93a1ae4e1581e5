"""This machine and this process: its hardware, threads and memory, and how kernels are compiled.
Imports neither NumPy nor torch."""

import ctypes
import os
import platform
import re
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., object])

THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Parameters of mallopt(3)."""


@dataclass(frozen=True)
class Hardware:
    """``cores`` and ``memory_gib`` are what this process may use (affinity, container limits), not
    what is built in; ``gpu`` names all visible NVIDIA GPUs, None without any."""

    cpu: str
    cores: int
    memory_gib: float
    gpu: str | None
    platform: str

    def to_dict(self) -> dict[str, str | int | float | None]:
        return asdict(self)


def describe_hardware() -> Hardware:
    """Describe this machine. Never raises; an unavailable value is ``"unknown"``, 0.0 GiB or
    None."""
    model = _found(r"^model name\s*:\s*(.+)$", "/proc/cpuinfo")
    memory_gib = round(_usable_memory_bytes() / 1024.0**3, 1)
    system = f"{platform.system()} {platform.release()} {platform.machine()}"
    return Hardware(
        model or platform.processor() or "unknown", usable_cores(), memory_gib, _gpu_names(), system
    )


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def _found(pattern: str, path: str) -> str | None:
    """What the pattern's group is in the first line of a file that matches."""
    match = re.search(pattern, _read(path), flags=re.MULTILINE)
    return match.group(1).strip() if match else None


def usable_cores() -> int:
    """CPUs in the affinity mask, or fewer where the container's quota (cgroup v2 ``cpu.max``)
    allows less."""
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    quota = re.match(r"(\d+) (\d+)", _read("/sys/fs/cgroup/cpu.max"))
    if quota and int(quota.group(2)) > 0:
        cores = min(cores, max(1, round(int(quota.group(1)) / int(quota.group(2)))))
    return cores


def _usable_memory_bytes() -> float:
    total = float(_found(r"^MemTotal:\s*(\d+) kB", "/proc/meminfo") or 0) * 1024.0
    limit = _read("/sys/fs/cgroup/memory.max").strip()
    return min(total, float(limit)) if limit.isdigit() and total else total


def _gpu_names() -> str | None:
    """NVIDIA GPUs, from the driver's files, from torch if it is loaded already, or from
    ``nvidia-smi``."""
    files = sorted(Path("/proc/driver/nvidia/gpus").glob("*/information"))
    names = [name for file in files if (name := _found(r"^Model:\s*(.+)$", str(file))) is not None]
    torch = sys.modules.get("torch")
    if not names and torch is not None and hasattr(torch, "cuda") and torch.cuda.is_available():
        names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    if not names and shutil.which("nvidia-smi"):
        import subprocess  # here: every command imports this module, and few get to this line

        command = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
        try:
            listing = subprocess.run(
                command, capture_output=True, text=True, timeout=10, check=True
            ).stdout
        except (OSError, subprocess.SubprocessError):
            listing = ""
        names = [line.strip() for line in listing.splitlines() if line.strip()]
    counted = (f"{count} x {name}" if count > 1 else name for name, count in Counter(names).items())
    return ", ".join(counted) or None


def limit_threads(threads: int) -> None:
    """Limit linear algebra to ``threads``; works only before NumPy is loaded."""
    os.environ.update(dict.fromkeys(THREAD_COUNTS, str(max(threads, 1))))


def keep_freed_memory() -> None:
    """Have glibc keep what is freed, up to 2 GiB (Linux only): every image and training step asks
    for the same sizes again, and the page faults of new memory take longer than the arithmetic."""
    set_option = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if set_option is not None:
        set_option(_MMAP_THRESHOLD, 1 << 30)
        set_option(_TRIM_THRESHOLD, (1 << 31) - 1)


def prepare_process() -> None:
    """Keep freed memory, and look for no pydantic plugins (a search of every installed package)."""
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    keep_freed_memory()


@cache
def _numba() -> Any:
    """The numba package, or None."""
    try:
        import numba
    except ImportError:  # numba also raises it for a NumPy version that it does not support
        return None
    return numba


@cache
def _code_cache() -> Any:
    """Numba's cache of machine code, where a file that is damaged or can't be written is as if
    there were none."""
    from hashlib import sha256

    from numba.core.caching import FunctionCache, IndexDataCacheFile

    class SealedFile(IndexDataCacheFile):
        """With a digest behind each pickle, which ignores it: damaged machine code would end the
        process."""

        def _dump(self, obj: object) -> bytes:
            content: bytes = super()._dump(obj)
            return content + sha256(content).digest()

        def _load_data(self, name: str) -> Any:
            content = Path(self._data_path(name)).read_bytes()
            if sha256(content[:-32]).digest() != content[-32:]:
                raise ValueError(f"{name} is damaged")
            return super()._load_data(name)

    class CodeCache(FunctionCache):
        def __init__(self, function: Callable[..., object]) -> None:
            super().__init__(function)
            stamp = self._impl.locator.get_source_stamp()
            self._cache_file = SealedFile(self._cache_path, self._impl.filename_base, stamp)

        def load_overload(self, signature: object, target: object) -> Any:
            try:
                return super().load_overload(signature, target)
            except Exception:  # unpickling a damaged file raises errors of any kind
                with suppress(OSError):
                    self.flush()
                return None

        def save_overload(self, signature: object, compiled: object) -> None:
            with suppress(Exception):  # the next process compiles again
                super().save_overload(signature, compiled)

    return CodeCache


def njit(function: Function) -> Function:
    """Compile ``function`` to run without the GIL; the machine code is kept on disk. Without numba
    it stays as it is, and is slow. No ``fastmath``, and no multiplication is fused with an
    addition: the same input gives the same bytes on every processor and for any number of
    threads."""
    if _numba() is None:
        return function
    compiled = _numba().njit(nogil=True, error_model="numpy")(function)
    with suppress(
        RuntimeError
    ):  # neither the package folder nor the user's cache folder can be written
        compiled._cache = _code_cache()(function)
    return cast(Function, compiled)


@contextmanager
def single_threaded_algebra() -> Iterator[None]:
    """Worker processes started inside the block get a single-threaded BLAS, whose idle threads
    would spin otherwise."""
    previous = {name: os.environ[name] for name in THREAD_COUNTS if name in os.environ}
    os.environ.update(dict.fromkeys(THREAD_COUNTS, "1"))
    try:
        yield
    finally:
        for name in THREAD_COUNTS:
            os.environ.pop(name, None)
        os.environ.update(previous)
