"""``fpp-bench build``: generate the benchmark."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from time import perf_counter
from typing import Literal

from fpp_ml_bench.cli.console import contents, progress_bar, say_benchmark
from fpp_ml_bench.cli.options import Explain, Pool, command, names, value, whole
from fpp_ml_bench.coding.gray_code import bits_needed
from fpp_ml_bench.constants import CONFIGS, LARGEST_SIDE_PX, PRESETS
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders.render.builder import assembly_of, explain_build
from fpp_ml_bench.loaders.render.builder import build as build_dataset
from fpp_ml_bench.loaders.render.light import NAMED as NAMED_LIGHTS
from fpp_ml_bench.loaders.render.light import load_light
from fpp_ml_bench.loaders.render.meshes import read_mesh_list, single_mesh
from fpp_ml_bench.loaders.render.scene import (
    BuildSettings,
    default_frames,
    light_of_volume,
    volume_scale,
)
from fpp_ml_bench.loaders.render.sensor import camera_noise
from fpp_ml_bench.loaders.render.track import TRACK, track
from fpp_ml_bench.loaders.storage.card import ground_truth_summary
from fpp_ml_bench.loaders.storage.manifest import Manifest
from fpp_ml_bench.optics.named_rigs import NAMED_RIGS
from fpp_ml_bench.optics.rig_file import load_rig
from fpp_ml_bench.optics.sequence import DIRECTIONS
from fpp_ml_bench.options import REQUIRED, flag_of, option
from fpp_ml_bench.remote import RemoteFolder, place


@dataclass(frozen=True, kw_only=True)
class BuildCommandSettings(Explain, Pool):
    """Settings of `build`, which `settings_of` makes `render.BuildSettings` of."""

    out: Path | RemoteFolder = option(
        REQUIRED,
        "new folder, or one whose build was interrupted; or a URL: s3://bucket/set",
        "DIR",
        parse=place,
    )
    preset: str = option(
        "mini",
        "objects and size (default: mini); rigs: the track of sixteen rigs, a dataset each and light",
        choices=(*PRESETS, TRACK),
    )
    size: int | None = option(
        None,
        "image width and height (default: the preset's)",
        "PX",
        parse=whole(1, LARGEST_SIDE_PX, "px"),
    )
    objects: tuple[str, ...] | None = option(
        None, "objects by name, comma separated (default: the preset's)", "A,B", parse=names
    )
    placement: Literal["fixed", "varied"] = option(
        "fixed", "all objects at the standoff, or a distance drawn per view"
    )
    config: str | None = option(
        None,
        "configuration of frames to store (default: all; with --rig crossed: crossed)",
        choices=CONFIGS,
    )
    seed: int = option(42, "seed of noise and placement (default: 42)", "N")
    rig: str = option(
        "paper",
        "the paper's, the same with crossed fringes (also crossed-10, crossed-18), or a rig file "
        "(default: paper)",
        "paper|crossed|FILE",
    )
    object_scale: float | None = option(
        None,
        "size of the benchmark's objects, 1 their own (default: what fits the working volume of the "
        "rig)",
        "N",
        parse=value("a number above 0", float, lambda scale: 0 < scale < 1e6),
    )
    decode_with: Path | None = option(
        None,
        "rig that a calibration found: it decodes the ground truth and is the dataset's; --rig "
        "photographs",
        "FILE",
    )
    pitch: float | None = option(None, "fringe period in projector px, both directions", "PX")
    light: str = option(
        "paper",
        "paper, workshop, hard, or a YAML file with other numbers (default: paper)",
        "NAME|FILE",
    )
    noise_sigma: float | None = option(
        None,
        "sensor noise at mid-grey, grey levels of 255, half of its variance shot noise (default: "
        "the light's)",
        "GREY",
        parse=value("0 to 50 grey levels", float, lambda grey: 0 <= grey <= 50),
    )
    shadows: bool = option(False, "let objects cast shadows, whatever the light says")
    mesh: tuple[Path, ...] = option(
        (),
        "a mesh of yours in metres (OBJ, PLY, STL, GLB); repeatable",
        "FILE",
        parse=Path,
        many=True,
    )
    meshes: Path | None = option(None, "meshes of yours with scale, pose and split", "LIST.yaml")


def settings_of(given: BuildCommandSettings) -> "BuildSettings":
    """Build settings that the options ask for; raises `BuildError`, `MeshError` or `RigError`."""
    objects, size = PRESETS[given.preset]
    if given.rig in NAMED_RIGS:
        rig = NAMED_RIGS[given.rig](given.size or size)
    else:
        rig = load_rig(given.rig)
        rig = rig if given.size is None else rig.scaled(given.size)
    if given.pitch is not None:
        sequence = rig.paper_sequence
        if given.pitch >= 4:  # below that the rig itself refuses, with its own words
            lengths = (rig.pattern_length(direction) for direction in DIRECTIONS)
            horizontal, vertical = (bits_needed(length, given.pitch) for length in lengths)
            horizontal, vertical = (
                max(sequence.bits_horizontal, horizontal),
                max(sequence.bits_vertical, vertical),
            )
            sequence = replace(sequence, bits_horizontal=horizontal, bits_vertical=vertical)
        rig = replace(
            rig, pitch_horizontal_px=given.pitch, pitch_vertical_px=given.pitch, sequence=sequence
        )
    own = (read_mesh_list(given.meshes) if given.meshes else ()) + tuple(
        map(single_mesh, given.mesh)
    )
    if given.objects is not None:
        objects = given.objects
    elif own:
        objects = ()
    everything = (*objects, *(mesh.name for mesh in own))
    light = load_light(given.light)
    if given.noise_sigma is not None:
        light = light.changed("camera", **camera_noise(given.noise_sigma))
    if given.shadows:
        light = light.changed("bounces", shadows=True)
    decoding_rig = None if given.decode_with is None else load_rig(given.decode_with)
    stored = given.config or default_frames(given.rig)
    scale = given.object_scale
    if scale is None:
        scale = 1.0 if given.rig in NAMED_RIGS or not objects else volume_scale(rig)
    if given.light in NAMED_LIGHTS:
        light = light_of_volume(light, rig, scale)
    elif scale != 1:
        light = light.changed("projector", focus_m=light.projector.focus_m / scale)
    return BuildSettings(
        rig, everything, given.placement, stored, given.seed, light, own, decoding_rig, scale
    )


@command(
    """\
fpp-bench build --out data/mini --preset mini                      6 objects at 480 px, all 52 frames
fpp-bench build --out data/full --preset full                      the whole set: 50 objects, 960 px, 15,600 images
fpp-bench build --out data/unseen --preset unseen                  20 other objects at 960 px, all in split test
fpp-bench build --out data/crossed --preset full --rig crossed     the same views in 3 frames of crossed fringes
fpp-bench build --out data/train --preset full --config single_shot    frame 0 and depth only
fpp-bench build --out data/hard --preset mini --placement varied   no distance prior helps
fpp-bench build --out data/workshop --preset full --light workshop     the same views under a workshop's light
fpp-bench build --out data/test --preset test --light hard         the test objects alone, to score in that light
fpp-bench build --out data/mine --mesh part.stl --size 960         a mesh of yours (metres)
fpp-bench build --out data/lab --decode-with found.yaml            ground truth by the rig that a calibration found
fpp-bench build --out data/rigs --preset rigs                      the track of 16 rigs, 32 datasets in a folder
fpp-bench build --out s3://bucket/full --preset full --cluster ray://head:10001    on all nodes of a Ray cluster
fpp-bench build --out data/pen --objects pen --explain             what was left out
"""
)
def build(settings: BuildCommandSettings) -> None:
    """Generate the benchmark: virtual rig, objects, six views each, decoded and exact ground
    truth."""
    if settings.preset == TRACK:
        _build_track(settings)
        return
    build_settings = settings_of(settings)
    samples = sum(len(plan.samples) for plan in assembly_of(build_settings).plans)
    with progress_bar("building", samples, "samples") as advance:
        manifest, rate = _built(settings.out, build_settings, settings, advance)
    print(f"{settings.out}: {contents(manifest)}; {rate}")
    if (scale := build_settings.object_scale) != 1:
        print(f"  objects, textures and focus are {scale:g} times as large as in the benchmark")
    for line in ground_truth_summary(manifest):
        print(f"  {line}")
    say_benchmark(manifest)
    if isinstance(settings.out, Path):
        print(f"next: fpp-bench info {settings.out}")
    settings.say(lambda: explain_build(manifest, build_settings))


def _built(
    out: Path | RemoteFolder,
    settings: BuildSettings,
    given: BuildCommandSettings,
    advance: Callable[[int], None],
) -> tuple[Manifest, str]:
    """A dataset's manifest once it is built, and how fast that went."""
    steps = list[int]()

    def count(finished: int) -> None:
        steps.append(finished)
        advance(finished)

    started = perf_counter()
    manifest = build_dataset(out, settings, given.processes, count, given.cluster)
    seconds = perf_counter() - started
    # The first step is what an interrupted run had left: it took no time now.
    made = sum(steps[1:]) * len(manifest.stored_frames)
    return manifest, (
        f"{made:,} of them made in {seconds:.1f} s ({made / seconds:,.0f} images/s)"
        if made
        else "complete already"
    )


_OF_A_TRACK = ("out", "preset", "workers", "cluster")


def _build_track(given: BuildCommandSettings) -> None:
    """Every dataset of the track of rigs below the folder that is ``given``, finished ones kept.
    Raises `BuildError` for options that would make another track of it."""
    for entry in fields(given):
        if entry.name not in _OF_A_TRACK and getattr(given, entry.name) != entry.default:
            raise BuildError(
                f"{flag_of(entry)}: the preset {TRACK} has rigs, lights, objects and sizes of its own; "
                f"leave it out, or build a set of yours with another preset"
            )
    datasets = track()
    samples = sum(len(settings.objects) * len(settings.views) for settings in datasets.values())
    with progress_bar("building", samples, "samples") as advance:
        built = {
            name: _built(given.out / name, settings, given, advance)
            for name, settings in datasets.items()
        }
    for name, (manifest, rate) in built.items():
        print(f"{given.out / name}: {contents(manifest)}; {rate}")
        say_benchmark(manifest)
    print(f"next: fpp-bench predict METHOD {given.out} --out predictions")
