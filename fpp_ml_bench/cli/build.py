"""``fpp-bench build``: generate the benchmark."""

import argparse
from dataclasses import replace
from pathlib import Path
from time import perf_counter

from fpp_ml_bench import coding, optics
from fpp_ml_bench.cli import add_pool_options, workers_of
from fpp_ml_bench.cli.console import gigabytes, progress_bar, say_benchmark
from fpp_ml_bench.cli.explain import add_explain_options, as_asked, explain
from fpp_ml_bench.constants import CONFIGS, LARGEST_SIDE_PX, PRESETS
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders import render, storage
from fpp_ml_bench.remote import place

SUMMARY = "Generate the benchmark: virtual rig, objects, six views each, decoded and exact ground truth."
EXAMPLES = (
    "fpp-bench build data/mini --preset mini                      6 objects at 480 px, all 52 frames",
    "fpp-bench build data/full --preset full                      the whole set: 50 objects, 960 px, 15,600 images",
    "fpp-bench build data/unseen --preset unseen                  20 other objects at 960 px, all in split test",
    "fpp-bench build data/crossed --preset full --rig crossed     the same views in 3 frames of crossed fringes",
    "fpp-bench build data/train --preset full --frames single_shot    frame 0 and depth only",
    "fpp-bench build data/hard --preset mini --placement varied   no distance prior helps",
    "fpp-bench build data/workshop --preset full --light workshop     the same views under a workshop's light",
    "fpp-bench build data/test --preset test --light hard         the test objects alone, to score in that light",
    "fpp-bench build data/mine --mesh part.stl --size 960         a mesh of yours (metres)",
    "fpp-bench build data/lab --decode-with found.yaml            ground truth by the rig that a calibration found",
    "fpp-bench build s3://bucket/full --preset full --cluster ray://head:10001    on all nodes of a Ray cluster",
    "fpp-bench build data/pen --objects pen --explain             what was left out, and what it saved",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "out",
        type=place,
        metavar="OUT",
        help="new folder, or one whose build was interrupted; or a URL: s3://bucket/set",
    )
    parser.add_argument("--preset", choices=tuple(PRESETS), default="mini", help="objects and size (default: mini)")
    parser.add_argument("--size", type=int, metavar="PX", help="image width and height (default: the preset's)")
    parser.add_argument("--objects", metavar="A,B", help="objects by name, comma separated (default: the preset's)")
    parser.add_argument(
        "--placement",
        choices=("fixed", "varied"),
        default="fixed",
        help="all objects at the standoff, or a distance drawn per view",
    )
    parser.add_argument("--frames", choices=CONFIGS, help="frames to store (default: all; with --rig crossed: crossed)")
    parser.add_argument("--seed", type=int, default=42, help="seed of noise and placement (default: 42)")
    add_pool_options(parser)
    parser.add_argument(
        "--rig",
        default="paper",
        metavar="paper|crossed|FILE",
        help="the paper's, the same with crossed fringes, or a rig file (default: paper)",
    )
    parser.add_argument(
        "--decode-with",
        type=Path,
        metavar="FILE",
        help="rig that a calibration found: it decodes the ground truth and is the dataset's; --rig photographs",
    )
    parser.add_argument("--pitch", type=float, metavar="PX", help="fringe period in projector px, both directions")
    parser.add_argument(
        "--light",
        default="paper",
        metavar="NAME|FILE",
        help="paper, workshop, hard, or a YAML file with other numbers (default: paper)",
    )
    parser.add_argument(
        "--noise-sigma",
        type=float,
        metavar="GREY",
        help="sensor noise at mid-grey, grey levels of 255, half of its variance shot noise (default: the light's)",
    )
    parser.add_argument("--shadows", action="store_true", help="let objects cast shadows, whatever the light says")
    parser.add_argument(
        "--mesh",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="a mesh of yours in metres (OBJ, PLY, STL, GLB); repeatable",
    )
    parser.add_argument("--meshes", type=Path, metavar="LIST.yaml", help="meshes of yours with scale, pose and split")
    add_explain_options(parser)


def settings_of(args: argparse.Namespace) -> "render.BuildSettings":
    """Build settings that the arguments ask for; raises `BuildError`, `MeshError` or `RigError`."""
    objects, size = PRESETS[args.preset]
    if args.size is not None and not 1 <= args.size <= LARGEST_SIDE_PX:
        raise BuildError(f"--size {args.size}: expected 1 to {LARGEST_SIDE_PX} px")
    if args.rig in optics.NAMED_RIGS:
        rig = optics.NAMED_RIGS[args.rig](args.size or size)
    else:
        rig = optics.load_rig(args.rig)
        rig = rig if args.size is None else rig.scaled(args.size)
    if args.pitch is not None:
        sequence = rig.paper_sequence
        if args.pitch >= 4:  # below that the rig itself refuses, with its own words
            lengths = (rig.pattern_length(direction) for direction in optics.DIRECTIONS)
            horizontal, vertical = (coding.bits_needed(length, args.pitch) for length in lengths)
            horizontal, vertical = max(sequence.bits_horizontal, horizontal), max(sequence.bits_vertical, vertical)
            sequence = replace(sequence, bits_horizontal=horizontal, bits_vertical=vertical)
        rig = replace(rig, pitch_horizontal_px=args.pitch, pitch_vertical_px=args.pitch, sequence=sequence)
    own = (render.read_mesh_list(args.meshes) if args.meshes else ()) + tuple(map(render.single_mesh, args.mesh))
    if args.objects is not None:
        objects = tuple(name.strip() for name in args.objects.split(",") if name.strip())
    elif own:
        objects = ()
    names = (*objects, *(mesh.name for mesh in own))
    light = render.load_light(args.light)
    if args.noise_sigma is not None:
        if not 0 <= args.noise_sigma <= 50:
            raise BuildError(f"--noise-sigma {args.noise_sigma:g}: expected 0 to 50 grey levels")
        light = light.changed("camera", **render.camera_noise(args.noise_sigma))
    if args.shadows:
        light = light.changed("bounces", shadows=True)
    found = None if args.decode_with is None else optics.load_rig(args.decode_with)
    stored = args.frames or render.default_frames(args.rig)
    return render.BuildSettings(rig, names, args.placement, stored, args.seed, light, own, found)


def run(args: argparse.Namespace) -> int:
    with as_asked(args):
        return _run(args)


def _run(args: argparse.Namespace) -> int:
    settings = settings_of(args)
    workers = workers_of(args)
    assembly = render.assembly_of(settings)
    rows = sum(len(plan.samples) for plan in assembly.plans)
    frames = len(assembly.manifest.stored_frames)
    steps: list[int] = []
    started = perf_counter()
    with progress_bar("building", rows, "images", frames) as advance:

        def count(finished: int) -> None:
            steps.append(finished)
            advance(finished)

        manifest = render.build(args.out, settings, workers, count, args.cluster)
    seconds = perf_counter() - started
    # The first step is what an interrupted run had left: it took no time now.
    made = sum(steps[1:]) * frames
    rate = f"{made:,} of them made in {seconds:.1f} s ({made / seconds:,.0f} images/s)" if made else "complete already"
    parts = ", ".join(f"{split} {len(rows)}" for split, rows in manifest.samples.items())
    size = gigabytes(sum(file.bytes for file in manifest.files))
    print(f"{args.out}: {parts} samples, {rows * frames:,} images, {size}; {rate}")
    for line in storage.ground_truth_summary(manifest):
        print(f"  {line}")
    say_benchmark(manifest)
    if isinstance(args.out, Path):
        print(f"next: fpp-bench info {args.out}")
    explain(args, lambda: render.explain_build(manifest, settings))
    return 0
