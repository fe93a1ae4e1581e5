"""Our decoding of multi-frequency phase shift beside that of the library fringes, on its own patterns with noise.

pip install "fpp-ml-bench[benchmarks]"
python benchmarks/codes_accuracy.py
"""

import argparse
import logging
import sys
from time import perf_counter

import numpy as np

from fpp_ml_bench.coding import Fringes as Period
from fpp_ml_bench.coding import Limits, PhaseShift, equal_shifts

LENGTH, ROWS = 912, 400
SCHEMES = {
    "unit cue, 16 periods": ((16.0, 1.0), (4, 4)),
    "hierarchy 1, 5, 30": ((30.0, 5.0, 1.0), (4, 4, 4)),
    "heterodyne 19, 20, 21": ((21.0, 20.0, 19.0), (4, 4, 4)),
    "number-theoretical 13, 29": ((29.0, 13.0), (6, 6)),
}


def main() -> int:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    try:
        from fringes import Fringes
    except ImportError:
        print("fringes is not installed: pip install 'fpp-ml-bench[benchmarks]'", file=sys.stderr)
        return 2
    logging.getLogger("fringes").setLevel(logging.ERROR)
    truth, random = np.arange(LENGTH, dtype=np.float64), np.random.default_rng(1)
    print("                            noise |      RMS error, px      |   wrong orders   |    ms")
    print("scheme                       grey |   ours fringes   theory |    ours  fringes | ours fringes")
    for name, (periods, steps) in SCHEMES.items():
        theirs = Fringes(X=LENGTH, Y=ROWS)
        theirs.D, theirs.K = 1, len(periods)
        theirs.v, theirs.N = [list(periods)], [list(steps)]
        patterns = theirs.encode()[..., 0].astype(np.float64)
        fringes = tuple(Period(LENGTH / v, equal_shifts(n, -1)) for v, n in zip(periods, steps, strict=True))
        offsets = [_offset(patterns[sum(steps[:i]) : sum(steps[: i + 1]), 0], periods[i]) for i in range(len(periods))]
        code = PhaseShift(
            tuple(
                Period(period.pitch_px, tuple(shift + 360 * turns for shift in period.shifts_deg))
                for period, turns in zip(fringes, offsets, strict=True)
            )
        )
        for sigma in (1.0, 4.0):
            captured = np.clip(patterns * 0.6 + 30 + random.normal(0, sigma, patterns.shape), 0, 255).astype(np.float32)
            started = perf_counter()
            found = code.decode(captured.reshape(len(captured), -1), LENGTH, Limits())
            ours_ms = 1e3 * (perf_counter() - started)
            ours = found.coordinate_px.reshape(ROWS, LENGTH) - truth
            eight_bit = np.rint(captured).astype(np.uint8)[..., None]
            started = perf_counter()
            decoded = theirs.decode(eight_bit, threads=1).x[0, ..., 0].astype(np.float64)
            theirs_ms = 1e3 * (perf_counter() - started)
            errors = [ours, decoded - np.median(decoded - truth) - truth]
            limit = LENGTH / max(periods) / 2
            right = [np.abs(error) < limit for error in errors]
            rms = [float(np.sqrt((error[good] ** 2).mean())) for error, good in zip(errors, right, strict=True)]
            wrong = [100 * float(1 - good.mean()) for good in right]
            theory = float(code.sigma_px(0.6 * 127.5, sigma))
            errors_px = f"{rms[0]:6.4f} {rms[1]:7.4f} {theory:8.4f}"
            print(
                f"{name:<27} {sigma:5.0f} | {errors_px} | {wrong[0]:6.3f}% {wrong[1]:7.3f}% | {ours_ms:4.0f} "
                f"{theirs_ms:7.0f}"
            )
    return 0


def _offset(frames: np.ndarray, periods: float) -> float:
    """Phase of a period at pixel 0, in turns, by the Fourier transform of its frames at all pixels."""
    steps = np.arange(len(frames)) / len(frames)
    phase = np.angle((frames * np.exp(2j * np.pi * steps)[:, None]).sum(axis=0)) / (2 * np.pi)
    turns = phase - np.arange(frames.shape[1]) * periods / LENGTH
    return float(np.angle(np.exp(2j * np.pi * turns).mean()) / (2 * np.pi))


if __name__ == "__main__":
    raise SystemExit(main())
