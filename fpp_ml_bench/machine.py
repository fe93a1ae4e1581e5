"""This machine and this process: its hardware, threads and memory, and whether numba compiles the kernels.

Imports neither NumPy nor torch. Compiled kernels live in modules of their own that are imported only when
`numba_enabled` says so, each beside a NumPy function that gives the same numbers; ray casting has no such function and
is always compiled. The environment variable ``FPP_BENCH_NUMBA=0`` selects NumPy; so does a machine on which numba can't
be imported.
"""

import ctypes
import gc
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., object])

NUMBA_SWITCH = "FPP_BENCH_NUMBA"
THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Parameters of mallopt(3)."""


@dataclass(frozen=True)
class Hardware:
    """``cores`` and ``memory_gib`` are what this process may use (affinity, container limits), not what is built in.

    ``gpu`` names all visible NVIDIA GPUs, None without any; whether a method used them is recorded by the method.
    """

    cpu: str
    cores: int
    memory_gib: float
    gpu: str | None
    platform: str

    def to_dict(self) -> dict[str, str | int | float | None]:
        return asdict(self)


def describe_hardware() -> Hardware:
    """Describe this machine. Never raises; an unavailable value is ``"unknown"``, 0.0 GiB or None."""
    return Hardware(
        cpu=_cpu_model(),
        cores=usable_cores(),
        memory_gib=round(_usable_memory_bytes() / 1024.0**3, 1),
        gpu=_gpu_names(),
        platform=f"{platform.system()} {platform.release()} {platform.machine()}",
    )


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def _cpu_model() -> str:
    match = re.search(r"^model name\s*:\s*(.+)$", _read("/proc/cpuinfo"), flags=re.MULTILINE)
    return (match.group(1).strip() if match else platform.processor()) or "unknown"


def usable_cores() -> int:
    """CPUs in the affinity mask, or fewer where the container's quota (cgroup v2 ``cpu.max``) allows less."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = re.match(r"(\d+) (\d+)", _read("/sys/fs/cgroup/cpu.max"))
    if quota and int(quota.group(2)) > 0:
        cores = min(cores, max(1, round(int(quota.group(1)) / int(quota.group(2)))))
    return cores


def _usable_memory_bytes() -> float:
    match = re.search(r"^MemTotal:\s*(\d+) kB", _read("/proc/meminfo"), flags=re.MULTILINE)
    total = float(match.group(1)) * 1024.0 if match else 0.0
    limit = _read("/sys/fs/cgroup/memory.max").strip()
    return min(total, float(limit)) if limit.isdigit() and total else total


def _gpu_names() -> str | None:
    """NVIDIA GPUs, from the driver's files, from torch if it is loaded already, or from ``nvidia-smi``."""
    names = []
    for path in sorted(Path("/proc/driver/nvidia/gpus").glob("*/information")):
        match = re.search(r"^Model:\s*(.+)$", _read(str(path)), flags=re.MULTILINE)
        names += [match.group(1).strip()] if match else []
    torch = sys.modules.get("torch")
    if not names and torch is not None and hasattr(torch, "cuda") and torch.cuda.is_available():
        names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    if not names and shutil.which("nvidia-smi"):
        command = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
        try:
            listing = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout
        except (OSError, subprocess.SubprocessError):
            listing = ""
        names = [line.strip() for line in listing.splitlines() if line.strip()]
    if not names:
        return None
    return ", ".join(
        f"{names.count(name)} x {name}" if names.count(name) > 1 else name for name in dict.fromkeys(names)
    )


def limit_threads(threads: int) -> None:
    """Limit linear algebra to ``threads``; works only before NumPy is loaded."""
    os.environ.update(dict.fromkeys(THREAD_COUNTS, str(max(threads, 1))))


def keep_freed_memory() -> None:
    """Have glibc keep what is freed, up to 2 GiB, instead of returning each large array to the system.

    Every image and every training step asks for the same sizes again, and the page faults of new memory take longer
    than the arithmetic. Linux only.
    """
    set_option = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if set_option is not None:
        set_option(_MMAP_THRESHOLD, 1 << 30)
        set_option(_TRIM_THRESHOLD, (1 << 31) - 1)


def prepare_process() -> None:
    """Keep freed memory, look for no pydantic plugins, and collect no cyclic garbage.

    pydantic searches the metadata of every installed package for plugins, and this package uses none. The garbage
    collector visits every imported object again and again; scoring leaves no reference cycles.
    """
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    gc.disable()
    keep_freed_memory()


@cache
def _numba() -> Any:
    """The numba package, or None."""
    try:
        import numba
    except ImportError:  # numba also raises it for a NumPy version that it does not support
        return None
    return numba


def numba_enabled() -> bool:
    """Whether compiled kernels are to be used; reads ``FPP_BENCH_NUMBA`` on every call."""
    return os.environ.get(NUMBA_SWITCH, "1") != "0" and _numba() is not None


def njit(function: Function) -> Function:
    """Compile ``function`` to run without the GIL; the machine code is kept on disk for the next process.

    No ``fastmath``, and no multiplication is fused with an addition: the order of every sum stays as written, so the
    same input gives the same bytes on every processor and for any number of threads. Without numba the function is
    returned as it is (correct and very slow).
    """
    if _numba() is None:
        return function
    compiled: Any
    try:
        compiled = _numba().njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # neither the package folder nor the user's cache folder can be written
        compiled = _numba().njit(nogil=True, error_model="numpy")(function)
    return compiled
