"""fringe-net: the truth of its samples, its phases in the image's orientation, an ensemble's
uncertainty, a small training, and what a perfect network would measure."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from fpp_ml_bench.baselines.learned import training
from fpp_ml_bench.baselines.learned.fringe_net import CrossedPhases, FringePhase, phases_of
from fpp_ml_bench.baselines.learned.fringe_recipe import FringeRecipe, FringeTask
from fpp_ml_bench.baselines.learned.inputs import Geometry
from fpp_ml_bench.baselines.learned.method import FringeNetMethod
from fpp_ml_bench.baselines.learned.network import FringeNet
from fpp_ml_bench.baselines.learned.scenes import Group, View, read_views, render_views, with_unions
from fpp_ml_bench.baselines.learned.training import train_net
from fpp_ml_bench.baselines.phase.geometry import TAU, Carriers, wrapped
from fpp_ml_bench.baselines.phase.observe import OneCarrier, TwoCarriers
from fpp_ml_bench.baselines.phase.route import one_carrier, two_carriers
from fpp_ml_bench.baselines.phase.settings import Settings
from fpp_ml_bench.errors import NetworkError, PredictionError, RecipeError
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.optics.named_rigs import crossed_rig, paper_rig
from fpp_ml_bench.optics.sequence import DIRECTIONS

LINES, CROSSED = paper_rig(320), crossed_rig(320, "crossed-18")
GROUPS = [
    Group("drawn-000", named_light("paper"), (("wood_block", "A0"), ("duct_tape", "A60"))),
    Group("validation-paper", named_light("paper"), (("mug", "A0"),), "validation"),
]
SMALL = FringeRecipe(
    steps=40,
    batch=2,
    window=64,
    warm_up=1,
    widths=(8, 12),
    fine=8,
    validate_every=20,
    averaged=0.9,
    unions=0,
)
RIGS = {"lines": LINES, "crossed": CROSSED}


@pytest.fixture(scope="module", params=RIGS)
def task(request: pytest.FixtureRequest) -> FringeTask:
    return replace(SMALL, fringes=request.param).task(RIGS[request.param])


@pytest.fixture(scope="module")
def views(task: FringeTask, tmp_path_factory: pytest.TempPathFactory) -> list[View]:
    folder = tmp_path_factory.mktemp("views")
    render_views(GROUPS, RIGS[task.recipe.fringes], task.frames, folder, 1, False, task.decoded)
    return list(read_views(folder, GROUPS, "train"))


def true_phases(rig, fringes: str, depth_mm: np.ndarray) -> np.ndarray:
    """From the exact depth, (K, H, W)."""
    depth = np.where(depth_mm > 0, depth_mm, 1000.0)
    if fringes == "crossed":
        carriers = Carriers.of(rig, rig.crossed)
        return carriers.phases(carriers.nearness(depth))
    return OneCarrier(rig, Settings(direction=fringes)).layer.absolute_phase(depth)[None]


def test_the_truth_of_a_sample_is_the_phase_of_the_exact_depth(
    task: FringeTask, views: list[View]
) -> None:
    samples = task.samples(views)
    lines = task.recipe.fringes == "lines"
    assert [sample.direction for sample in samples] == list(
        DIRECTIONS if lines else DIRECTIONS[:1]
    ) * len(views)
    for sample, view in zip(samples, np.repeat(views, 2 if lines else 1), strict=True):
        fringes = sample.direction if lines else "crossed"
        truth = true_phases(RIGS[task.recipe.fringes], fringes, view.depth_mm)[
            :, *sample.scene.crop
        ]
        count = len(truth)
        numerator, denominator = (
            sample.missing[:count].astype(np.float64),
            sample.missing[count:].astype(np.float64),
        )
        error = np.abs(wrapped(np.arctan2(numerator, denominator) - truth))[:, sample.target]
        assert (
            sample.target.sum() > 1000
            and np.median(error) < 0.02
            and np.quantile(error, 0.95) < 0.2
        )
        amplitude = np.hypot(numerator, denominator)[:, sample.target]
        assert 0.4 < np.median(amplitude) < 1.3  # in that of a sinusoid of the surroundings' spread
        assert not sample.missing[:, ~sample.target].any()


def test_windows_show_the_phase_that_is_asked_for(task: FringeTask, views: list[View]) -> None:
    """The light of a window follows the cosine of the phase that is its truth; one carrier grows
    downwards."""
    samples, random = task.samples(views), np.random.default_rng(0)
    for sample in samples:
        window = task.draw([sample], random)
        fitted = window["fitted"]
        count = len(window["truth"]) // 2
        assert window["x"].shape == (2, 64, 64) and fitted.sum() > 50
        expected = window["truth"][count:].sum(axis=0)[fitted]
        assert np.corrcoef(window["x"][1][fitted], expected)[0, 1] > 0.9
        if count == 1:
            phase = np.arctan2(window["truth"][0], window["truth"][1])
            assert np.median(wrapped(np.diff(phase, axis=0))[fitted[1:] & fitted[:-1]]) > 0.3
    assert len(task.samples(with_unions(views, 1, 0))) == len(samples) + len(views)


class Perfect:
    """Stands in for a network: the truth, in the orientation that it is asked in."""

    def __init__(self, phases: np.ndarray, scale: float = 0.01, off: float = 0.0) -> None:
        self.phases, self.scale, self.off = phases, scale, off

    def outputs(self, x: np.ndarray) -> list[np.ndarray]:
        assert x.shape[1:] == self.phases.shape[1:]
        phases = self.phases + self.off
        scales = np.full(phases.shape, np.log(self.scale))
        return [np.concatenate([np.sin(phases), np.cos(phases), scales]).astype(np.float32)]


@pytest.mark.parametrize("fringes", ["horizontal", "vertical", "crossed"])
def test_perfect_phases_give_perfect_depth(fringes: str, tmp_path: Path) -> None:
    """Where the order is right, the depth of the true phase is the true depth."""
    rig = CROSSED if fringes == "crossed" else LINES
    frame = (
        rig.sequence.crossed_frames[0]
        if fringes == "crossed"
        else rig.sequence.sinusoids(fringes)[0]
    )
    render_views(GROUPS[1:], rig, (frame,), tmp_path, 1)
    view = next(read_views(tmp_path, GROUPS, "validation"))
    truth = true_phases(rig, fringes, view.depth_mm)
    model = (
        TwoCarriers(rig) if fringes == "crossed" else OneCarrier(rig, Settings(direction=fringes))
    )
    seen = model.observe(view.frames[0])
    crop = seen.crop
    cut = truth[:, *crop]
    if fringes == "crossed":
        part = CrossedPhases.of(model.carriers, model.carriers, [Perfect(cut)])
        route, measured = (
            two_carriers(model, phases=part.before, learned=part.after),
            two_carriers(model),
        )
    else:
        rotation = Geometry(model).rotation
        perfect = Perfect(rotation.turn(cut) * rotation.sign)
        part = FringePhase.of(Geometry(model), [perfect], model.period_px)
        route, measured = one_carrier(model, learned=part), one_carrier(model)
    found = part.phases(seen)
    assert np.abs(wrapped(found.phase_rad - truth[:, *crop])).max() < 1e-3
    assert found.sigma_rad == pytest.approx(0.01 * np.sqrt(2), rel=1e-4)
    answer, before = route.measure(view.frames[0]), measured.measure(view.frames[0])
    both = (answer.depth_mm > 0) & (before.depth_mm > 0) & view.target
    errors = [np.abs(one.depth_mm - view.depth_mm)[both] for one in (answer, before)]
    assert both.sum() > 0.9 * view.target.sum()
    assert np.median(errors[0]) < 0.05 < np.median(errors[1])
    assert np.quantile(answer.sigma_mm[both], 0.5) < np.quantile(before.sigma_mm[both], 0.5)
    if fringes != "crossed":  # the order is that of the local fit
        absolute = [one.wrapped_phase_rad + TAU * one.order for one in (answer, before)]
        assert np.nanmax(np.abs(absolute[0] - absolute[1])) < np.pi + 1e-3


def test_an_ensemble_states_how_far_its_members_are_apart() -> None:
    x, phases = np.zeros((2, 8, 8), np.float32), np.linspace(-3, 3, 64).reshape(1, 8, 8)
    alone, _ = phases_of([Perfect(phases, 0.02)], x)  # type: ignore[list-item]
    assert alone.sigma_rad == pytest.approx(0.02 * np.sqrt(2), rel=1e-4)
    members = [Perfect(phases, 0.02, off) for off in (-0.3, 0.0, 0.3)]
    three, _ = phases_of(members, x)  # type: ignore[arg-type]
    assert np.abs(wrapped(three.phase_rad - phases)).max() < 1e-5
    assert three.sigma_rad == pytest.approx(np.hypot(0.02 * np.sqrt(2), 0.3), rel=1e-3)


def test_a_training_in_small_is_resumed_and_predicts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "groups_of", lambda *args: GROUPS)
    out = tmp_path / "run"
    first = train_net(SMALL, out, rig=LINES, minutes=1e-9)
    assert first.weights is None and first.steps == 20
    trained = train_net(SMALL, out, rig=LINES)
    assert trained.weights == out / "fringe-net-lines-42.safetensors"
    log = [
        float(line.split('"loss_phase": ')[1].split(",")[0])
        for line in (out / "log.jsonl").read_text().splitlines()
    ]
    assert log[1] < 0.7 * log[0]
    assert 0 < trained.validation["interior_rad"] < 1.5
    view = next(read_views(out / "views", GROUPS, "validation"))
    frames: list[np.ndarray | None] = [None] * len(LINES.sequence)
    for number, direction in enumerate(DIRECTIONS):
        frames[LINES.sequence.sinusoids(direction)[0]] = view.frames[number].astype(np.uint8)
        method = FringeNetMethod.for_rig(LINES, fringes=direction, weights=trained.weights)
        answer = method.answer(frames)
        assert answer.sigma_mm is not None and np.array_equal(answer.sigma_mm > 0, answer.depth > 0)
        assert (
            method.settings["fringes"] == direction
            and f"one {direction} frame by one network" in method.title
        )
        submission = SimpleNamespace(settings=method.settings, name=method.title)
        assert FringeNetMethod.short_name(submission) == f"fringe-net, 1 {direction}"  # type: ignore[arg-type]
    with pytest.raises(
        PredictionError, match="learned from horizontal, vertical fringes only, not from crossed"
    ):
        FringeNetMethod.for_rig(CROSSED, weights=trained.weights)
    with pytest.raises(PredictionError, match="projects no crossed frame"):
        FringeNetMethod.for_rig(LINES, fringes="crossed", weights=trained.weights)
    with pytest.raises(PredictionError, match="expected 1 to 3"):
        FringeNetMethod.for_rig(LINES, members=4)


def test_crossed_fringes_that_were_not_learned_are_warped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "groups_of", lambda *args: GROUPS)
    recipe = replace(SMALL, fringes="crossed", steps=1, validate_every=1)
    trained = train_net(recipe, tmp_path / "run", rig=CROSSED)
    assert trained.weights is not None
    method = FringeNetMethod.for_rig(CROSSED, weights=trained.weights)
    assert (
        method.frames_used == CROSSED.sequence.crossed_frames[:1]
        and method.settings["fringes"] == "crossed"
    )
    other = crossed_rig(480, "crossed-12")
    warped = FringeNetMethod.for_rig(other, weights=trained.weights)
    image = np.random.default_rng(0).integers(0, 256, (480, 480)).astype(np.uint8)
    frames = [image if number == 0 else None for number in range(len(other.sequence))]
    assert warped.answer(frames).depth.shape == (480, 480)


def test_networks_and_recipes_that_are_refused() -> None:
    network = FringeNet(2, (8, 12), 8)
    assert network(torch.zeros(1, 2, 8, 12))[0].shape == (1, 6, 8, 12)
    assert FringeNet(**network.options).options == network.options
    assert sum(parameter.numel() for parameter in FringeRecipe().network().parameters()) < 1_000_000
    with pytest.raises(NetworkError, match="1 to 3 carriers"):
        FringeNet(4)
    with pytest.raises(NetworkError, match="multiples of 4"):
        network(torch.zeros(1, 2, 6, 8))
    with pytest.raises(RecipeError, match="lines or crossed"):
        FringeRecipe(fringes="diagonal")  # type: ignore[arg-type]
    with pytest.raises(RecipeError, match="this one has none"):
        replace(SMALL, fringes="crossed").task(LINES)
