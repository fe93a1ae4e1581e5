"""Does a build give the same bytes on other processors? Builds a small set as if this were one, and
compares.

    python benchmarks/same_bytes.py [--preset mini] [--size 176] [--objects mug,mustard_bottle] [--work DIR]

Each build is a process of its own that is denied some of this processor's instruction sets: numba
compiles for a generic x86-64, NumPy and the C library leave out AVX2, AVX-512 and fused
multiply-adds, OpenBLAS takes its oldest kernels. Prints a fingerprint for each, a hash of all 70
meshes in float64, and one of two frames of every robustness axis at its last severity; exit status
1 if two differ. With no options a minute or two; ``--preset full --size 960`` is the whole
benchmark, ``--preset rigs`` the track of rigs.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from hashlib import sha256
from pathlib import Path

NO_AVX512 = "X86_V4 AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"
NO_AVX = f"AVX2 FMA3 X86_V3 {NO_AVX512}"
GLIBC = "glibc.cpu.hwcaps=-AVX512F,-AVX2,-AVX,-FMA,-FMA4"
WAYS: dict[str, dict[str, str]] = {
    "as it is": {},
    "one worker": {"WORKERS": "1"},
    "numba for a generic processor": {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""},
    "NumPy without AVX-512": {"NPY_DISABLE_CPU_FEATURES": NO_AVX512},
    "NumPy without AVX": {"NPY_DISABLE_CPU_FEATURES": NO_AVX},
    "C library without AVX and FMA": {"GLIBC_TUNABLES": GLIBC},
    "OpenBLAS for Nehalem": {"OPENBLAS_CORETYPE": "Nehalem"},
    "all of these": {
        "NUMBA_CPU_NAME": "generic",
        "NUMBA_CPU_FEATURES": "",
        "NPY_DISABLE_CPU_FEATURES": NO_AVX,
        "GLIBC_TUNABLES": GLIBC,
        "OPENBLAS_CORETYPE": "Nehalem",
        "WORKERS": "1",
    },
}


MESHES = """\
import hashlib, sys
from fpp_ml_bench.baselines.robustness.axes import Condition, FrameCache, corruptions
from fpp_ml_bench.cli import main
from fpp_ml_bench.constants import OBJECTS, UNSEEN
from fpp_ml_bench.loaders.render.meshes import solid_mesh
digest = hashlib.sha256()
for name in (*OBJECTS, *UNSEEN):
    mesh = solid_mesh(name)
    digest.update(mesh.vertices_m.tobytes() + mesh.faces.tobytes())
frames = hashlib.sha256()
for axis in corruptions().axes:
    condition = Condition(axis, 5, ("v_groove",), 176)
    for frame in FrameCache(None).frames(condition, "v_groove", "A0", (0, 18)):
        frames.update(b"" if frame is None else frame.tobytes())
print(digest.hexdigest(), frames.hexdigest())
sys.exit(main(sys.argv[1:]))
"""
"""Prints a hash of all 70 meshes in float64, whose last bits float32 depths would hide, and one of
disturbed frames, and runs `fpp-bench`."""


def fingerprints(way: str, settings: list[str], work: Path) -> tuple[str, str, str]:
    """Fingerprint of a build by `fpp-bench build` with the environment of ``way``, and the hashes
    of the meshes and of disturbed frames."""
    environment = {**os.environ, **WAYS[way]}
    workers = environment.pop("WORKERS", "2")
    if "NUMBA_CPU_NAME" in WAYS[way]:
        environment["NUMBA_CACHE_DIR"] = str(work / "compiled")
    folder = work / way.replace(" ", "-")
    command = [
        sys.executable,
        "-c",
        MESHES,
        "build",
        "--out",
        str(folder),
        *settings,
        "--workers",
        workers,
    ]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{way}: the build failed:\n{done.stderr}")
    # One dataset, or all those of the track of rigs.
    manifests = sorted(folder.rglob("manifest.json"))
    prints = [str(json.loads(file.read_text())["fingerprint"]) for file in manifests]
    shutil.rmtree(folder)
    meshes, frames = done.stdout.split(maxsplit=2)[:2]
    whole = prints[0] if len(prints) == 1 else sha256("".join(prints).encode()).hexdigest()
    return whole, meshes, frames


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--preset",
        choices=("mini", "full", "unseen", "rigs"),
        default="mini",
        help="preset (default: mini)",
    )
    parser.add_argument(
        "--size", type=int, default=176, metavar="PX", help="image size (default: 176)"
    )
    parser.add_argument("--objects", metavar="A,B", help="objects (default: the preset's)")
    parser.add_argument(
        "--light", default="paper", metavar="NAME|FILE", help="light (default: paper)"
    )
    parser.add_argument(
        "--work", type=Path, help="folder to work in (default: a temporary one, removed afterwards)"
    )
    parser.add_argument("--only", nargs="+", choices=WAYS, metavar="WAY", help="some of the ways")
    args = parser.parse_args()
    settings = ["--preset", args.preset]
    if args.preset != "rigs":  # which has sizes, lights and objects of its own
        settings += ["--size", str(args.size), "--light", args.light]
        settings += ["--objects", args.objects] if args.objects else []
    prints = {}
    with tempfile.TemporaryDirectory(dir=args.work) as folder:
        for way in args.only or WAYS:
            prints[way] = fingerprints(way, settings, Path(folder))
            fingerprint, meshes, frames = prints[way]
            print(
                f"{fingerprint[:16]}  meshes {meshes[:8]}  disturbed {frames[:8]}  {way}",
                flush=True,
            )
    same = len(set(prints.values())) == 1
    print(f"{len(prints)} builds, {'one fingerprint' if same else 'DIFFERENT fingerprints'}")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
