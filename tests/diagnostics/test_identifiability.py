"""The bound of what one frame tells, against a search along the rays with the rig's own
projection."""

import numpy as np
import pytest

from fpp_ml_bench.baselines.diagnostics.identifiability import SAME_RAD, alike, shares
from fpp_ml_bench.cli import main
from fpp_ml_bench.errors import DiagnosisError
from fpp_ml_bench.loaders.render.track import track
from fpp_ml_bench.optics.named_rigs import crossed_rig, paper_rig
from fpp_ml_bench.optics.sequence import DIRECTIONS

SIZE = 96
TAU = 2 * np.pi


def _surface(rig, size: int, seed: int = 0) -> np.ndarray:
    """A smooth surface in the middle of the image and the range."""
    near, far = rig.working_range_mm
    rows, columns = np.mgrid[: rig.camera.height, : rig.camera.width].astype(np.float64)
    middle = near + (far - near) * np.random.default_rng(seed).uniform(0.3, 0.7)
    depth = middle + 0.1 * (far - near) * np.sin(3 * columns / rig.camera.width)
    depth += 0.05 * (far - near) * rows / rig.camera.height
    inside = (np.abs(rows / rig.camera.height - 0.5) < size / 200) & (
        np.abs(columns / rig.camera.width - 0.5) < size / 200
    )
    return np.where(inside, depth, 0).astype(np.float32)


def _along_ray(rig, row: int, column: int, count: int = 60001):
    """Depths in range on a pixel's ray, and the projector px that they are seen at."""
    near, far = rig.working_range_mm
    depth = np.linspace(near, far, count)
    x, y = (axis[row, column] for axis in rig.camera.rays())
    return depth, *rig.project(np.column_stack([x * depth, y * depth, depth]) / 1000)


PAIRS = [
    (rig, fringes)
    for rig in (paper_rig(SIZE), track()["rig-12-paper"].rig)
    for fringes in DIRECTIONS
]
PAIRS += [(crossed_rig(SIZE, "crossed-18"), "crossed"), (track()["rig-04-paper"].rig, "crossed")]
LIMITS_RAD = {f"phases to {rad:g} rad, {words}": rad for words, rad in SAME_RAD.items()}
LIMITS_RAD["phase"] = 0.1  # whole periods are 0 apart


@pytest.mark.parametrize(("rig", "fringes"), PAIRS)
def test_depths_of_the_same_phases_are_those_of_a_search(rig, fringes) -> None:
    depth_mm = _surface(rig, 16, seed=3)
    found = alike(rig, fringes, depth_mm)
    if fringes == "crossed":
        cycles, off_mm = rig.crossed.cycles_per_px, 1.0
    else:
        cycles, off_mm = [np.eye(2)[int(fringes == "horizontal")] / rig.pitch(fringes)], 0.3
    rows, columns = np.nonzero(depth_mm)
    for place in np.linspace(0, len(rows) - 1, 7).astype(int):
        row, column = rows[place], columns[place]
        depth, u, v = _along_ray(rig, row, column)
        phases = [TAU * (a * u + b * v) for a, b in cycles]
        beside = [phase - np.interp(depth_mm[row, column], depth, phase) for phase in phases]
        apart = np.linalg.norm([(phase + np.pi) % TAU - np.pi for phase in beside], axis=0)
        low = np.flatnonzero((apart[1:-1] < apart[:-2]) & (apart[1:-1] < apart[2:])) + 1
        inside = row - found.crop[0].start, column - found.crop[1].start
        for words in LIMITS_RAD.keys() & found.fits.keys():
            rad = LIMITS_RAD[words]
            if np.any(np.abs(apart[low] - rad) < 0.02):  # at the limit either may be right
                continue
            fits = found.fits[words][:, *inside]
            given, expected = found.depth_mm[:, *inside][fits], depth[low[apart[low] < rad]]
            assert np.allclose(np.sort(given), expected, atol=off_mm)


def test_brightness_parts_orders_of_a_matte_surface() -> None:
    rig = paper_rig(240)
    found = alike(rig, "horizontal", _surface(rig, 30))
    none, some, most = found.fits.values()
    assert (most <= some).all() and (some <= none).all() and most[0].sum() == none[0].sum()
    assert most.sum() <= some.sum() < none.sum()


def test_wrong_orders_are_lawful_or_avoidable() -> None:
    rig = paper_rig(240)
    depth_mm = _surface(rig, 30)
    found = alike(rig, "horizontal", depth_mm)
    fits = found.fits["phase"]
    other = np.where(fits[1:], found.depth_mm[1:], np.nan)
    nearest = np.nanmin(np.where(np.isnan(other), np.inf, other), axis=0)
    answer = np.zeros_like(depth_mm)
    answer[found.crop] = np.where(np.isfinite(nearest), nearest, 0)
    facts = shares(found, answer)
    twice = (fits.sum(axis=0) > 1)[fits[0]].mean()
    assert facts["wrong order"] == pytest.approx(twice)
    assert facts["avoidable, phase"] == 0
    assert facts["avoidable, phase and brightness to 3%"] > 0.5 * twice
    assert shares(found, depth_mm)["wrong order"] == 0
    assert "wrong order" not in shares(found, None)
    assert facts["one depth, phase"] == pytest.approx(1 - twice)
    with pytest.raises(DiagnosisError, match="object"):
        alike(rig, "horizontal", np.zeros_like(depth_mm))


def test_the_probe_reports_the_bound_and_the_errors(tiny, tmp_path, capsys) -> None:
    words = ["diagnose", "phase", str(tiny), "--probe", "identifiability", "--quick"]
    assert main([*words, "--out", str(tmp_path / "report")]) == 0
    assert "Object pixels with one depth" in " ".join(capsys.readouterr().out.split())
    assert (tmp_path / "report" / "identifiability.png").is_file()
