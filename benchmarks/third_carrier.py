"""Does a third carrier hold the order of fringes of 6 to 8 px? (docs/results/crossed.md)

    python benchmarks/third_carrier.py --pitches 6,7,8,12

Light adds, so the mean of three crossed frames that show the pairs of three carriers is a frame of
all three, each with a third of the modulation. The validation objects are rendered so, and phases
are measured with the true mask by the windows of `crossed`. Printed are, in per cent of the
object's pixels before any neighbour helps, wrong orders of the pair in a frame of its own, of the
pair in the frame of three, of all three, and of the best two of three; and the mean error of the
phases along the line of depths. The third carrier has the period of the others and the angle at
which the nearest rival of all three is farthest.
"""

import argparse
from dataclasses import replace
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from fpp_ml_bench.baselines.learned.scenes import photographed
from fpp_ml_bench.baselines.phase.geometry import TAU, Carriers, wrapped
from fpp_ml_bench.baselines.phase.local_fit import CURVED, DEMODULATION_PERIODS, WINDOW_SIGMAS
from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.constants import OBJECTS, VIEWS, split_of
from fpp_ml_bench.design.rivals import EpipolarLines
from fpp_ml_bench.design.search import square_pair
from fpp_ml_bench.loaders.render.light import load_light
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.sample import VOID
from fpp_ml_bench.optics.named_rigs import FIRST_SHIFTED_DEG, paper_rig
from fpp_ml_bench.optics.rig import Rig
from fpp_ml_bench.tables import Table

ANGLES_DEG, APART_DEG = np.arange(0, 180, 2.5), 20.0
Wave = tuple[float, float]  # period in px, angle in degrees


def rival_rad(lines: EpipolarLines, waves: list[Wave]) -> float:
    """Distance of the nearest rival in the space of all phases: of any two depths, 2 pi or more
    apart in one phase."""
    cycles = np.array(
        [np.array([np.sin(a), np.cos(a)]) / p for p, a in ((p, np.radians(a)) for p, a in waves)]
    )
    turns = lines.across_px @ cycles.T
    step = np.linspace(0, 1, 400)[1:]
    phases = step[:, None, None] * turns
    order = np.rint(phases)
    distance = TAU * np.sqrt(((phases - order) ** 2).sum(axis=-1))
    return float(np.where((order != 0).any(axis=-1), distance, np.inf).min())


def third(lines: EpipolarLines, pair: list[Wave]) -> tuple[float, Wave]:
    """The third carrier, and the distance of the nearest rival with it."""
    apart = [np.abs((ANGLES_DEG - angle + 90) % 180 - 90) >= APART_DEG for _, angle in pair]
    angles = ANGLES_DEG[np.logical_and(*apart)]
    return max((rival_rad(lines, [*pair, (pair[0][0], a)]), (pair[0][0], float(a))) for a in angles)


def measured_phases(grey: NDArray, steps: NDArray, sigma_px: float) -> NDArray:
    """Wrapped phases (n, H, W) of carriers that change by ``steps`` (n, 2) rad a px along x and
    y."""
    half = int(np.ceil(WINDOW_SIGMAS * sigma_px))
    x, y = np.meshgrid(*[np.arange(-half, half + 1.0)] * 2)
    window = np.exp(-0.5 * (x * x + y * y) / sigma_px**2).ravel()
    terms = [(x / sigma_px) ** a * (y / sigma_px) ** b for a, b in CURVED]
    for across, down in steps:
        terms += [np.cos(across * x + down * y), np.sin(across * x + down * y)]
    design = np.stack([term.ravel() for term in terms], axis=1)
    solution = np.linalg.solve(design.T @ (window[:, None] * design), (window[:, None] * design).T)
    kernels = solution.reshape(-1, *x.shape)[len(CURVED) :]
    cosines, sines = (
        np.stack([fftconvolve(grey, k[::-1, ::-1], "same") for k in kernels[n::2]]) for n in (0, 1)
    )
    return np.arctan2(-sines, cosines)


def wrong_orders(
    rig: Rig, carriers: list[Carriers], phases: NDArray, truth: NDArray, which: int
) -> tuple[float, float]:
    """Share of wrong orders by the best ``which`` of ``carriers``, and mean error along the line of
    right ones; maps at the object's pixels, (n, k) and (k,)."""
    gain = np.stack([one.gain[0] for one in carriers])
    residual = wrapped(phases - np.stack([one.infinity_rad[0] for one in carriers]))
    joint = np.sqrt((gain**2).sum(axis=0))
    near, far = (carriers[0].nearness(end) for end in rig.working_range_mm)
    lowest, highest = np.minimum(near, far) * gain[0], np.maximum(near, far) * gain[0]
    lowest, highest = np.minimum(lowest, highest), np.maximum(lowest, highest)
    first = np.ceil((lowest - residual[0]) / TAU)
    best, chosen = np.full(truth.shape, np.inf), np.zeros(truth.shape)
    for turn in range(int(np.ceil((highest - lowest).max() / TAU)) + 1):
        psi = residual[0] + TAU * (first + turn)
        beside = wrapped(residual - psi / gain[0] * gain)
        nearness = psi / gain[0] + (gain * beside).sum(axis=0) / joint**2
        left = wrapped(residual - nearness * gain) ** 2
        misfit = np.sort(left, axis=0)[:which].sum(axis=0)
        better = (misfit < best) & (psi <= highest)
        best, chosen = np.where(better, misfit, best), np.where(better, nearness, chosen)
    error = np.abs(chosen - truth) * joint
    wrong = error > np.pi / 2
    return 100 * float(wrong.mean()), float(error[~wrong].mean())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pitches", default="6,7,8,12")
    parser.add_argument("--lights", default="paper,workshop")
    parser.add_argument("--views", default=VIEWS[0])
    given = parser.parse_args()
    rig, rows = paper_rig(), []
    lines = EpipolarLines.of(rig)
    objects = tuple(name for name in OBJECTS if split_of(name) == "validation")
    for pitch, light in product(map(float, given.pitches.split(",")), given.lights.split(",")):
        square = square_pair(lines, pitch)
        waves = [(pitch, angle) for angle in square.angles_deg]
        farthest, wave = third(lines, waves)
        waves.append(wave)
        families = [
            Crossed((a[0], b[0]), (a[1], b[1]), shifts_deg=FIRST_SHIFTED_DEG)
            for a, b in combinations(waves, 2)
        ]
        rigs = [rig.with_crossed(family) for family in families]
        studios = [
            Studio(BuildSettings(rig=one, objects=objects, light=load_light(light))) for one in rigs
        ]
        of_pair = [
            Carriers.of(one, replace(family, shifts_deg=((0.0, 0.0),)))
            for one, family in zip(rigs, families, strict=True)
        ]
        steps = np.stack([of_pair[0].step_rad[0], of_pair[0].step_rad[1], of_pair[1].step_rad[1]])
        found = []
        for name, view in product(objects, given.views.split(",")):
            frames, exact, flags = zip(
                *(
                    photographed(studio, name, view, (studio.rig.sequence.crossed_frames[0],))
                    for studio in studios
                ),
                strict=True,
            )
            target = (exact[0] > 0) & ((flags[0] & VOID) == 0)
            where = np.nonzero(target)
            sigma_px = DEMODULATION_PERIODS * of_pair[0].period_px
            alone = measured_phases(frames[0][0].astype(np.float64), steps[:2], sigma_px)[:, *where]
            together = measured_phases(np.mean([f[0] for f in frames], axis=0), steps, sigma_px)[
                :, *where
            ]
            at = [
                _single(of_pair[0], 0, where),
                _single(of_pair[0], 1, where),
                _single(of_pair[1], 1, where),
            ]
            truth = at[0].nearness(exact[0][where])
            of_two, along = wrong_orders(rig, at[:2], alone, truth, 2)
            among, _ = wrong_orders(rig, at[:2], together[:2], truth, 2)
            of_three, along_three = wrong_orders(rig, at, together, truth, 3)
            best_two, _ = wrong_orders(rig, at, together, truth, 2)
            found.append((of_two, among, of_three, best_two, along, along_three))
        means = np.mean(found, axis=0)
        names = (
            "pair, %",
            "pair among three, %",
            "three, %",
            "best two, %",
            "along, pair, rad",
            "along, three, rad",
        )
        figures = {
            key: f"{value:.3f}" if "rad" in key else f"{value:.2f}"
            for key, value in zip(names, means, strict=True)
        }
        rivals = f"{rival_rad(lines, waves[:2]):.2f} / {farthest:.2f}"
        rows.append(
            {
                "period, px": f"{pitch:g}",
                "light": light,
                "third at": f"{wave[1]:g}",
                "rival, rad": rivals,
                **figures,
            }
        )
        print(rows[-1], flush=True)
    print("\n".join(Table.of("third carrier", rows, words=(0, 1)).markdown()))


def _single(carriers: Carriers, number: int, where: tuple[NDArray, ...]) -> Carriers:
    maps = (
        carriers.infinity_rad[[number]][:, *where],
        carriers.gain[[number]][:, *where],
        carriers.forward[where],
    )
    return replace(carriers, infinity_rad=maps[0], gain=maps[1], forward=maps[2])


if __name__ == "__main__":
    main()
