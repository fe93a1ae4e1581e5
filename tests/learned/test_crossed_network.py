"""crossed-net: views in drawn lights, samples with truth, windows in all orientations, a small
training, its method."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from fpp_ml_bench.baselines.learned import training
from fpp_ml_bench.baselines.learned.inputs import CROSSED_CHANNELS, CrossedScene, crossed_channels
from fpp_ml_bench.baselines.learned.method import CrossedNetMethod
from fpp_ml_bench.baselines.learned.network import load_net
from fpp_ml_bench.baselines.learned.odds import Answers, decided_mask, threshold_at
from fpp_ml_bench.baselines.learned.recipes import CrossedRecipe, CrossedVariation, crossed_sample
from fpp_ml_bench.baselines.learned.routes import CrossedNetPart, stated_rad
from fpp_ml_bench.baselines.learned.scenes import Group, View, read_views, render_views, with_unions
from fpp_ml_bench.baselines.learned.training import train_net
from fpp_ml_bench.baselines.learned.windows import IGNORED, Sample, symmetric
from fpp_ml_bench.baselines.phase.observe import TwoCarriers
from fpp_ml_bench.baselines.phase.route import CrossedRoute, two_carriers
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.cli import main
from fpp_ml_bench.errors import PredictionError, TrainingError, WeightsError
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.optics.named_rigs import crossed_rig, paper_rig

SIZE = 240
GROUPS = [
    Group("paper", named_light("paper"), (("wood_block", "A0"), ("duct_tape", "A60"))),
    Group("validation-paper", named_light("paper"), (("mug", "A0"),), "validation"),
]
STILL = CrossedVariation(near_edge=0.5, wrong_window=0, wrong_patch=0, no_plane=0)


@cache
def route() -> CrossedRoute:
    return two_carriers(TwoCarriers(crossed_rig(SIZE, "crossed-18")))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("views")
    render_views(GROUPS, crossed_rig(SIZE, "crossed-18"), (0,), out, workers=1)
    return out


@pytest.fixture(scope="module")
def samples(folder: Path) -> list[Sample]:
    learned = with_unions(read_views(folder, GROUPS, "train"), unions=1, seed=1)
    return [crossed_sample(view, route()) for view in learned]


def test_the_truth_of_a_sample_is_the_exact_depth(samples: list[Sample], folder: Path) -> None:
    sample, view = samples[0], next(read_views(folder, GROUPS, "train"))
    part = route().model.carriers.at(sample.scene.crop)
    truth = sample.scene.nearness + sample.missing.astype(np.float32) / part.joint_gain
    exact = view.depth_mm[sample.scene.crop]
    near = sample.target & (np.abs(sample.missing) < 2)  # half precision: 1e-3 of 2 rad
    assert near.sum() > 500
    assert np.abs(part.depth_mm(truth) - exact)[near].max() < 0.1


def test_a_union_shows_the_nearer_object(samples: list[Sample]) -> None:
    names = [sample.name for sample in samples]
    assert names[:2] == ["wood_block_A0", "duct_tape_A60"] and all(
        "+" in name for name in names[2:]
    )
    # All that both objects show, but for what the nearer hides and pixels that mix them.
    assert samples[2].target.sum() > 0.95 * max(sample.target.sum() for sample in samples[:2])


@pytest.mark.parametrize("turn", range(8))
def test_windows_mean_the_same_in_every_orientation(samples: list[Sample], turn: int) -> None:
    # Turning the picture and measuring is turning what was measured: sides and slopes point to the
    # turned places.
    scene = samples[0].scene.single()
    size = min(scene.light.shape)
    scene = scene.window(slice(0, size), slice(0, size))
    x, _ = crossed_channels(scene, route().model.carriers)
    psi = scene.nearness * route().model.carriers.at(scene.crop).joint_gain
    window = symmetric({"x": x, "psi": psi}, CROSSED_CHANNELS, turn)
    psi, turned = window["psi"], window["x"]
    inside = turned[CROSSED_CHANNELS.index("measured mask")] > 0
    along = np.gradient(psi, axis=0)[inside], np.gradient(psi, axis=1)[inside]
    for way, slope in zip(("down", "right"), along, strict=True):
        channel = CROSSED_CHANNELS.index(f"slope {way}")
        assert np.corrcoef(turned[channel][inside], np.clip(slope, -0.3, 0.3))[0, 1] > 0.4
    for bit in (4, 2, 1):
        window = symmetric(window, CROSSED_CHANNELS, turn & bit)
    assert np.array_equal(window["x"], x)


def test_labels_say_which_candidate_and_how_far(samples: list[Sample]) -> None:
    rng = np.random.default_rng(5)
    for vary in (STILL, replace(STILL, wrong_window=1.0)):
        seen, task = [], CrossedRecipe(window=64, vary=vary).task(crossed_rig(SIZE, "crossed-18"))
        for _ in range(12):
            window = task.draw(samples, rng)
            assert np.isfinite(window["x"]).all() and window["x"].shape == (
                len(CROSSED_CHANNELS),
                64,
                64,
            )
            labelled = window["order"] != IGNORED
            assert np.array_equal(labelled, window["fitted"])
            assert (np.abs(window["correction_rad"][labelled]) < 2.3).all()
            assert np.take_along_axis(
                window["exists"], np.where(labelled, window["order"], 1)[None], 0
            )[0][labelled].all()
            assert not (window["target"] & ~window["mask_valid"]).any()
            seen += [window["order"][labelled]]
        base = (np.concatenate(seen) == 1).mean()
        assert base > 0.9 if vary is STILL else base < 0.9


def test_a_training_in_small_is_resumed_and_predicts(
    tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "groups_of", lambda *args: GROUPS)
    recipe = CrossedRecipe(
        steps=2,
        validate_every=1,
        batch=1,
        window=64,
        widths=(4, 4),
        order_widths=(4, 4),
        fine=4,
        squeezed=4,
    )
    out, rig = tmp_path / "run", crossed_rig(SIZE, "crossed-18")
    first = train_net(recipe, out, rig=rig, minutes=1e-9)
    assert first.weights is None and first.steps == 1
    trained = train_net(recipe, out, rig=rig)
    assert trained.weights is not None and 0 <= trained.validation["missed_percent"] <= 100
    assert train_net(recipe, out, rig=rig) == trained
    with pytest.raises(TrainingError, match="another training"):
        train_net(replace(recipe, steps=3), out, rig=rig)
    method = load_method("crossed-net", rig, weights=trained.weights)
    assert isinstance(method, CrossedNetMethod) and method.frames_used == (0,)
    view = next(read_views(folder, GROUPS, "train"))
    frames = [None] * len(rig.sequence)
    frames[0] = view.frames[0]
    answer = method.answer(frames)
    assert answer.depth.dtype == np.float32 and np.isfinite(answer.depth).all()
    assert np.array_equal(answer.sigma_mm > 0, answer.depth > 0)
    assert load_net(trained.weights).network.options["channels"] == len(CROSSED_CHANNELS)


def test_depths_lie_on_measured_candidates_whatever_the_network_says(folder: Path) -> None:
    recipe = CrossedRecipe(widths=(4, 4), order_widths=(4, 4), fine=4, squeezed=4)
    learned = CrossedNetPart(
        route().model.carriers, recipe.network().eval(), threshold=0.0, lead=0.0
    )
    view = next(read_views(folder, GROUPS, "train"))
    fitted = route().choose(route().observe(view.frames[0], None))
    scene = CrossedScene.of(fitted)
    shape = scene.light.shape
    rng = np.random.default_rng(0)
    logits = np.where(scene.exists, rng.normal(size=(3, *shape)), -np.inf)
    logits[1] = np.maximum(logits[1], -50)
    correction = rng.uniform(-1.5, 1.5, shape)
    answers = Answers(logits, np.full(shape, 9.0), correction, np.full(shape, 0.1))
    measured = route().depth(learned.answered(fitted, scene, answers))
    part = fitted.seen.carriers
    known = scene.known & (measured.depth_mm[part.crop] > 0)
    psi = part.nearness(np.where(known, measured.depth_mm[part.crop], 1000.0)) * part.joint_gain
    offers = scene.nearness * part.joint_gain + np.stack(
        [scene.step_rad[0], np.zeros(shape), scene.step_rad[1]]
    )
    apart = np.abs(psi - correction - offers).min(axis=0)
    assert known.sum() > 500
    assert apart[known].max() < 1e-2


def test_the_least_that_the_network_states_is_taken_off() -> None:
    sigma = (np.sqrt(2) * np.exp(np.linspace(-6, 1, 50))).astype(np.float32)
    stated = stated_rad(sigma)
    assert (
        (np.diff(stated) > 0).all() and (stated < sigma).all() and (stated >= 0.359 * sigma).all()
    )
    assert stated[-1] == pytest.approx(0.8 * sigma[-1], rel=1e-3)


def test_what_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(PredictionError, match="not from crossed ones"):
        load_method("crossed-net", paper_rig(SIZE), weights=load_net())
    with pytest.raises(WeightsError, match="expected"):
        load_method("crossed-net", paper_rig(SIZE), weights=str(tmp_path / "none.safetensors"))
    assert main(["train", "crossed-net", str(tmp_path), "--out", str(tmp_path / "x")]) == 2
    assert "takes none" in capsys.readouterr().err
    assert main(["train", "crossed-net", "--albedo", "any", "--out", str(tmp_path / "x")]) == 2
    assert "--albedo is an option of phase-net, not of crossed-net" in capsys.readouterr().err
    assert main(["train", "loss/l1", "--out", str(tmp_path / "x")]) == 2
    assert "expected a dataset folder" in capsys.readouterr().err
    view = View(
        "x",
        "x",
        "x",
        np.zeros((1, SIZE, SIZE), np.uint8),
        np.zeros((SIZE, SIZE), np.float32),
        np.zeros((SIZE, SIZE), bool),
    )
    assert not crossed_sample(view, route()).target.any()
    with pytest.raises(TrainingError, match=r"delete it"):
        next(read_views(tmp_path, GROUPS, "train"))


def test_the_mask_asks_for_less_in_a_weak_frame(samples: list[Sample]) -> None:
    scene = samples[0].scene.single()
    assert scene.strength > 25  # the light paper
    limits = [threshold_at(strength, -0.5) for strength in (0.0, 5.0, 20.0, 40.0, 200.0)]
    assert limits == pytest.approx([-2.0, -2.0, -0.5, 1.0, 1.0])
    logit = np.full(scene.inside.shape, -1.0, np.float32)
    answers = Answers(np.zeros((3, *logit.shape), np.float32), logit, 0 * logit, 0 * logit)
    outside = ~scene.inside
    assert decided_mask(answers, replace(scene, strength=5.0), -0.5).all()
    assert not decided_mask(answers, replace(scene, strength=50.0), -0.5)[outside].any()
    assert np.array_equal(
        decided_mask(answers, scene, -0.5), scene.inside
    )  # what was measured stays
