"""The packages, which pyproject.toml can't list by itself: the four rooms at the top level are
subpackages."""

from setuptools import find_packages, setup

ROOMS = ("loaders", "evaluation", "baselines", "leaderboard")
inside = [
    f"fpp_ml_bench.{name}" for room in ROOMS for name in find_packages(include=[room, f"{room}.*"])
]
setup(
    packages=[*find_packages(include=["fpp_ml_bench", "fpp_ml_bench.*"]), *inside],
    package_dir={
        "fpp_ml_bench": "fpp_ml_bench",
        **{f"fpp_ml_bench.{room}": room for room in ROOMS},
    },
)
