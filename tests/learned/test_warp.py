"""The warp that brings fringes of any rig to those that a network learned from."""

from dataclasses import replace

import numpy as np
import pytest

from fpp_ml_bench.baselines.learned.warp import KNOWN_PX, Warp, signs_of
from fpp_ml_bench.baselines.phase.geometry import Carriers, wrapped
from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.constants import TAU
from fpp_ml_bench.optics.named_rigs import crossed_rig
from fpp_ml_bench.optics.rig import Rig

LEARNED = crossed_rig(960)


def mirrored(rig: Rig) -> Rig:
    """The projector on the other side of the camera, above instead of below."""
    x, y, z = rig.translation_m
    return replace(rig, translation_m=(-x, -y, z))


OTHERS = {
    "smaller": crossed_rig(640),
    "larger": crossed_rig(1920),
    "other angles": crossed_rig(960).with_crossed(Crossed((14.0, 10.0), (100.0, 20.0))),
    "other signs": mirrored(crossed_rig(800)),
}


@pytest.mark.long
@pytest.mark.parametrize("name", OTHERS)
def test_both_carriers_come_to_those_that_were_learned(name: str) -> None:
    """Plane waves of the rig's carriers become plane waves of the learned ones, of the same sign,
    and phases measured there come back as those of the image."""
    rig = OTHERS[name]
    carriers, learned = (Carriers.of(one, one.crossed) for one in (rig, LEARNED))
    warp = Warp.of(carriers.step_rad, signs_of(carriers.gain))
    assert warp.needed
    signs = warp.signs[:, None]
    assert carriers.step_rad == pytest.approx(signs * warp.step_rad @ warp.matrix)

    def phases_at(x, y):
        return np.tensordot(carriers.step_rad, [x, y], 1) + np.array([[[0.3]], [[-1.1]]])

    y, x = np.mgrid[:90, :120]
    phases = phases_at(x, y)
    image = warp.image((100 + 40 * np.cos(phases).sum(axis=0)).astype(np.float32))
    own_y, own_x = np.mgrid[: image.shape[0], : image.shape[1]]
    right, down = warp.frame((90, 120))[1]
    place_x, place_y = np.tensordot(np.linalg.inv(warp.matrix), [own_x - right, own_y - down], 1)
    there = phases_at(place_x, place_y)
    seen = (abs(place_x - 59.5) < 47.5) & (abs(place_y - 44.5) < 32.5)
    assert np.abs(image - 100 - 40 * np.cos(there).sum(axis=0))[seen].max() < 4
    found = wrapped(signs[:, None] * there)
    back, sigma = warp.back(found.astype(np.float32), [np.full(image.shape, 0.1)], (90, 120))
    assert np.abs(wrapped(back - phases)).max() < 0.02 and sigma == pytest.approx(0.1)
    gains = [np.sign(np.median(one.gain, axis=(1, 2))) for one in (carriers, learned)]
    assert (gains[0] * warp.signs == gains[1]).all()


def test_the_known_rig_is_left_as_it_is() -> None:
    carriers = Carriers.of(LEARNED, LEARNED.crossed)
    assert not Warp.of(carriers.step_rad, signs_of(carriers.gain)).needed
    assert not Warp.of(np.array([[0.002, TAU / 18.1]]), np.ones(1)).needed


@pytest.mark.parametrize("sign", [1, -1])
def test_one_carrier_is_turned_and_scaled_to_grow_downwards(sign: int) -> None:
    step_rad = TAU / 9 * np.array([np.sin(0.4), np.cos(0.4)])
    warp = Warp.of(sign * step_rad[None], np.array([sign]))
    y, x = np.mgrid[:60, :80]
    phase = step_rad[0] * x + step_rad[1] * y
    place = np.tensordot(warp.matrix, np.stack([x, y]), axes=1)
    period_px = warp.period_px
    assert 0.7 * KNOWN_PX[1] < period_px < 1.6 * KNOWN_PX[1]
    assert np.abs(place[1] * TAU / period_px - phase).max() < 1e-9
    assert np.linalg.det(warp.matrix) == pytest.approx((period_px / 9) ** 2)  # not mirrored
    image = warp.image((100 + 50 * np.cos(phase)).astype(np.float32))
    down = TAU / period_px * np.arange(image.shape[0])[:, None] + np.zeros(image.shape)
    offset = warp.frame((60, 80))[1][1] * TAU / period_px
    (back,) = warp.back(wrapped(down - offset)[None].astype(np.float32), [], (60, 80))
    assert np.abs(wrapped(sign * back[0] - phase)).max() < 1e-3
