"""Where the millimetres of one crossed frame are, and what the mask costs when the frame is
disturbed.

    python benchmarks/crossed_errors.py DATASET [--method crossed] [--split validation] [--views 3] [--only KIND]

DATASET: built with ``fpp-bench build --rig crossed``. Every kind of disturbance changes the same
views by arithmetic on their grey levels, by known masks and exact depths: noise, texture in patches
and checks on the object, gamma. For each are printed: object pixels without a depth (missed) and
background pixels with one (invented), both as a share of the image; median, MAE and RMSE of what is
answered, the MAE over the whole object (a missed pixel counts with its depth), and seconds a frame;
on stderr also which share of the pixels the stated intervals hold, and MAE and RMSE of the surest
95% of what is answered. Then, of the undisturbed views, which share of the pixels, of the absolute
and of the squared error is missed, a wrong order, near a depth edge, and the rest. Void pixels
count nowhere.
"""

import argparse
import sys
from collections.abc import Callable
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fpp_ml_bench.api import load_method
from fpp_ml_bench.baselines.robustness.axes import corruptions
from fpp_ml_bench.depth import object_mask, object_near_edges
from fpp_ml_bench.loaders.sample import DEPTH_EXACT
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.tables import Table

Image = NDArray[np.float64]
Mask = NDArray[np.bool_]
PATCH_PX, CHECK_PX = 48, 32  # side of a patch of texture, and of a check
NEAR_PX = 8
EMPTY_GREY = 3.0  # of a scene without a wall
INTERVALS = {"68%": 0.9945, "95%": 1.96, "99%": 2.576}
SUREST = 0.95  # share of the answered pixels, those of the least sigma


def _cells(shape: tuple[int, int], side_px: int, values: NDArray) -> Image:
    """``values`` (a, b) as squares of ``side_px`` over an image of ``shape``."""
    rows, columns = (np.arange(length) // side_px for length in shape)
    return values[np.ix_(rows % values.shape[0], columns % values.shape[1])]


def _noise(grey: Image, inside: Mask, draw: np.random.Generator) -> Image:
    return grey + draw.normal(0, 4, grey.shape)


def _patches(grey: Image, inside: Mask, draw: np.random.Generator) -> Image:
    return np.where(
        inside, grey * _cells(grey.shape, PATCH_PX, draw.uniform(0.4, 1, (40, 40))), grey
    )


def _checks(grey: Image, inside: Mask, draw: np.random.Generator) -> Image:
    return np.where(
        inside, grey * _cells(grey.shape, CHECK_PX, np.array([[0.35, 1.0], [1.0, 0.35]])), grey
    )


def _patches_everywhere(grey: Image, inside: Mask, draw: np.random.Generator) -> Image:
    return grey * _cells(grey.shape, PATCH_PX, draw.uniform(0.4, 1, (40, 40)))


def _checks_everywhere(grey: Image, inside: Mask, draw: np.random.Generator) -> Image:
    return grey * _cells(grey.shape, CHECK_PX, np.array([[0.35, 1.0], [1.0, 0.35]]))


def _gamma(grey: Image, inside: Mask, draw: np.random.Generator) -> Image:
    return 255 * (grey / 255) ** 2.2


def _paint(grey: Image, inside: Mask, draw: np.random.Generator) -> Image:
    return np.where(inside, 0.15 * grey, grey) + draw.normal(0, 1, grey.shape)


def _dark_wall(grey: Image, inside: Mask, draw: np.random.Generator) -> Image:
    return np.where(inside, grey, 0.15 * grey) + draw.normal(0, 1, grey.shape)


def _no_wall(grey: Image, inside: Mask, draw: np.random.Generator) -> Image:
    return np.where(inside, grey, EMPTY_GREY + draw.normal(0, 1, grey.shape))


KINDS: dict[str, Callable[[Image, Mask, np.random.Generator], Image]] = {
    "clean": lambda grey, inside, draw: grey,
    "noise of 4 grey levels more": _noise,
    "texture in patches, 0.4 to 1": _patches,
    "hard checks, 0.35 and 1": _checks,
    "the same texture, on the wall too": _patches_everywhere,
    "the same checks, on the wall too": _checks_everywhere,
    "gamma 2.2": _gamma,
    "dark paint, 0.15": _paint,
    "dark wall, 0.15": _dark_wall,
    "no wall": _no_wall,
}


def measured(
    name: str,
    kind: str,
    dataset: DatasetFolder,
    samples: list[str],
    **options: Any,
) -> dict[str, Any]:
    """What a method makes of ``samples`` under a kind of disturbance, means over them; ``pixels``:
    by what they are."""
    method = load_method(name, dataset, **options)
    rows, parts = [], []
    for number, sample in enumerate(samples):
        exact = dataset.depth_mm(sample, DEPTH_EXACT)
        inside, void = object_mask(exact), dataset.void(sample, DEPTH_EXACT)
        whole: list[Any] = [None] * len(dataset.sequence)
        for used in method.frames_used:
            draw = np.random.default_rng([7, number, used][: 3 if used else 2])
            grey = KINDS[kind](dataset.frame(sample, used).astype(np.float64), inside, draw)
            whole[used] = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
        began = perf_counter()
        answer = method.answer(whole)
        seconds = perf_counter() - began
        depth = answer.depth.astype(np.float64)
        true, false = inside & ~void, ~inside & ~void
        error = np.abs(depth - exact)
        answered = true & (depth > 0)
        rows.append(
            {
                "missed": (true & (depth == 0)).sum() / true.size,
                "invented": (false & (depth > 0)).sum() / true.size,
                "median": np.median(error[answered]) if answered.any() else np.nan,
                "mae": error[answered].mean() if answered.any() else np.nan,
                "rmse": np.sqrt((error[answered] ** 2).mean()) if answered.any() else np.nan,
                "whole": error[true].mean(),
                "whole_rmse": np.sqrt((error[true] ** 2).mean()),
                "background": depth[false].mean(),
                "seconds": seconds,
            }
        )
        if answer.sigma_mm is not None and answered.any():
            sigma, off = answer.sigma_mm[answered], error[answered]
            surest = off[sigma <= np.quantile(sigma, SUREST)]
            held = {
                f"within {name}": 100 * (off < width * sigma).mean()
                for name, width in INTERVALS.items()
            }
            rows[-1] |= {
                **held,
                "surest": surest.mean(),
                "surest_rmse": np.sqrt((surest**2).mean()),
            }
        edges = object_near_edges(exact, [NEAR_PX])[0]
        where = {"missed": true & (depth == 0)}
        where["wrong order"] = answered & (error > corruptions().wrong_order_mm)
        taken = where["missed"] | where["wrong order"]
        where[f"within {NEAR_PX} px of an edge"] = true & edges & ~taken
        where["the rest"] = true & ~edges & ~taken
        parts.append(
            {
                key: (mask.sum(), error[mask].sum(), (error[mask] ** 2).sum())
                for key, mask in where.items()
            }
        )
    means = {key: float(np.nanmean([row[key] for row in rows])) for key in rows[0]}
    sums = {key: np.sum([part[key] for part in parts], axis=0) for key in parts[0]}
    return means | {"parts": sums}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset")
    parser.add_argument("--method", default="crossed")
    parser.add_argument("--weights")
    parser.add_argument("--split", default="validation")
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--only", choices=list(KINDS))
    parser.add_argument("--frames", type=int, default=1, help="of crossed")
    parser.add_argument("--min-confidence", type=float, default=0.0)
    given = parser.parse_args()
    dataset = DatasetFolder(given.dataset)
    options: dict[str, Any] = {"min_confidence": given.min_confidence}
    options |= {"weights": given.weights} if given.weights else {}
    options |= {"frames": given.frames} if given.method == "crossed" else {}
    samples = [
        s for s in dataset.samples(given.split) if int(s.rpartition("_A")[2]) // 60 < given.views
    ]
    rows = []
    parts = None
    for kind in [given.only] if given.only else KINDS:
        found = measured(given.method, kind, dataset, samples, **options)
        parts = parts or found["parts"]
        rows.append(
            {
                "frame": kind,
                "missed": f"{100 * found['missed']:.3f}%",
                "invented": f"{100 * found['invented']:.3f}%",
                "median, mm": f"{found['median']:.2f}",
                "answered: MAE, mm": f"{found['mae']:.2f}",
                "RMSE, mm": f"{found['rmse']:.1f}",
                "whole object: MAE, mm": f"{found['whole']:.2f}",
                "whole RMSE": f"{found['whole_rmse']:.1f}",
                "background, mm": f"{found['background']:.2f}",
                "s": f"{found['seconds']:.2f}",
            }
        )
        stated = {
            key: round(value, 2)
            for key, value in found.items()
            if key.startswith(("within", "surest"))
        }
        print(rows[-1] | stated, file=sys.stderr, flush=True)
    title = f"{given.method}, {len(samples)} views of {given.split}, {given.dataset}"
    print("\n".join([title, "", *Table.of(title, rows, words=(0,)).markdown(), ""]))
    if parts:
        totals = np.sum(list(parts.values()), axis=0)
        shares = [
            {
                "pixels": key,
                **{
                    n: f"{100 * v:.2f}%"
                    for n, v in zip(
                        ("share", "of the error", "squared"), values / totals, strict=True
                    )
                },
            }
            for key, values in parts.items()
        ]
        print("\n".join(Table.of("where the millimetres are", shares, words=(0,)).markdown()))


if __name__ == "__main__":
    main()
