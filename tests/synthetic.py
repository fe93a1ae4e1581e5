"""Datasets of noise, made in milliseconds by the real writer, of any objects and splits."""

from dataclasses import dataclass

import numpy as np

from fpp_ml_bench.constants import VIEWS
from fpp_ml_bench.loaders.sample import Row
from fpp_ml_bench.loaders.storage.assembly import Assembly, assemble
from fpp_ml_bench.loaders.storage.manifest import Manifest
from fpp_ml_bench.loaders.storage.shards import plan_shards
from fpp_ml_bench.optics.named_rigs import paper_rig

SIZE = (12, 16)
SPLITS = {"train": ("bowl", "cork"), "validation": ("mug",), "test": ("power_drill",)}


@dataclass(frozen=True)
class SyntheticRows:
    """Rows of noise, a seed per sample; ``same`` gives a sample the frame of another, ``spoil`` a
    wrong depth."""

    same: tuple[tuple[str, str], ...] = ()
    spoil: tuple[str, float] | None = None

    def __call__(self, plan, folder):
        return (self.row(*sample) for sample in plan.samples)

    def row(self, sample, name, view):
        def noise(label):
            return np.random.default_rng(list(label.encode()))

        depth = noise(sample + "depth").uniform(1500, 2100, SIZE).astype(np.float32)
        depth[:3] = 0
        exact = np.where(depth > 0, depth + np.float32(0.1), np.float32(0))
        if self.spoil and self.spoil[0] == sample:
            depth[5, 5] = self.spoil[1]
            if self.spoil[1] == 0:
                depth[:] = 0
        frame = noise(dict(self.same).get(sample, sample)).integers(0, 256, SIZE, dtype=np.uint8)
        return Row(
            sample,
            name,
            view,
            {0: frame},
            depth,
            exact,
            {},
            np.zeros(depth.shape, np.uint8),
            np.full(depth.shape, 255, np.uint8),
        )


def assembly(splits=SPLITS, views=VIEWS, origin="generated", **changes):
    """A dataset of noise to be written."""
    plans = []
    for split, names in splits.items():
        plans += plan_shards(
            split, {name: [(f"{name}_{v}", name, v) for v in views] for name in names}
        )
    manifest = Manifest(
        origin=origin,
        generator={"name": "test", "version": "0"},
        settings={},
        rig=paper_rig().to_dict(),
        size=SIZE,
        stored="single_shot",
        exact=True,
        samples={},
        shards=[],
    )
    return Assembly(plans, SyntheticRows(**changes), manifest)


def make(folder, *words, **changes):
    """Write it; the folder."""
    assemble(folder, assembly(*words, **changes), workers=1)
    return folder
