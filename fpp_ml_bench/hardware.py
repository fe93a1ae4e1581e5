"""What machine a time was measured on, in words a table can hold. Imports neither NumPy nor torch."""

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

    ``gpu`` names every NVIDIA GPU in sight, None without one; whether a method used it is the method's to say.
    """

    cpu: str
    cores: int
    memory_gib: float
    gpu: str | None
    platform: str

    def to_dict(self) -> dict[str, str | int | float | None]:
        return asdict(self)


def describe_hardware() -> Hardware:
    """Describe this machine. Never raises; a value that can't be found is ``"unknown"``, 0.0 GiB or None."""
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
    found = re.search(r"^model name\s*:\s*(.+)$", _read("/proc/cpuinfo"), flags=re.MULTILINE)
    return (found.group(1).strip() if found else platform.processor()) or "unknown"


def usable_cores() -> int:
    """CPUs in the affinity mask, or fewer where the container's quota (cgroup v2 ``cpu.max``) allows less."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    found = re.match(r"(\d+) (\d+)", _read("/sys/fs/cgroup/cpu.max"))
    if found and int(found.group(2)) > 0:
        cores = min(cores, max(1, round(int(found.group(1)) / int(found.group(2)))))
    return cores


def _usable_memory_bytes() -> float:
    found = re.search(r"^MemTotal:\s*(\d+) kB", _read("/proc/meminfo"), flags=re.MULTILINE)
    total = float(found.group(1)) * 1024.0 if found else 0.0
    limit = _read("/sys/fs/cgroup/memory.max").strip()
    return min(total, float(limit)) if limit.isdigit() and total else total


def _gpu_names() -> str | None:
    """NVIDIA GPUs, from the driver's files, from torch where it is loaded anyway, or from ``nvidia-smi``."""
    names = []
    for path in sorted(Path("/proc/driver/nvidia/gpus").glob("*/information")):
        found = re.search(r"^Model:\s*(.+)$", _read(str(path)), flags=re.MULTILINE)
        names += [found.group(1).strip()] if found else []
    torch = sys.modules.get("torch")
    if not names and torch is not None and hasattr(torch, "cuda") and torch.cuda.is_available():
        names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    if not names and shutil.which("nvidia-smi"):
        command = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
        try:
            answer = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout
        except (OSError, subprocess.SubprocessError):
            answer = ""
        names = [line.strip() for line in answer.splitlines() if line.strip()]
    if not names:
        return None
    return ", ".join(f"{names.count(n)} x {n}" if names.count(n) > 1 else n for n in dict.fromkeys(names))
