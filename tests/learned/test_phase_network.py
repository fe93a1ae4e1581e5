"""phase-net: what it can't do by construction, and what its weights give on planes, on objects and
on other rigs."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from flat_planes import FIRST, OTHER_RIG, RIG, USERS_WORD, photograph, plane_depth_m, plane_fringe

from fpp_ml_bench.baselines.learned.inputs import PHASE_CHANNELS, Geometry
from fpp_ml_bench.baselines.learned.method import PhaseNetMethod
from fpp_ml_bench.baselines.learned.network import PhaseNet, load_net
from fpp_ml_bench.baselines.learned.routes import PhaseNetPart
from fpp_ml_bench.baselines.phase.depth import Reason
from fpp_ml_bench.baselines.phase.geometry import TAU
from fpp_ml_bench.baselines.phase.observe import OneCarrier
from fpp_ml_bench.baselines.phase.route import FringeRoute, one_carrier
from fpp_ml_bench.baselines.phase.settings import Settings
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.errors import DecodeError, FppBenchError, NetworkError, PredictionError
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig import Rig


def part_of(rig: Rig, size: int) -> Rig:
    """The middle ``size`` px of the camera's image, at its full resolution."""
    camera = rig.camera
    left, top = (camera.width - size) / 2, (camera.height - size) / 2
    return replace(
        rig,
        camera=replace(camera, width=size, height=size, cx=camera.cx - left, cy=camera.cy - top),
    )


def with_network(
    rig: Rig, settings: Settings, network: PhaseNet, threshold: float = -1e9, lead: float = 0.0
) -> FringeRoute:
    model = OneCarrier(rig, settings)
    return one_carrier(model, learned=PhaseNetPart(Geometry(model), network, threshold, lead))


def wild(bound_rad: float) -> PhaseNet:
    """A network that says anything, loudly."""
    torch.manual_seed(3)
    network = PhaseNet((8, 8), 4, 6, (6, 8), bound_rad)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=1.0)
    return network.eval()


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
def test_random_weights_stay_on_the_candidates(direction: str) -> None:
    """Every depth is a candidate of the working range, moved by at most the bound, whatever the
    weights; where there is one candidate, its order is that one."""
    bound = 0.5
    settings = Settings(direction=direction)
    network_route = with_network(RIG, settings, wild(bound))
    image = photograph("cork", "A60").frames[FIRST[direction]]
    measurement = network_route.measure(image)
    observation = network_route.observe(image, None)
    base = network_route.choose(observation).order
    on_object = measurement.depth_mm[observation.crop] > 0
    assert on_object.sum() > 3000
    absolute = observation.layer.absolute_phase(
        np.where(on_object, measurement.depth_mm[observation.crop], 1000.0)
    )
    order = np.rint((absolute - observation.phase_rad) / TAU)
    correction = (absolute - observation.phase_rad - TAU * order)[on_object]
    assert np.abs(correction).max() < bound + 1e-3
    assert np.abs(correction).max() > 0.9 * bound  # it did try
    first, count = observation.candidates.first, observation.candidates.count
    allowed = (order >= first) & (order < first + count)
    allowed |= (order == base) & (count == 0)
    assert allowed[on_object].all()
    assert len(np.unique((order - base)[on_object])) > 1


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
def test_a_range_under_one_period_settles_the_order(direction: str) -> None:
    """Of a rig whose range is shorter than a period, the order is the measured candidate, whatever
    the network says."""
    short = replace(RIG, working_range_mm=(1685.0, 1915.0))
    assert short.periods_in_range(direction) < 1  # type: ignore[arg-type]
    image = photograph("cork", "A60").frames[FIRST[direction]]
    route = with_network(short, Settings(direction=direction), wild(0.5))  # type: ignore[arg-type]
    measurement, observation = route.measure(image), route.observe(image, None)
    crop, candidates = observation.crop, observation.candidates
    one = (candidates.count == 1) & (measurement.depth_mm[crop] > 0)
    absolute = observation.layer.absolute_phase(np.where(one, measurement.depth_mm[crop], 1000.0))
    order = np.rint((absolute - observation.phase_rad) / TAU)
    assert one.sum() > 300 and (order == candidates.first)[one].all()
    assert measurement.order_doubt_mm[crop][one].max() < 0.01
    assert "order by range" in PhaseNetMethod(short, direction=direction).title  # type: ignore[arg-type]
    assert PhaseNetMethod(short, direction=direction).settings["order_by_range"] is True  # type: ignore[arg-type]
    assert PhaseNetMethod(RIG, direction=direction).settings["order_by_range"] is False  # type: ignore[arg-type]


def test_any_albedo_says_what_it_cannot_tell() -> None:
    """Without brightness most orders are ambiguous, and a wrong one is not denied by the
    uncertainty."""
    row = photograph("cracker_box", "A60")
    measurement = PhaseNetMethod(RIG, albedo="any").route.measure(row.frames[0])
    given = (measurement.depth_mm > 0) & (row.depth_mm > 0)
    several = given & (measurement.candidates.count > 1)
    assert (measurement.reason[several] == Reason.AMBIGUOUS).mean() > 0.5
    error = np.abs(measurement.depth_mm - row.depth_mm)
    denied = given & (error > 150) & (measurement.sigma_mm < 0.25 * error)
    assert denied.sum() < 0.001 * given.sum()


def test_brighter_or_darker_frames_have_the_same_depth() -> None:
    """No absolute grey level enters the network: its input is relative to the frame's own light."""
    image = photograph("cork", "A60").frames[0]
    method = PhaseNetMethod(RIG)
    full = method.route.measure(image)
    # Light above the ambient grey level, halved; what is rounded to whole grey levels is noise of
    # half a level.
    background = method.route.observe(image, None).background
    half_grey = background.ambient_grey + (image - background.ambient_grey) / 2
    half = method.route.measure(np.rint(half_grey).astype(np.uint8))
    both = (full.depth_mm > 0) & (half.depth_mm > 0)
    assert both.sum() > 0.95 * (full.depth_mm > 0).sum()
    assert np.median(np.abs(full.depth_mm - half.depth_mm)[both]) < 1.0


def test_an_empty_scene_has_no_depth() -> None:
    empty = plane_fringe(RIG, 0, plane_depth_m(RIG, RIG.background_m))
    assert not with_network(RIG, Settings(), wild(0.5)).measure(empty).depth_mm.any()


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
@pytest.mark.parametrize("distance_m", [1.52, 1.8, 2.08])
def test_a_plane_that_fills_the_frame(distance_m: float, direction: str) -> None:
    """Where the UNet collapses to background; at the benchmark's resolution, without background in
    view, so the user says how bright the lamp is."""
    rig, file = part_of(paper_rig(960), 240), load_net()
    told = Settings(direction, **USERS_WORD)  # type: ignore[arg-type]
    image = plane_fringe(rig, FIRST[direction], plane_depth_m(rig, distance_m))
    measurement = with_network(
        rig, told, file.network, file.config.threshold, file.config.lead
    ).measure(image)
    assert (measurement.depth_mm > 0).mean() > 0.98
    assert np.abs(measurement.depth_mm - 1000 * distance_m)[measurement.depth_mm > 0].mean() < 2.0


@pytest.mark.parametrize(
    "translation_m", [RIG.translation_m, (0.0, 0.0, -0.1)], ids=["beside", "on the axis"]
)
def test_beyond_the_end_of_the_range_there_is_no_depth(
    translation_m: tuple[float, float, float],
) -> None:
    """Whatever the network's correction, at the range's end and where the projector is on the
    camera's axis."""
    rig = replace(part_of(paper_rig(960), 240), translation_m=translation_m)
    network_route = with_network(rig, Settings(**USERS_WORD), wild(0.5))  # type: ignore[arg-type]
    measurement = network_route.measure(
        plane_fringe(rig, 0, plane_depth_m(rig, 2.095, (0.06, 0.0)), (0.06, 0.0))
    )
    depth_mm, outside = measurement.depth_mm, measurement.reason == Reason.OUT_OF_RANGE
    assert outside.mean() > 0.05 and not depth_mm[outside].any()
    assert rig.in_range(depth_mm[depth_mm > 0]).all()


@pytest.mark.parametrize("name", ["phase", "phase-net"])
@pytest.mark.parametrize("image", ["black", "white", "constant", "noise", "checkerboard"])
def test_an_image_without_an_object_has_no_depth_outside_the_range(name: str, image: str) -> None:
    rig = paper_rig(480)
    shape = rig.camera.height, rig.camera.width
    levels = {
        "black": np.zeros(shape),
        "white": np.full(shape, 255),
        "constant": np.full(shape, 128),
        "noise": np.random.default_rng(1).uniform(0, 256, shape),
        "checkerboard": 255 * (np.indices(shape).sum(axis=0) % 2),
    }[image]
    method = load_method(name, rig)
    frames: list[np.ndarray | None] = [None] * len(rig.sequence)
    frames[method.frames_used[0]] = levels.astype(np.uint8)
    try:
        depth_mm = method.measure(frames).depth_mm  # type: ignore[attr-defined]
    except FppBenchError:
        return  # a refusal with a reason
    assert ((depth_mm == 0) | rig.in_range(depth_mm)).all()


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
def test_a_plane_in_unknown_light_is_ambiguous(direction: str) -> None:
    """The same without background in view and without the user's word: no order can be told from
    brightness."""
    rig = part_of(paper_rig(960), 240)
    measurement = PhaseNetMethod(rig, direction=direction).route.measure(  # type: ignore[arg-type]
        plane_fringe(rig, FIRST[direction], plane_depth_m(rig, 1.8))
    )
    several = (measurement.candidates.count > 1) & (measurement.modulation_grey > 5)
    assert several.mean() > 0.9 and not measurement.depth_mm[several].any()
    assert (measurement.reason[several] == Reason.AMBIGUOUS).all()


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
def test_short_periods_are_resampled_to_those_of_training(direction: str) -> None:
    rig = paper_rig(320)
    assert rig.image_px_per_period("horizontal") < 8
    for size, resampled in ((480, True), (720, False), (960, False), (1920, True)):
        assert PhaseNetMethod(paper_rig(size)).route.model.resampling.needed is resampled
    row = photograph("cracker_box", "A60", rig)
    measurement = PhaseNetMethod(rig, direction=direction).route.measure(
        row.frames[FIRST[direction]]
    )  # type: ignore[arg-type]
    target = row.depth_mm > 0
    error = np.abs(measurement.depth_mm - row.depth_mm)[target]
    assert np.median(error) < 2 and (error > 100).mean() < 0.02
    assert (measurement.depth_mm[~target] > 0).mean() < 0.02


@pytest.mark.parametrize("rig", [RIG, OTHER_RIG], ids=["paper", "other"])
def test_objects_at_unknown_distance_also_on_another_rig(rig: Rig) -> None:
    row = photograph("cracker_box", "A60", rig)
    measurement = PhaseNetMethod(rig).route.measure(row.frames[0])
    target = row.depth_mm > 0
    error = np.abs(measurement.depth_mm - row.depth_mm)[target]
    assert np.median(error) < 3
    assert (error > 100).mean() < 0.02
    assert (measurement.depth_mm[~target] > 0).mean() < 0.02
    assert sum(measurement.counts.values()) == target.size


def test_method_is_registered_and_reports_itself() -> None:
    phase_net = load_method("phase-net", RIG, direction="vertical")
    assert phase_net.frames_used == (18,) and phase_net.uses_ground_truth_range is False
    assert (
        "learned" in phase_net.title and phase_net.settings["weights_sha256"] == load_net().sha256
    )
    assert "one albedo" in phase_net.title and phase_net.settings["shading"] is True
    assert load_method("phase-net", RIG, albedo="any").settings["weights"] == "phase-net-any-albedo"
    assert 100_000 < phase_net.parameters < 1_000_000  # type: ignore[attr-defined]
    frames: list = [None] * 52
    frames[18] = photograph("cork", "A60").frames[18]
    depth_mm = phase_net.predict(frames)
    assert depth_mm.dtype == np.float32 and depth_mm.shape == (480, 480) and (depth_mm > 0).any()


def test_refusals_name_what_came() -> None:
    with pytest.raises(DecodeError, match="frame 0 is missing"):
        PhaseNetMethod(RIG).predict([None] * 52)
    with pytest.raises(PredictionError, match="both"):
        PhaseNetMethod(RIG, direction="both")  # type: ignore[arg-type]
    with pytest.raises(PredictionError, match="expected one or any"):
        PhaseNetMethod(RIG, albedo="both")
    with pytest.raises(PredictionError, match="learned one albedo"):
        PhaseNetMethod(RIG, weights=load_net(), albedo="any")
    with pytest.raises(NetworkError, match="multiples of 16"):
        PhaseNet().forward(torch.zeros(1, len(PHASE_CHANNELS), 40, 32))
    with pytest.raises(NetworkError, match="bound_rad"):
        PhaseNet(bound_rad=4.0)
    with pytest.raises(NetworkError, match="states its uncertainty"):
        PhaseNet(uncertain=False)
