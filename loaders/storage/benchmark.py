"""The benchmarks that this package names, and what is known of each: its samples and objects, how
many pixels count, and hashes of its content. A result is only comparable with results on the same
content.

Content is a hash of the decoded values for each column of each split (`Manifest.content`), the same
on every processor. Files, paths and versions of the format do not enter it, so that a build that
lacks columns is still the benchmark for the methods that don't need them. A change of the content
is a new version. The facts are in ``benchmarks/NAME.json``; ``benchmarks/benchmark_facts.py``
writes them from a build.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from fpp_ml_bench.constants import FULL_SIZE, MINI_SIZE
from fpp_ml_bench.loaders.storage.manifest import GENERATED, Manifest

FACTS = Path(__file__).resolve().parent / "benchmarks"


class Counts(NamedTuple):
    """Samples of an object; over all of them its pixels that are object, None where that is not
    known, and void; and in how many of them the object or the background has no pixel, none of a
    benchmark's."""

    samples: int
    object_px: int | None
    void_px: int
    empty: int = 0


@dataclass(frozen=True)
class Benchmark:
    """A named dataset: ``name``, ``version``, and the ``preset``, image ``size`` in px, ``light``
    and ``rig`` that build it."""

    name: str
    version: int
    preset: str
    size: int
    light: str = "paper"
    rig: str = "paper"

    @property
    def title(self) -> str:
        """As it is printed: ``fpp-bench-full version 2``."""
        return f"{self.name} version {self.version}"

    @cached_property
    def image_size(self) -> list[int]:
        """Height and width of its images in px."""
        return [self.size, self.size]

    @cached_property
    def _facts(self) -> dict[str, Any]:
        file = FACTS / f"{self.name}.json"
        return (
            json.loads(file.read_text(encoding="utf-8"))
            if file.is_file()
            else {"content": {}, "counts": {}}
        )

    @property
    def content(self) -> dict[str, Any]:
        """``split/column`` -> hash, as `Manifest.content`; of the track, that of each dataset."""
        return self._facts["content"]  # type: ignore[no-any-return]

    def counts(self, split: str, mode: str, target: str) -> dict[str, Counts]:
        """By object of ``split``, or of all splits, how many pixels count by the rules of ``mode``
        against ``target``; empty for rules that the facts don't have."""
        splits = [split] if split in self._facts["counts"] else list(self._facts["counts"])
        rules = [self._facts["counts"][name].get(f"{mode}/{target}", {}) for name in splits]
        return {name: Counts(*numbers) for objects in rules for name, numbers in objects.items()}


BENCHMARKS = (
    Benchmark("fpp-bench-full", 2, "full", FULL_SIZE),
    Benchmark("fpp-bench-full-224", 2, "full", 224),
    Benchmark("fpp-bench-mini", 2, "mini", MINI_SIZE),
    Benchmark("fpp-bench-unseen", 2, "unseen", FULL_SIZE),
    # The same objects and views under other lights.
    Benchmark("fpp-bench-workshop", 2, "full", FULL_SIZE, "workshop"),
    Benchmark("fpp-bench-hard", 2, "full", FULL_SIZE, "hard"),
    # The same objects and views with crossed fringes: other frames, and so another decoded depth.
    Benchmark("fpp-bench-crossed", 3, "full", FULL_SIZE, rig="crossed"),
    Benchmark("fpp-bench-crossed-unseen", 3, "unseen", FULL_SIZE, rig="crossed"),
    # The test objects alone, to score methods in lights that nothing here is trained in.
    Benchmark("fpp-bench-test-workshop", 2, "test", FULL_SIZE, "workshop"),
    Benchmark("fpp-bench-test-hard", 2, "test", FULL_SIZE, "hard"),
    Benchmark("fpp-bench-test-crossed-workshop", 3, "test", FULL_SIZE, "workshop", "crossed"),
    Benchmark("fpp-bench-test-crossed-hard", 3, "test", FULL_SIZE, "hard", "crossed"),
)
"""The current version of each. ``fpp-bench-full-224`` is what `fpp-bench reproduce --preset small`
trains on."""


TRACK = Benchmark("fpp-bench-rigs", 1, "rigs", 0)
"""The track of rigs (`loaders.render.track`): its facts are the content of each of its datasets."""


def known_track(content: Mapping[str, Mapping[str, str]]) -> Benchmark | None:
    """The track whose datasets, all of them, have ``content`` (by dataset ``split/column`` ->
    hash); None for others."""
    return TRACK if content and dict(content) == TRACK.content else None


def benchmark_of(content: Mapping[str, str]) -> Benchmark | None:
    """The first of `BENCHMARKS` that has all of ``content`` (``split/column`` -> hash), None
    without: where the columns are of the scenes alone, that with the paper's code."""
    return next((b for b in BENCHMARKS if content and content.items() <= b.content.items()), None)


def known_problem(
    content: Mapping[str, str],
    split: str,
    target: str,
    mode: str,
    file_counts: Mapping[str, Counts],
) -> str | None:
    """What is not as in the named benchmark that has ``content``, by the ``file_counts`` of the
    objects in a result: objects, samples, or pixels of object and void; a sentence. None where all
    is, or the content is none of the benchmarks'."""
    benchmark = benchmark_of(content)
    expected = {} if benchmark is None else benchmark.counts(split, mode, target)
    if benchmark is None or not expected:
        return None
    where = f"{benchmark.title}, {split} split,"
    if file_counts.keys() != expected.keys():
        foreign, missing = (
            sorted(file_counts.keys() - expected.keys()),
            sorted(expected.keys() - file_counts.keys()),
        )
        said = [f"has no object {name!r}, which this file has" for name in foreign[:1]]
        said += [f"has the object {name!r}, which this file lacks" for name in missing[:1]]
        return f"{where} {' and '.join(said)}"
    for name, counts in expected.items():
        words = "samples", "object pixels", "void pixels", "views without object or background"
        for what, wanted, given in zip(words, counts, file_counts[name], strict=True):
            if given is not None and wanted != given:
                return f"{where} has {wanted} {what} of {name!r}, this file says {given}"
    return None


def intended_benchmark(manifest: Manifest) -> Benchmark | None:
    """The benchmark whose settings, but for the frames that are stored, a dataset was built with,
    whatever its content is; None for settings of its own."""
    from fpp_ml_bench.loaders.render.scene import (
        preset_settings,
    )  # reading a dataset needs no renderer

    if manifest.origin != GENERATED:
        return None
    light = manifest.settings.get("light", {}).get("name")
    for benchmark in BENCHMARKS:
        if benchmark.light != light:
            continue
        settings = preset_settings(benchmark.preset, benchmark.size, light, benchmark.rig)
        stated = manifest.settings | {"frames": settings.stored}
        if stated == settings.describe() and manifest.rig == settings.stated_rig.to_dict():
            return benchmark
    return None


def _intended_of_track(manifest: Manifest) -> str | None:
    """The dataset of the track whose settings a dataset was built with, whatever its content is;
    None for others."""
    from fpp_ml_bench.loaders.render.track import track  # reading a dataset needs no renderer

    described = manifest.settings, manifest.rig
    if manifest.origin != GENERATED or "views" not in manifest.settings:
        return None
    return next(
        (
            name
            for name, settings in track().items()
            if described == (settings.describe(), settings.stated_rig.to_dict())
        ),
        None,
    )


def benchmark_sentence(manifest: Manifest) -> tuple[bool, str]:
    """A sentence about what a dataset is by its manifest; False beside it for a benchmark's
    settings with other content."""
    benchmark, intended = benchmark_of(manifest.content), intended_benchmark(manifest)
    for name, content in TRACK.content.items():
        if content == manifest.content:
            return True, f"this is {name} of {TRACK.title}"
    if part := _intended_of_track(manifest):
        return False, (
            f"built with the settings of {part} of {TRACK.title}, but not its content: its scores "
            f"do not compare with that track's. Build it again with this version of the package; if "
            f"it still differs, please report the processor and the package versions"
        )
    if benchmark is not None:
        lacking = len(benchmark.content) > len(manifest.content)
        return (
            True,
            f"this is {benchmark.title}{', a part of its splits and columns' if lacking else ''}",
        )
    if intended is None:
        return (
            True,
            "a dataset of its own, none of the named benchmarks: its scores compare only with "
            "scores on itself",
        )
    expected = intended.content
    other = next(
        (key for key, digest in manifest.content.items() if expected.get(key) != digest),
        "its content",
    )
    return False, (
        f"built with the settings of {intended.title}, but not its content ({other} differs): its "
        f"scores do not "
        "compare with that benchmark's. Build it again with this version of the package; if it "
        "still differs, please "
        "report the processor and the package versions"
    )
