"""Random objects that are none of the benchmark's 50: piles, clusters, frames and reliefs of simple solids.

    python benchmarks/fresh_objects.py meshes --count 36 --seed 7
    fpp-bench build data/fresh --preset full --frames sinusoidal --meshes meshes/list.yaml

Writes binary PLY files in metres and a list of them, all in the training split. The shapes do not depend on the
benchmark's objects; their sizes are similar, about a tenth of the image area.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
import yaml

Random = np.random.Generator
FACETS = 32


def solid(random: Random, size: np.ndarray) -> trimesh.Trimesh:
    """A simple solid that fills a box of ``size`` (x, y, z) in m."""
    kind = random.integers(6)
    if kind <= 1:
        part = trimesh.creation.box((1, 1, 1))
    elif kind == 2:
        part = trimesh.creation.cylinder(0.5, 1.0, sections=FACETS)
    elif kind == 3:
        part = trimesh.creation.icosphere(3, 0.5)
    elif kind == 4:
        part = trimesh.creation.annulus(random.uniform(0.25, 0.42), 0.5, 1.0, sections=FACETS)
    else:
        part = trimesh.creation.cone(0.5, 1.0, sections=FACETS)
        part.apply_translation((0, 0, -0.5))
    part.apply_scale(size)
    return part


def turned(random: Random, part: trimesh.Trimesh, most_rad: float) -> trimesh.Trimesh:
    """``part`` turned about a random axis by up to ``most_rad``."""
    axis = random.standard_normal(3)
    part.apply_transform(trimesh.transformations.rotation_matrix(random.uniform(-most_rad, most_rad), axis))
    return part


def pile(random: Random) -> list[trimesh.Trimesh]:
    """Solids on top of each other, each a little off and turned about the vertical."""
    parts, height = [], 0.0
    footprint = random.uniform(0.12, 0.4, 2)
    for _ in range(random.integers(2, 13)):
        thick = float(np.exp(random.uniform(np.log(0.004), np.log(0.08))))
        part = solid(random, np.array([*(footprint * random.uniform(0.5, 1.1, 2)), thick]))
        part.apply_transform(trimesh.transformations.rotation_matrix(random.normal(0, 0.3), (0, 0, 1)))
        part.apply_translation((*random.normal(0, 0.02, 2), height + thick / 2))
        parts.append(part)
        height += thick * random.uniform(0.9, 1.3)
    return parts


def cluster(random: Random) -> list[trimesh.Trimesh]:
    """Solids of any size and turn in an ellipsoid."""
    reach = random.uniform(0.04, 0.13, 3)
    parts = []
    for _ in range(random.integers(3, 15)):
        part = turned(random, solid(random, np.exp(random.uniform(np.log(0.015), np.log(0.16), 3))), np.pi)
        part.apply_translation(random.normal(0, 1, 3) * reach)
        parts.append(part)
    return parts


def frame(random: Random) -> list[trimesh.Trimesh]:
    """Rods between random corners, some with knobs."""
    box = random.uniform(0.06, 0.4, 3)
    corners = random.uniform(-0.5, 0.5, (random.integers(4, 9), 3)) * box
    parts = []
    for i, j in zip(range(len(corners)), random.permutation(len(corners)), strict=True):
        if i != j:
            radius = float(np.exp(random.uniform(np.log(0.004), np.log(0.03))))
            parts.append(trimesh.creation.cylinder(radius, segment=corners[[i, j]], sections=FACETS // 2))
        if random.random() < 0.5:
            knob = turned(random, solid(random, random.uniform(0.02, 0.09, 3)), np.pi)
            knob.apply_translation(corners[i])
            parts.append(knob)
    return parts


def relief(random: Random) -> list[trimesh.Trimesh]:
    """A body with blocks that stand out of it on all sides."""
    body = random.uniform(0.06, 0.3, 3)
    parts = [solid(random, body)]
    for _ in range(random.integers(4, 30)):
        part = turned(random, solid(random, np.exp(random.uniform(np.log(0.008), np.log(0.09), 3))), 0.5)
        side = random.standard_normal(3)
        side /= np.abs(side).max()
        part.apply_translation(side * body / 2 + random.normal(0, 0.01, 3))
        parts.append(part)
    return parts


KINDS: tuple[Callable[[Random], list[trimesh.Trimesh]], ...] = (pile, cluster, frame, relief)


def fresh_mesh(random: Random, kind: Callable[[Random], list[trimesh.Trimesh]]) -> trimesh.Trimesh:
    """A random object in m, centred, 0.2 to 0.55 m across."""
    mesh = turned(random, trimesh.util.concatenate(kind(random)), 0.3)
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    across = float(np.linalg.norm(mesh.extents))
    mesh.apply_scale(float(np.clip(across, 0.2, 0.55)) / across)
    return mesh


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=36)
    parser.add_argument("--seed", type=int, default=7)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    entries = []
    for number in range(args.count):
        kind = KINDS[number % len(KINDS)]
        name = f"fresh_{number:03d}_{kind.__name__}"
        fresh_mesh(np.random.default_rng([args.seed, number]), kind).export(args.out / f"{name}.ply")
        entries.append({"name": name, "path": f"{name}.ply", "split": "train"})
    (args.out / "list.yaml").write_text(yaml.safe_dump(entries, sort_keys=False), encoding="utf-8")
    print(f"{args.out / 'list.yaml'}: {len(entries)} meshes")


if __name__ == "__main__":
    main()
