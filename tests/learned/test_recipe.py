"""Training on drawn rigs: what an image and a window show, and a small training."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from fpp_ml_bench.baselines.learned import recipe
from fpp_ml_bench.baselines.learned.images import (
    OBJECT,
    FringeImage,
    Setting,
    read_images,
    render_settings,
    settings_of,
)
from fpp_ml_bench.baselines.learned.method import FringeNetMethod
from fpp_ml_bench.baselines.learned.network import FringeNet
from fpp_ml_bench.baselines.learned.recipe import FringeRecipe
from fpp_ml_bench.baselines.learned.training import train_net
from fpp_ml_bench.baselines.learned.warp import Warp, known, to_known
from fpp_ml_bench.baselines.phase.geometry import wrapped
from fpp_ml_bench.constants import TAU, split_of
from fpp_ml_bench.errors import NetworkError, RecipeError, TrainingError
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.optics.named_rigs import crossed_rig
from fpp_ml_bench.optics.sequence import DIRECTIONS

RIG, LIGHT = crossed_rig(320, "crossed-18"), named_light("paper")
SETTINGS = [
    Setting("train-000", RIG, LIGHT, (("wood_block", "A0"), ("duct_tape", "A60"))),
    Setting("validation-00", RIG, LIGHT, (("mug", "A0"),), "validation"),
]
SMALL = FringeRecipe(
    steps=30,
    batch=2,
    window=64,
    warm_up=1,
    widths=(8, 12),
    fine=8,
    validate_every=15,
    averaged=0.9,
)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> list[FringeImage]:
    folder = tmp_path_factory.mktemp("settings")
    render_settings(SETTINGS, folder, 1, 1, False)
    return list(read_images(SETTINGS, folder, "train"))


def test_images_hold_object_and_surroundings_of_all_fringes(images: list[FringeImage]) -> None:
    assert {image.fringes for image in images} == {"crossed", "horizontal", "vertical"}
    assert {image.name for image in images if "+" in image.name}  # unions
    for image in images:
        assert image.shown and len(image.step_rad) == len(image.signs)
        light = image.grey.astype(np.float32)
        inside = image.label == OBJECT
        shape = image.phase_rad.astype(np.float32)
        if inside.sum() < 2000:
            continue
        expected = np.cos(shape).sum(axis=0)[inside]
        assert np.corrcoef(light[inside] / (1 + image.bright[inside]), expected)[0, 1] > 0.85
        outside = image.misfit[image.label == 0].astype(np.float32)
        assert np.median(np.abs(outside)) < 0.5  # the wall is explained, the object is not
        assert np.median(np.abs(image.misfit[inside].astype(np.float32))) > 0.5


def test_windows_show_the_phases_that_are_asked_for(images: list[FringeImage]) -> None:
    random = np.random.default_rng(0)
    seen = set()
    for _ in range(60):
        window = SMALL.draw(images, random)
        places = tuple(np.flatnonzero(window["fitted"].any(axis=(1, 2))))
        fitted = window["fitted"].any(axis=0)
        assert window["x"].shape == (4, 64, 64) and not (fitted & ~window["mask_valid"]).any()
        if fitted.sum() < 400:
            continue
        seen.add(places)
        light = window["truth"][3:].sum(axis=0)[fitted]
        assert np.corrcoef(window["x"][1][fitted], light)[0, 1] > 0.7
        if places == (0,):
            phase = np.arctan2(window["truth"][0], window["truth"][3])
            down = wrapped(np.diff(phase, axis=0))[fitted[1:] & fitted[:-1]]
            assert 0.1 < np.median(down) < 0.6
    assert seen == {(0,), (1, 2)}


def test_any_carriers_come_to_those_that_are_known() -> None:
    steps, signs = known(2)
    matrix, turned = to_known(steps, signs)
    assert matrix == pytest.approx(np.eye(2)) and (turned == 1).all()
    mirrored, turned = to_known(steps * [[1], [-1]], signs * [1, -1])
    assert mirrored == pytest.approx(np.eye(2)) and turned.tolist() == [1, -1]
    step_rad = TAU / 9 * np.array([[np.cos(0.3), np.sin(0.3)]])
    matrix, _ = to_known(step_rad, np.ones(1))
    assert known(1)[0] @ matrix == pytest.approx(step_rad)
    for period_px, seen_px in ((15.0, 15.0), (20.0, 20.0), (60.0, 20.9), (5.0, 11.6)):
        warp = Warp.of(steps * (15.0 / period_px), signs)
        assert warp.period_px == pytest.approx(seen_px, rel=0.01)
        assert warp.needed == (period_px != seen_px)


@pytest.mark.long
def test_settings_are_drawn_again_the_same_and_of_their_split() -> None:
    first, again = (settings_of(2, 3, 1, 7) for _ in range(2))
    assert first == again and [one.split for one in first] == ["train"] * 2 + ["validation"] * 3
    for setting in first:
        assert {split_of(name) for name, _ in setting.views} == {setting.split}
        assert setting.light.calibration_px == 0


@pytest.mark.long
def test_a_training_in_small_is_resumed_and_predicts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recipe, "settings_of", lambda *args: SETTINGS)
    out = tmp_path / "run"
    stopped = train_net(SMALL, out, minutes=1e-9)
    assert stopped.weights is None and stopped.steps == 15
    trained = train_net(SMALL, out)
    assert trained.weights == out / "fringe-net-42.safetensors"
    assert 0 < trained.validation["crossed_interior_rad"] < 2
    assert {"line_edge_rad", "missed_percent", "invented_percent"} <= trained.validation.keys()
    losses = [
        json.loads(line)["loss_phase"] for line in (out / "log.jsonl").read_text().splitlines()
    ]
    assert losses[1] < 0.9 * losses[0]
    assert train_net(SMALL, out) == trained
    view = next(read_images(SETTINGS, out / "views", "validation"))
    assert view.fringes == "crossed"
    for fringes in ("crossed", *DIRECTIONS):
        method = FringeNetMethod.for_rig(RIG, fringes=fringes, weights=trained.weights)
        image = np.random.default_rng(0).integers(0, 256, (320, 320)).astype(np.uint8)
        answer = method.answer([image] * len(RIG.sequence))
        assert answer.sigma_mm is not None and np.array_equal(answer.sigma_mm > 0, answer.depth > 0)
        assert f"one {fringes} frame by one network" in method.title.replace(" of 18 px", "")
        submission = SimpleNamespace(settings=method.settings, name=method.title)
        assert FringeNetMethod.short_name(submission).startswith(f"fringe-net, 1 {fringes}")
    file = next((out / "views").glob("train-000*"))
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(TrainingError, match="delete it"):
        list(read_images(SETTINGS, out / "views", "train"))


def test_networks_and_recipes_that_are_refused() -> None:
    network = FringeRecipe().network()
    assert network(torch.zeros(1, 4, 32, 48)).shape == (1, 10, 32, 48)
    assert FringeNet(**network.options).options == network.options
    assert sum(parameter.numel() for parameter in network.parameters()) < 1_000_000
    with pytest.raises(NetworkError, match="positive widths"):
        FringeNet((8, 0))
    with pytest.raises(NetworkError, match="multiples of 16"):
        network(torch.zeros(1, 4, 30, 48))
    for values, said in (
        ({"steps": 0}, "steps 0: expected 1"),
        ({"unions": 101}, "unions 101: expected 0 to 100"),
        ({"views_a_rig": 41}, "views_a_rig 41: expected 1 to 40"),
        ({"rate": float("nan")}, "rate above 0"),
    ):
        with pytest.raises(RecipeError, match=said):
            FringeRecipe(**values)
