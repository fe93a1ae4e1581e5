"""Settings of the process while a training runs: reproducible kernels, undone afterwards, and memory kept for reuse."""

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from accelerate.state import AcceleratorState

from fpp_ml_bench.baselines.training.recipe import Recipe

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Parameters of mallopt(3)."""


@contextmanager
def reproducible(recipe: Recipe) -> Iterator[None]:
    """Within: deterministic kernels on the CPU, the fastest ones on a GPU, and freed memory kept for the next step."""
    # A process may train in fp32 after bf16, but accelerate's shared state allows only one precision.
    AcceleratorState._reset_state()
    keep_freed_memory()
    on_gpu = torch.cuda.is_available()
    before = torch.are_deterministic_algorithms_enabled(), torch.backends.cudnn.benchmark
    torch.use_deterministic_algorithms(not on_gpu)
    torch.backends.cudnn.benchmark = on_gpu
    tf32 = torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32
    if recipe.precision == "fp32":
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(before[0])
        torch.backends.cudnn.benchmark = before[1]
        torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = tf32


def keep_freed_memory() -> None:
    """Have glibc keep large blocks that were freed: every step asks for the same ones again, and a fresh page costs a
    fault. 10-20% of a small network's step on a virtual machine."""
    if sys.platform == "linux":
        set_option = getattr(ctypes.CDLL(None), "mallopt", None)
        if set_option is not None:
            set_option(_MMAP_THRESHOLD, 1 << 30)
            set_option(_TRIM_THRESHOLD, (1 << 31) - 1)
