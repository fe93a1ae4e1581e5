"""Describes the machine on which times are measured. Imports neither NumPy nor torch."""

import gc
import os
import platform
import re
import shutil
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

_GIB = 1024.0**3


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
        memory_gib=round(_usable_memory_bytes() / _GIB, 1),
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


THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def limit_threads(threads: int) -> None:
    """Limit linear algebra to ``threads``; works only before NumPy is loaded."""
    os.environ.update(dict.fromkeys(THREAD_COUNTS, str(max(threads, 1))))


_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Parameters of mallopt(3)."""
_KEPT_BYTES = 1 << 30


def keep_freed_memory(kept_bytes: int = _KEPT_BYTES) -> None:
    """Have glibc's allocator keep up to ``kept_bytes`` of freed memory. Linux only.

    By default it returns every freed array of an image's size to the system and requests new memory for the next one;
    the page faults take longer than the arithmetic, and 10-20% of a small network's training step.
    """
    if not sys.platform.startswith("linux"):
        return
    import ctypes

    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _KEPT_BYTES)
        mallopt(_TRIM_THRESHOLD, kept_bytes)


def prepare_process() -> None:
    """Keep freed memory, look for no pydantic plugins, and collect no cyclic garbage.

    - pydantic searches the metadata of every installed package for plugins, and this package uses none.
    - The garbage collector visits every imported object again and again; scoring leaves no reference cycles.
    """
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    gc.disable()
    keep_freed_memory()
