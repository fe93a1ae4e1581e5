"""The Pareto front of error against run time."""

from collections.abc import Sequence


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the ``points`` (time, error) that no other point beats: none is as good in both and better in one.

    Smaller is better. Sorted by time. Points that are equal in both are all on the front or all off it.
    """
    front: list[int] = []
    best = float("inf")
    last: tuple[float, float] | None = None
    for index in sorted(range(len(points)), key=lambda i: (points[i], i)):
        if points[index][1] < best or points[index] == last:
            front.append(index)
            best, last = points[index][1], points[index]
    return front
