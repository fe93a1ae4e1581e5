"""Independent pieces of one image's work at the same time: OpenCV and NumPy let go of the interpreter meanwhile."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def side_by_side(jobs: Sequence[Callable[[], T]], threads: int) -> list[T]:
    """What each of ``jobs`` returns, in their order, from ``threads`` threads; the first error that one raises."""
    if threads < 2 or len(jobs) < 2:
        return [job() for job in jobs]
    with ThreadPoolExecutor(min(threads, len(jobs))) as pool:
        return [done.result() for done in [pool.submit(job) for job in jobs]]
