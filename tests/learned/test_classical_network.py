"""classical-net: what the network can't do whatever its weights, samples with truth, a small
training, its method."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import maximum_filter, minimum_filter

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.learned import training
from fpp_ml_bench.baselines.learned.filter_recipe import (
    THRESHOLDS,
    FilterRecipe,
    chosen_threshold,
    depth_sample,
    filter_scores,
)
from fpp_ml_bench.baselines.learned.method import ClassicalNetMethod
from fpp_ml_bench.baselines.learned.network import BOUND_SIGMAS, REACH, DepthFilter
from fpp_ml_bench.baselines.learned.routes import (
    DEPTH_CHANNELS,
    DepthScene,
    Filtered,
    decided,
    depth_channels,
    filtered,
)
from fpp_ml_bench.baselines.learned.scenes import Group, View, read_views, render_views
from fpp_ml_bench.baselines.learned.training import train_net
from fpp_ml_bench.baselines.learned.windows import Sample
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.baselines.training.weights import SHIPPED
from fpp_ml_bench.errors import NetworkError, TrainingError, WeightsError
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.optics.named_rigs import paper_rig

SIZE = 224
GROUPS = [
    Group("paper", named_light("paper"), (("wood_block", "A0"), ("duct_tape", "A60"))),
    Group("validation-paper", named_light("paper"), (("mug", "A0"),), "validation"),
]
Views = list[View]


@cache
def method() -> ClassicalMethod:
    return ClassicalMethod(paper_rig(SIZE), direction="vertical", steps=3)


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Views:
    out = tmp_path_factory.mktemp("views")
    render_views(GROUPS, paper_rig(SIZE), method().frames_used, out, workers=1)
    return [*read_views(out, GROUPS, "train"), *read_views(out, GROUPS, "validation")]


@pytest.fixture(scope="module")
def samples(views: Views) -> list[Sample]:
    found = [depth_sample(view, method()) for view in views]
    assert all(found)
    return found  # type: ignore[return-value]


def frames_of(view: View) -> list:
    frames: list = [None] * len(method().rig.sequence)
    for index, frame in zip(method().frames_used, view.frames, strict=True):
        frames[index] = frame
    return frames


def wild(seed: int = 0) -> DepthFilter:
    """A network that was not trained, with weights far from their first values."""
    torch.manual_seed(seed)
    network = DepthFilter(len(DEPTH_CHANNELS), (4, 6)).eval()
    torch.nn.init.normal_(network.answer.weight, std=3.0)
    return network


@pytest.mark.parametrize("seed", range(3))
def test_no_depth_that_no_neighbour_has(samples: list[Sample], seed: int) -> None:
    scene = samples[0].scene
    holes = replace(
        scene, found=scene.found & (np.random.default_rng(seed).random(scene.found.shape) > 0.2)
    )
    scene = replace(
        holes, depth_mm=holes.depth_mm * holes.found, sigma_mm=holes.sigma_mm * holes.found
    )
    answer = filtered(wild(seed), scene)
    reach = 2 * REACH + 1
    least = minimum_filter(
        np.where(scene.found, scene.depth_mm, np.inf), reach, mode="constant", cval=np.inf
    )
    most = maximum_filter(
        np.where(scene.found, scene.depth_mm, -np.inf), reach, mode="constant", cval=-np.inf
    )
    np.testing.assert_array_equal(answer.near, np.isfinite(least))
    slack = 1e-3  # of float32 sums of some hundred mm
    assert ((answer.depth_mm >= least - slack) & (answer.depth_mm <= most + slack))[
        answer.near
    ].all()
    changed = np.abs(answer.depth_mm - scene.depth_mm)[scene.found]
    assert (
        changed <= BOUND_SIGMAS * scene.sigma_mm[scene.found] + slack
    ).all() and changed.max() > 0.1
    assert not (decided(answer, scene, -np.inf) & ~answer.near & ~scene.found).any()


def test_what_the_network_sees_has_no_distance_unit_or_direction(samples: list[Sample]) -> None:
    scene = samples[0].scene
    seen = depth_channels(scene)
    assert seen.shape == (len(DEPTH_CHANNELS), *scene.found.shape) and np.isfinite(seen).all()
    twice = replace(
        scene,
        depth_mm=2 * scene.depth_mm,
        sigma_mm=2 * scene.sigma_mm,
        modulation=scene.modulation / 4,
        unit_mm=2 * scene.unit_mm,
        bright=scene.bright / 4,
    )
    np.testing.assert_allclose(depth_channels(twice), seen, atol=2e-3)
    np.testing.assert_allclose(
        depth_channels(scene.with_maps(lambda name, maps: np.ascontiguousarray(np.rot90(maps)))),
        np.rot90(seen, axes=(-2, -1)),
        atol=2e-3,
    )


def test_a_sample_holds_the_exact_depth(views: Views, samples: list[Sample]) -> None:
    view, sample = views[0], samples[0]
    exact = sample.missing + sample.scene.middle_mm
    np.testing.assert_allclose(
        exact[sample.target], view.depth_mm[sample.scene.crop][sample.target], atol=2e-3
    )
    error = (sample.scene.depth_mm - sample.missing)[sample.target & sample.scene.found]
    assert 0.05 < np.median(np.abs(error)) < 2
    random, task = np.random.default_rng(1), FilterRecipe(window=96).task(paper_rig(SIZE))
    for _ in range(8):
        window = task.draw(samples, random)
        assert window["x"].shape == (len(DEPTH_CHANNELS), 96, 96) and window[
            "depth_mm"
        ].shape == window["valid"].shape == (96, 96)
        assert (window["x"][0] == window["found"]).all() and not (
            window["target"] & ~window["valid"]
        ).any()
    blank = replace(view, frames=np.zeros_like(view.frames))
    assert depth_sample(blank, method()) is None


def test_the_threshold_lets_no_view_lose(samples: list[Sample]) -> None:
    def filling(sample: Sample, logits: np.ndarray) -> Filtered:
        zeros = np.zeros_like(sample.missing)
        return Filtered(zeros, zeros, logits.astype(np.float32), np.ones_like(sample.target))

    right = [filling(one, np.where(one.target, 2.5, -2.5)) for one in samples]
    assert chosen_threshold(right, samples) == 0
    everywhere = filling(samples[0], np.full(samples[0].target.shape, 3.5))
    assert chosen_threshold([everywhere, *right[1:]], samples) == 4
    blind = filling(samples[0], np.full(samples[0].target.shape, 10.0))
    assert chosen_threshold([blind, *right[1:]], samples) == THRESHOLDS[-1]


def test_training_resumes_to_the_same_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "groups_of", lambda *args: GROUPS)
    recipe = FilterRecipe(steps=4, batch=2, window=64, widths=(4, 6), validate_every=2, lights=0)
    rig = paper_rig(SIZE)
    whole = train_net(recipe, tmp_path / "whole", rig=rig)
    stopped = train_net(recipe, tmp_path / "pieces", rig=rig, minutes=1e-9)
    assert stopped.weights is None and stopped.steps == 2
    pieces = train_net(recipe, tmp_path / "pieces", rig=rig)
    assert whole.weights is not None and pieces.weights is not None
    assert whole.weights.read_bytes() == pieces.weights.read_bytes()
    assert train_net(recipe, tmp_path / "whole", rig=rig) == whole  # as it was
    assert {"object_mae_mm", "input_mae_mm", "within_percent"} <= whole.validation.keys()
    with pytest.raises(TrainingError, match="another"):
        train_net(replace(recipe, seed=1), tmp_path / "whole", rig=rig)
    own = load_method("classical-net", rig, weights=str(whole.weights))
    assert own.frames_used == method().frames_used and own.learned_from["data"] == "generated"


def test_the_shipped_weights_take_noise_away_on_every_view(views: Views) -> None:
    filter_method = ClassicalNetMethod(paper_rig(SIZE))
    for view in views:
        answer, before = filter_method.answer(frames_of(view)), method().answer(frames_of(view))
        both = (view.depth_mm > 0) & ~view.void & (before.depth > 0)
        error, error_before = (
            np.abs(one.depth - view.depth_mm)[both].mean() for one in (answer, before)
        )
        assert error < 0.9 * error_before
        assert (answer.depth[before.depth > 0] > 0).all()  # nothing is taken away
        assert answer.sigma_mm is not None and (answer.sigma_mm[answer.depth > 0] > 0).all()
        np.testing.assert_array_equal(filter_method.predict(frames_of(view)), answer.depth)


def test_scores_count_a_missed_pixel_with_its_whole_depth(samples: list[Sample]) -> None:
    sample = samples[0]
    exact = Filtered(
        sample.missing,
        np.ones_like(sample.missing),
        np.full(sample.missing.shape, -9.0, np.float32),
        np.ones_like(sample.target),
    )
    found = replace(
        sample.scene, found=sample.scene.found & (np.arange(sample.target.shape[1]) % 2 == 0)
    )
    scores = filter_scores(exact, replace(sample, scene=found), 0.0)
    missed = sample.target & ~found.found
    whole = (sample.missing + found.middle_mm)[missed].sum(dtype=np.float64) / sample.target.sum()
    assert scores["object_mae_mm"] == pytest.approx(whole, rel=1e-5)
    assert scores["missed_percent"] == pytest.approx(100 * missed.sum() / sample.target.sum())


def test_an_image_without_a_depth_and_what_is_refused(tmp_path: Path) -> None:
    rig = paper_rig(SIZE)
    blank = [np.zeros((SIZE, SIZE), np.uint8)] * len(rig.sequence)
    assert not ClassicalNetMethod(rig).predict(blank).any()
    assert DepthScene.of(*np.zeros((3, 8, 8), np.float32)) is None
    with pytest.raises(WeightsError):
        ClassicalNetMethod(rig, weights=tmp_path / "none.safetensors")
    with pytest.raises(WeightsError, match="classical-net"):
        ClassicalNetMethod(rig, weights=Path(SHIPPED) / "unet-global-rmse.safetensors")
    with pytest.raises(NetworkError, match="positive"):
        DepthFilter(0)
    with pytest.raises(NetworkError, match="multiples of 4"):
        DepthFilter(7)(torch.zeros(1, 7, 9, 8), *torch.zeros(3, 1, 9, 8))
