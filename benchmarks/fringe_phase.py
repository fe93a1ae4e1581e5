"""How exact the wrapped phase of one fringe is, by method, beside what others would use.

    python benchmarks/fringe_phase.py DATASET [--split validation] [--views 3] [--fringes horizontal] [--members N]

DATASET: 960 px, of any light; with crossed fringes (``--rig crossed``) for ``--fringes crossed``,
where the two phases are those of the carriers. Printed for each method: the mean absolute error in
rad of the object's pixels 3 px or more from depth edges and of those nearer, the median of all, and
the share beyond 0.3 rad; pixels that are void count nowhere. The truth is the phase of the exact
depth. Every method is given the true mask.

``local fit`` is that of ``phase`` (one direction) or ``crossed``. ``Fourier`` is Takeda's: the
half-plane around the carrier under a Hann window (Takeda et al., JOSA 72:156, 1982). ``windowed
Fourier`` filters under a Gaussian of 0.9 periods around frequencies near the carrier's, and drops
what is below six sigmas of the noise (Kemao, Optics and Lasers in Engineering 45:304, 2007); of
four windows and spreads tried on validation views, this has the least error.
"""

import argparse
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from fpp_ml_bench.api import load_method
from fpp_ml_bench.baselines.learned.method import MEMBERS, FringeNetMethod
from fpp_ml_bench.baselines.phase.geometry import TAU, wrapped
from fpp_ml_bench.baselines.phase.observe import CrossedObservation, Observation
from fpp_ml_bench.constants import MM_PER_M
from fpp_ml_bench.depth import object_mask, object_near_edges
from fpp_ml_bench.evaluation.protocol import EDGE_BAND_PX
from fpp_ml_bench.loaders.sample import DEPTH_EXACT
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.tables import Table

FAR_RAD = 0.3
BAND = 0.6  # half width of Takeda's window, as a share of the carrier's frequency
WINDOW_PERIODS, SPREAD, STEPS, SIGMAS = 0.9, 0.35, 5, 6.0
"""Of the windowed Fourier filter: its Gaussian in periods, how far its frequencies go, as a share
of the carrier's, in how many steps along each axis, and the threshold in sigmas of the noise."""


def fourier(grey: NDArray, step_rad: NDArray, noise_grey: float) -> NDArray:
    """Takeda's phase (H, W) of the carrier that advances by ``step_rad`` along x and y."""
    frequencies = np.meshgrid(*(fft.fftfreq(length) for length in grey.shape[::-1]))
    centre = step_rad / TAU
    apart = np.hypot(frequencies[0] - centre[0], frequencies[1] - centre[1]) / (
        BAND * np.hypot(*centre)
    )
    window = np.where(apart < 1, 0.5 + 0.5 * np.cos(np.pi * np.minimum(apart, 1)), 0)
    return np.angle(fft.ifft2(fft.fft2(grey - grey.mean()) * window))


def windowed_fourier(grey: NDArray, step_rad: NDArray, noise_grey: float) -> NDArray:
    """Kemao's windowed Fourier filter."""
    spectrum = fft.fft2(grey - grey.mean())
    frequencies = [
        TAU * axis for axis in np.meshgrid(*(fft.fftfreq(length) for length in grey.shape[::-1]))
    ]
    reach, window_px = SPREAD * np.hypot(*step_rad), WINDOW_PERIODS * TAU / np.hypot(*step_rad)
    total = np.zeros(grey.shape, np.complex128)
    # Noise of a coefficient of the window of unit energy.
    limit = SIGMAS * noise_grey
    for across in step_rad[0] + np.linspace(-reach, reach, STEPS):
        for down in step_rad[1] + np.linspace(-reach, reach, STEPS):
            squared = (frequencies[0] - across) ** 2 + (frequencies[1] - down) ** 2
            window = 2 * np.sqrt(np.pi) * window_px * np.exp(-0.5 * window_px**2 * squared)
            found = fft.ifft2(spectrum * window)
            found[np.abs(found) < limit] = 0
            total += fft.ifft2(fft.fft2(found) * window)
    return np.angle(total)


def learned_phases(method: FringeNetMethod, seen: Observation | CrossedObservation) -> NDArray:
    """What the networks say of an observation, (K, h, w) rad."""
    found = method.route.phases(seen)
    return found.other_phase[0][None] if isinstance(found, Observation) else found.phase_rad


def phases(
    dataset: DatasetFolder,
    sample: str,
    fringes: str,
    methods: dict[str, Any],
    inside: NDArray,
    exact: NDArray,
) -> tuple[NDArray, dict[str, NDArray]]:
    """True wrapped phases (K, H, W), and those of each method."""
    measured = methods["local fit"]
    frame = dataset.frame(sample, measured.frames_used[0])
    seen = measured.route.observe(frame, inside)
    depth = np.where(inside, exact, 1000.0)
    found: dict[str, NDArray] = {}
    if fringes == "crossed":
        carriers = measured.route.model.carriers
        truth, steps = carriers.phases(carriers.nearness(depth)), carriers.step_rad
        local = np.zeros(truth.shape, np.float32)
        local[:, *seen.crop] = seen.phase_rad
    else:
        layer = measured.route.model.layer
        truth = layer.absolute_phase(depth)[None]
        carrier = layer.absolute_phase(np.full(depth.shape, dataset.rig.standoff_m * MM_PER_M))
        steps = np.array([[np.diff(carrier, axis=axis).mean() for axis in (1, 0)]])
        local = np.zeros(truth.shape, np.float32)
        local[0][seen.crop] = seen.phase_rad
    found["local fit"] = local
    grey = frame.astype(np.float64)
    transforms: dict[str, Callable[..., NDArray]] = {
        "Fourier": fourier,
        "windowed Fourier": windowed_fourier,
    }
    for name, transform in transforms.items():
        found[name] = np.stack(
            [transform(grey, step, seen.background.noise_grey) for step in steps]
        )
    for name, method in methods.items():
        if name == "local fit":
            continue
        learned = np.zeros(truth.shape, np.float32)
        learned[:, *seen.crop] = learned_phases(method, seen)
        found[name] = learned
    return truth, found


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=DatasetFolder)
    parser.add_argument("--split", default="validation")
    parser.add_argument("--views", type=int, default=3, help="of each object (default: 3)")
    parser.add_argument(
        "--fringes", choices=("horizontal", "vertical", "crossed"), default="horizontal"
    )
    parser.add_argument(
        "--members", type=int, default=MEMBERS, help="of fringe-net, 0 for without (default: all)"
    )
    parser.add_argument(
        "--weights", action="append", default=[], help="of one network of fringe-net, another line"
    )
    given = parser.parse_args()
    dataset: DatasetFolder = given.dataset
    if given.fringes == "crossed":
        methods = {"local fit": load_method("crossed", dataset)}
    else:
        methods = {"local fit": load_method("phase", dataset, direction=given.fringes)}
    for count in sorted({1, given.members} - {0}) if given.members else ():
        methods[f"fringe-net, {count}"] = load_method(
            "fringe-net", dataset, fringes=given.fringes, members=count
        )
    for weights in given.weights:
        methods[weights] = load_method(
            "fringe-net", dataset, fringes=given.fringes, weights=weights
        )
    names = dataset.samples(given.split)
    owners = {name: name.rpartition("_")[0] for name in names}
    of_object = [
        [name for name in names if owners[name] == owner]
        for owner in dict.fromkeys(owners.values())
    ]
    samples = [name for views in of_object for name in views[: given.views]]
    rows: dict[str, list[list[float]]] = {}
    for sample in samples:
        exact = dataset.depth_mm(sample, DEPTH_EXACT)
        inside, void = object_mask(exact), dataset.void(sample, DEPTH_EXACT)
        near = object_near_edges(exact, [EDGE_BAND_PX])[0]
        truth, found = phases(dataset, sample, given.fringes, methods, inside, exact)
        for name, phase in found.items():
            error = np.abs(wrapped(phase - truth)).mean(axis=0)
            edge, inner = error[inside & ~void & near], error[inside & ~void & ~near]
            both = np.concatenate([edge, inner])
            means = [
                inner.mean(),
                edge.mean() if edge.size else np.nan,
                np.median(both),
                100 * (both > FAR_RAD).mean(),
            ]
            rows.setdefault(name, []).append([float(value) for value in means])
    titles = "Interior, rad", "Edge, rad", "Median, rad", f"Beyond {FAR_RAD} rad, %"
    means = {name: np.nanmean(each, axis=0) for name, each in rows.items()}
    cells = [
        {
            "Phase": name,
            **{title: f"{value:.3f}" for title, value in zip(titles, each, strict=True)},
        }
        for name, each in means.items()
    ]
    for line in Table.of(f"{dataset.path}, {given.split}, {len(samples)} views", cells).markdown():
        print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
