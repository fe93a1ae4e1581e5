"""What fringe-net makes of its networks' answers: perfect ones give perfect depth on any rig, an
ensemble's uncertainty, the object that they call."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fpp_ml_bench.baselines.learned.fringe_net import Fringes, LinePart, PairPart, phases_of
from fpp_ml_bench.baselines.learned.method import FringeNetMethod
from fpp_ml_bench.baselines.learned.scenes import photographed
from fpp_ml_bench.baselines.learned.warp import PLACES, Warp, signs_of
from fpp_ml_bench.baselines.phase.geometry import Carriers, wrapped
from fpp_ml_bench.baselines.phase.observe import OneCarrier, TwoCarriers
from fpp_ml_bench.baselines.phase.route import one_carrier, two_carriers
from fpp_ml_bench.baselines.phase.settings import Settings
from fpp_ml_bench.coding.crossed import Crossed
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.view import Studio
from fpp_ml_bench.loaders.sample import VOID
from fpp_ml_bench.optics.named_rigs import crossed_rig, paper_rig
from fpp_ml_bench.optics.rig import Rig

OTHER = crossed_rig(400).with_crossed(Crossed((26.0, 20.0), (100.0, 20.0)))
RIGS = {
    "crossed": crossed_rig(320).with_crossed(Crossed((36.0, 36.0), (140.0, 50.0))),
    "crossed, other": replace(OTHER, translation_m=(-0.125, 0.1, 0.0)),
    "horizontal": paper_rig(320),
    "vertical": paper_rig(320),
}


class Perfect:
    """Stands in for a network: the true phases and object, in the image that it is asked in."""

    def __init__(
        self, phases: np.ndarray, inside: np.ndarray, scale: float = 0.01, off: float = 0.0
    ) -> None:
        self.phases, self.inside, self.scale, self.off = phases, inside, scale, off

    def outputs(self, x: np.ndarray) -> np.ndarray:
        assert x.shape[1:] == self.inside.shape
        answer = np.zeros((10, *self.inside.shape), np.float32)
        for place, phase in zip(PLACES[len(self.phases)], self.phases + self.off, strict=True):
            answer[place], answer[3 + place] = np.sin(phase), np.cos(phase)
            answer[6 + place] = np.log(self.scale)
        answer[9] = np.where(self.inside, 5.0, -5.0)
        return answer


def _true_phases(rig: Rig, fringes: str, depth_mm: np.ndarray) -> np.ndarray:
    """From the exact depth, (K, H, W)."""
    depth = np.where(depth_mm > 0, depth_mm, 1800.0)
    if fringes == "crossed":
        carriers = Carriers.of(rig, rig.crossed)
        return carriers.phases(carriers.nearness(depth))
    return OneCarrier(rig, Settings(direction=fringes)).layer.absolute_phase(depth)[None]


def _warped(warp: Warp, phases: np.ndarray, inside: np.ndarray) -> Perfect:
    """What a perfect network would answer in the image that ``warp`` gives it."""
    if not warp.needed:
        return Perfect(phases, inside)
    size, move = warp.frame(inside.shape)
    affine = np.column_stack([warp.matrix, move])

    def taken(image: np.ndarray) -> np.ndarray:
        return cv2.warpAffine(
            image.astype(np.float32), affine, size, borderMode=cv2.BORDER_REPLICATE
        )

    y, x = np.indices(inside.shape)
    own_y, own_x = np.indices(size[::-1])
    answers = []
    for phase, step, sign in zip(phases, warp.step_rad, warp.signs, strict=True):
        carrier = np.tensordot(step, np.tensordot(warp.matrix, [x, y], 1) + move[:, None, None], 1)
        beside = sign * phase - carrier
        angle = np.arctan2(taken(np.sin(beside)), taken(np.cos(beside)))
        answers.append(angle + step[0] * own_x + step[1] * own_y)
    return Perfect(np.stack(answers), taken(inside) > 0.5)


@pytest.mark.long
@pytest.mark.parametrize("name", RIGS)
def test_perfect_phases_give_perfect_depth(name: str) -> None:
    """Where the order is right, the depth of the true phase is the true depth; the object is what
    the networks call one."""
    rig, fringes = RIGS[name], name.split(",")[0]
    frame = (
        rig.sequence.crossed_frames[0]
        if fringes == "crossed"
        else rig.sequence.sinusoids(fringes)[0]
    )
    images, depth_mm, flags = photographed(
        Studio(BuildSettings(rig, ("mug",))), "mug", "A0", (frame,)
    )
    target = (depth_mm > 0) & ((flags & VOID) == 0)
    truth = _true_phases(rig, fringes, depth_mm)
    if fringes == "crossed":
        model = TwoCarriers(rig)
        carriers = model.carriers
        step_rad, signs = carriers.step_rad, signs_of(carriers.gain)
    else:
        model = OneCarrier(rig, Settings(direction=fringes))
        phase = model.layer.absolute_phase(1800.0)
        step_rad = np.array([[np.diff(phase, axis=axis).mean() for axis in (1, 0)]])
        signs = np.array([np.sign(np.median(model.layer.gain))])
    seen = model.observe(images[0])
    inside = depth_mm > 0
    warp = Warp.of(step_rad, signs)
    network = _warped(warp, truth[:, *seen.crop], inside[seen.crop])
    both = Fringes([network], warp)  # type: ignore[list-item]
    assert both.warp.needed == (name != "crossed")
    if fringes == "crossed":
        route = two_carriers(model, PairPart(both).before, PairPart.after)
        measured = two_carriers(model)
    else:
        route = one_carrier(model, LinePart(both, model).before, LinePart.after)
        measured = one_carrier(model)
    answer, before = route.measure(images[0]), measured.measure(images[0])
    shared = (answer.depth_mm > 0) & (before.depth_mm > 0) & target
    errors = [np.abs(one.depth_mm - depth_mm)[shared] for one in (answer, before)]
    assert shared.sum() > 0.9 * target.sum()
    assert np.median(errors[0]) < 0.3 * np.median(errors[1])
    assert np.quantile(answer.sigma_mm[shared], 0.5) < np.quantile(before.sigma_mm[shared], 0.5)
    assert (answer.depth_mm > 0)[~inside].mean() < 1e-3
    assert (answer.depth_mm > 0)[target].mean() > 0.95


def test_an_ensemble_states_how_far_its_members_are_apart() -> None:
    x, phases = np.zeros((4, 8, 8), np.float32), np.linspace(-3, 3, 64).reshape(1, 8, 8)
    inside = np.arange(64).reshape(8, 8) % 2 == 0
    alone, logit = phases_of([Perfect(phases, inside, 0.02)], x)  # type: ignore[list-item]
    assert alone.sigma_rad[0] == pytest.approx(0.02 * np.sqrt(2), rel=1e-4)
    assert np.array_equal(logit > 0, inside)
    members = [Perfect(phases, inside, 0.02, off) for off in (-0.3, 0.0, 0.3)]
    members[0].inside = ~inside
    three, logit = phases_of(members, x)  # type: ignore[arg-type]
    assert np.abs(wrapped(three.phase_rad[0] - phases[0])).max() < 1e-5
    assert three.sigma_rad[0] == pytest.approx(np.hypot(0.02 * np.sqrt(2), 0.3), rel=1e-3)
    assert np.array_equal(logit > 0, inside)  # two of three


def test_the_shipped_networks_answer_for_any_rig() -> None:
    image = np.random.default_rng(0).integers(0, 256, (300, 400)).astype(np.uint8)
    rig = replace(RIGS["crossed, other"], camera=replace(OTHER.camera, height=300, cy=150.0))
    frames = [image if number == 0 else None for number in range(len(rig.sequence))]
    method = FringeNetMethod.for_rig(rig)
    assert method.settings["fringes"] == "crossed" and method.frames_used == (0,)
    answer = method.answer(frames)
    assert answer.depth.shape == (300, 400) and np.isfinite(answer.depth).all()
    pair = FringeNetMethod.for_rig(paper_rig(224), fringes="crossed")
    assert pair.frames_used == (0, 18)  # whose mean is a crossed frame
    with pytest.raises(PredictionError, match="expected 1 to"):
        FringeNetMethod.for_rig(rig, members=9)


def test_even_odds_leave_out_what_may_be_wall() -> None:
    rig = RIGS["crossed"]
    frame = rig.sequence.crossed_frames[0]
    images, depth_mm, flags = photographed(
        Studio(BuildSettings(rig, ("mug",))), "mug", "A0", (frame,)
    )
    frames = [images[0] if number == frame else None for number in range(len(rig.sequence))]
    wide, even = (
        FringeNetMethod.for_rig(rig, members=1, even_odds=chosen) for chosen in (False, True)
    )
    answered, left = (method.answer(frames).depth > 0 for method in (wide, even))
    empty = (depth_mm == 0) & ((flags & VOID) == 0)
    assert not (left & ~answered).any() and left.sum() > 0.98 * answered.sum()
    assert (left & empty).sum() < 0.7 * (answered & empty).sum()
    assert "even_odds" not in wide.settings and even.settings["even_odds"]
    assert even.title == wide.title + ", even odds"
