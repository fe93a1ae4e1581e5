"""The benchmarks that this package names: which bytes a preset must have, and whether a dataset folder has them. A
result is only comparable with results on the same bytes. A benchmark therefore has a name, a version and a fingerprint
(`Manifest.fingerprint`), the same on every processor. A change of the bytes is a new version."""

from dataclasses import dataclass

from fpp_ml_bench.constants import FULL_SIZE, MINI_SIZE
from fpp_ml_bench.loaders import render
from fpp_ml_bench.loaders.storage.manifest import GENERATED, Manifest


@dataclass(frozen=True)
class Benchmark:
    """A named dataset: ``name``, ``version``, the SHA-256 ``fingerprint`` of its content (64 hex digits), and the
    ``preset``, image ``size`` in px, ``light`` and ``rig`` that build it."""

    name: str
    version: int
    preset: str
    size: int
    fingerprint: str
    light: str = "paper"
    rig: str = "paper"

    @property
    def title(self) -> str:
        """As it is printed: ``fpp-bench-full version 0``."""
        return f"{self.name} version {self.version}"


BENCHMARKS = (
    Benchmark(
        "fpp-bench-full", 1, "full", FULL_SIZE, "394c1522fe3442ef4e2afbbe6ea76b42ac6477cfbad62eb9a6d6445a3935379f"
    ),
    Benchmark("fpp-bench-full-224", 1, "full", 224, "a5dbf28a2e1ee5d2d772711f45a4f0481dd27c075d45b42a4543fa86099d82f7"),
    Benchmark(
        "fpp-bench-mini", 1, "mini", MINI_SIZE, "6dc6e35e4d5c2f194ba052443086af16bbc4d6b46f45d524655ebaa21cc9b1db"
    ),
    Benchmark(
        "fpp-bench-unseen", 1, "unseen", FULL_SIZE, "d865570932e66a32c8f381880dd98f1b7cbe4bd7e3f0577c68f8ec08664a4b05"
    ),
    # The same objects and views under other lights.
    Benchmark(
        "fpp-bench-workshop",
        1,
        "full",
        FULL_SIZE,
        "fc627a8a95ad848c68a08a46415ebfa669f765be7bead0539df3b026de13bfc6",
        "workshop",
    ),
    Benchmark(
        "fpp-bench-hard",
        1,
        "full",
        FULL_SIZE,
        "23ee324d806d73b97d40e9ffe849f2be7e1efb61985312d9ea7adc03b8d10644",
        "hard",
    ),
    # The same objects and views with crossed fringes.
    Benchmark(
        "fpp-bench-crossed",
        1,
        "full",
        FULL_SIZE,
        "526914ee31b78a34f41cd050f3e63707fa4eaf33824cdef43f80098a3721ba24",
        rig="crossed",
    ),
    Benchmark(
        "fpp-bench-crossed-unseen",
        1,
        "unseen",
        FULL_SIZE,
        "b197093e8930f767ccab588ea8772de7e1256f045a0239ff9013d3050fedc9bc",
        rig="crossed",
    ),
    # The test objects alone, to score methods in lights that nothing here is trained in.
    Benchmark(
        "fpp-bench-test-workshop",
        1,
        "test",
        FULL_SIZE,
        "7d2b42bb8e89330dd8e62190fb33b9622d73f5bdff94303edad30a01acf6a323",
        "workshop",
    ),
    Benchmark(
        "fpp-bench-test-hard",
        1,
        "test",
        FULL_SIZE,
        "ae15c33431eb62c8f938e4ac22b0b8bf746f9b509840bdb37d73249252a26ab8",
        "hard",
    ),
    Benchmark(
        "fpp-bench-test-crossed-workshop",
        1,
        "test",
        FULL_SIZE,
        "ec64e96ac523335ec5bf7be0a2c132651a7cba0d63c747901f3bb7a0b38633e6",
        "workshop",
        "crossed",
    ),
    Benchmark(
        "fpp-bench-test-crossed-hard",
        1,
        "test",
        FULL_SIZE,
        "1b681c74c7f3b56f606b279d1e05fce427a3821dd8a6acb465ca9075691d3615",
        "hard",
        "crossed",
    ),
)
"""The current version of each. ``fpp-bench-full-224`` is what `fpp-bench reproduce --preset cpu` trains on."""
EARLIER = (
    Benchmark(
        "fpp-bench-full", 0, "full", FULL_SIZE, "d46eed4271d91e8887863420ca08dff148db61abc135a24233d7757135d5683f"
    ),
    Benchmark("fpp-bench-full-224", 0, "full", 224, "052761fe170e60c8893e47b480265dd5727a4045bfb076077bc7eb8a0a1657a9"),
    Benchmark(
        "fpp-bench-mini", 0, "mini", MINI_SIZE, "0ba15100b657c8b0edfde78d1833ecefc0ebc42d219a96727f83fe604ba55440"
    ),
)
"""Versions that this package no longer builds: one albedo, direct light alone, one ray a pixel."""


def benchmark_of(fingerprint: str) -> Benchmark | None:
    """The benchmark with this fingerprint, of today or earlier; None for any other dataset."""
    return next((benchmark for benchmark in (*BENCHMARKS, *EARLIER) if benchmark.fingerprint == fingerprint), None)


def current_benchmark(name: str) -> Benchmark | None:
    """The version of the benchmark ``name`` that this package builds; None for no such name."""
    return next((benchmark for benchmark in BENCHMARKS if benchmark.name == name), None)


def intended_benchmark(manifest: Manifest) -> Benchmark | None:
    """The benchmark whose settings a dataset was built with, whatever its bytes are; None for settings of its own."""
    if manifest.origin != GENERATED:
        return None
    content = (manifest.settings, manifest.rig, manifest.stored)
    light = manifest.settings.get("light", {}).get("name")
    for benchmark in (benchmark for benchmark in BENCHMARKS if benchmark.light == light):
        settings = render.preset_settings(benchmark.preset, benchmark.size, benchmark.light, benchmark.rig)
        if content == (settings.describe(), settings.rig.to_dict(), settings.stored):
            return benchmark
    return None


def benchmark_sentence(manifest: Manifest) -> tuple[bool, str]:
    """A sentence about what a dataset is; False beside it for a benchmark's settings with other bytes."""
    fingerprint = manifest.fingerprint
    benchmark = benchmark_of(fingerprint)
    if benchmark is not None:
        return True, f"this is {benchmark.title}"
    intended = intended_benchmark(manifest)
    if intended is None:
        return True, "a dataset of its own, none of the named benchmarks: its scores compare only with scores on itself"
    return False, (
        f"built with the settings of {intended.title}, but not its bytes (fingerprint {fingerprint[:8]}, expected "
        f"{intended.fingerprint[:8]}): its scores do not compare with that benchmark's. Build it again with this "
        "version of the package; if it still differs, please report the processor and the package versions"
    )
