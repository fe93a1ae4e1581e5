"""Training phase-net: windows that are what another scene would show, stopping and going on,
weights on disk."""

import json
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
import pytest
import torch
from flat_planes import DIRECT, USERS_WORD, plane_depth_m, plane_fringe

from fpp_ml_bench.baselines.learned import training
from fpp_ml_bench.baselines.learned.inputs import PHASE_CHANNELS, Geometry, Rotation
from fpp_ml_bench.baselines.learned.network import PhaseNet, load_net
from fpp_ml_bench.baselines.learned.recipes import PhaseRecipe, PhaseTask, Variation, phase_sample
from fpp_ml_bench.baselines.learned.scenes import Group, View, read_views
from fpp_ml_bench.baselines.learned.training import WindowTraining, train_net
from fpp_ml_bench.baselines.learned.windows import Sample
from fpp_ml_bench.baselines.phase.observe import OneCarrier
from fpp_ml_bench.baselines.phase.settings import Settings
from fpp_ml_bench.baselines.registry import load_method
from fpp_ml_bench.baselines.training.engine import CHECKPOINT, reproducible
from fpp_ml_bench.baselines.training.weights import PHASE_NETWORKS, SHIPPED, NetConfig, save_weights
from fpp_ml_bench.errors import RecipeError, TrainingError, WeightsError
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.optics.named_rigs import paper_rig

RIG = paper_rig(240)
AS_CAPTURED = Variation(near_edge=0, shift=0, wrong_window=0, wrong_patch=0, mirror=0, brightness=0)
OPTIONS = {
    "widths": [4, 6],
    "fine": 4,
    "squeezed": 6,
    "order_widths": [4, 6],
    "bound_rad": 1.0,
    "uncertain": True,
}
SMALL = PhaseRecipe(
    steps=4,
    batch=2,
    window=48,
    warm_up=1,
    widths=(4, 6),
    fine=4,
    squeezed=6,
    order_widths=(4, 6),
    bound_rad=1.0,
    validate_every=2,
    directions=("horizontal",),
)
CONFIG = NetConfig(
    name="small",
    title="Small",
    options=OPTIONS,
    threshold=-1.0,
    period_px={"horizontal": 5.6},
    dataset_fingerprint="0" * 64,
)


def geometry(direction: str = "horizontal") -> Geometry:
    """Of a calibrated lamp: planes that fill the frame show no background to take its strength
    from."""
    return Geometry(OneCarrier(RIG, Settings(direction=direction, **USERS_WORD)))  # type: ignore[arg-type]


def plane(distance_m: float, direction: str = "horizontal") -> Sample:
    """A tilted plane that fills the frame; one ray a pixel, since the fringe is to be as deep as it
    is bright."""
    tilt = (0.1, -0.1)
    depth_m = plane_depth_m(RIG, distance_m, tilt)
    image = plane_fringe(
        RIG, 0 if direction == "horizontal" else 18, depth_m, tilt, noise=0.3, light=DIRECT
    )
    depth_mm, nothing = (1000 * depth_m).astype(np.float32), np.zeros(depth_m.shape, bool)
    view = View("plane_A0", "plane", "paper", image[None], depth_mm, nothing)
    sample = phase_sample(view, image, geometry(direction))
    assert sample is not None
    return sample


def task(window: int, vary: Variation = AS_CAPTURED, direction: str = "horizontal") -> PhaseTask:
    """Of windows of so many px, and a calibrated lamp."""
    its_task = replace(SMALL, window=window, vary=vary).task(RIG)
    its_task.geometries = {direction: geometry(direction)}  # type: ignore[dict-item]
    return its_task


class ToTheMiddle(np.random.Generator):
    """Moves objects to the middle of the working range, 1.8 m."""

    def uniform(self, low: float = 0.0, high: float = 1.0, size: None = None) -> float:  # type: ignore[override]
        return (low + high) / 2


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
def test_an_object_that_is_moved_looks_as_if_it_stood_there(direction: str) -> None:
    """Against the benchmark's own light and sensor on a plane at the other distance: fringe,
    brightness, candidates."""
    moved, random = (
        replace(AS_CAPTURED, shift=1.0),
        [ToTheMiddle(np.random.PCG64(1)) for _ in range(2)],
    )
    moved_window = task(240, moved, direction).draw([plane(1.7, direction)], random[0])
    captured_window = task(240, AS_CAPTURED, direction).draw([plane(1.8, direction)], random[1])
    lit = (
        moved_window["fitted"]
        & captured_window["fitted"]
        & (moved_window["x"][PHASE_CHANNELS.index("window share")] > 0.9)
    )
    lit &= (
        moved_window["x"][PHASE_CHANNELS.index("brightness")] > -0.5
    )  # the projector's field ends before the camera's
    assert lit.mean() > 0.5
    for name, tolerance in (
        ("brightness", 0.03),
        ("base: brightness misfit", 0.05),
        ("slope down", 0.02),
    ):
        channel = PHASE_CHANNELS.index(name)
        assert (
            np.abs(np.median(moved_window["x"][channel][lit] - captured_window["x"][channel][lit]))
            < tolerance
        ), name
    # Fringe and phase part by what an object keeps and a frame-filling plane does not: its place in
    # the image.
    assert np.abs(moved_window["x"][PHASE_CHANNELS.index("fit misfit")][lit]).mean() < 0.03
    assert (moved_window["order"][lit] == 1).mean() > 0.99
    assert np.abs(moved_window["correction_rad"][lit]).mean() < 0.05


def test_wrong_first_orders_are_labelled_as_such() -> None:
    vary = replace(AS_CAPTURED, wrong_window=1.0)
    samples = [plane(1.8)]
    orders = []
    for seed in range(4):
        window = task(96, vary).draw(samples, np.random.default_rng(seed))
        assert np.take_along_axis(window["exists"], np.maximum(window["order"], 0)[None], 0)[0][
            window["fitted"]
        ].all()
        orders += [window["order"][window["fitted"]]]
    labels = np.unique(np.concatenate(orders))
    assert {0, 2} & set(labels.tolist())
    captured = task(96).draw(samples, np.random.default_rng(0))
    assert (captured["order"][captured["fitted"]] == 1).mean() > 0.95


def test_turning_for_the_network_and_back() -> None:
    image = np.arange(24.0).reshape(2, 3, 4)
    for transposed in (False, True):
        for reverse in (False, True):
            turn = Rotation(transposed, reverse, 1.0)
            assert np.array_equal(turn.back(turn.turn(image)), image)
            assert turn.turn(image).shape == ((2, 4, 3) if transposed else (2, 3, 4))


def test_stopping_and_going_on_gives_the_same_weights(tmp_path: Path) -> None:
    samples, small = [plane(1.7), plane(1.9)], task(SMALL.window, SMALL.vary)

    def trained(
        name: str, recipe: PhaseRecipe = SMALL, minutes: float | None = None
    ) -> WindowTraining:
        (tmp_path / name).mkdir(exist_ok=True)
        with reproducible(cpu=True):
            small.recipe = recipe
            training = WindowTraining(small, samples, samples[:1], tmp_path / name)
            training.run(perf_counter(), minutes, show=False)
        return training

    at_once, first = trained("a"), trained("b", minutes=0.0)
    assert (first.steps_done, first.over, at_once.steps_done) == (2, False, 4)
    second = trained("b")
    assert [record["step"] for record in second.history] == [2, 4]
    for name, value in at_once.network.state_dict().items():
        assert torch.equal(value, second.network.state_dict()[name]), name
    assert at_once.history[-1]["loss_phase"] == second.history[-1]["loss_phase"]
    with pytest.raises(TrainingError, match="another recipe"):
        trained("b", replace(SMALL, seed=1))
    assert (tmp_path / "b" / CHECKPOINT).exists()


def test_recipes_that_train_nothing_are_refused() -> None:
    for wrong in (
        {"steps": 0},
        {"unions": -1},
        {"rate": 0.0},
        {"directions": ("both",)},
        {"averaged": 1.0},
        {"albedo": "two"},
        {"textured_every": 0},
        {"lights": -1},
    ):
        with pytest.raises(RecipeError):
            replace(SMALL, **wrong)  # type: ignore[arg-type]
    assert SMALL.digest != replace(SMALL, rate=1e-3).digest
    assert SMALL.rate_at(0) > SMALL.rate_at(3) > 0


def save_net(path: Path, network: PhaseNet, config: NetConfig) -> str:
    return save_weights(path, network, config, family=PHASE_NETWORKS)


def test_weights_come_back_as_they_were(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = PhaseNet(**OPTIONS)
    torch.nn.init.normal_(network.answer.weight)
    network(torch.rand(2, len(PHASE_CHANNELS), 24, 24))  # the normalisation has seen something
    path = tmp_path / "small.safetensors"
    digest = save_net(path, network, CONFIG)
    assert save_net(tmp_path / "again.safetensors", network, CONFIG) == digest
    file = load_net(path)
    assert (file.sha256, file.config) == (digest, CONFIG)
    x = torch.rand(1, len(PHASE_CHANNELS), 24, 24)
    with torch.inference_mode():
        for answer, loaded in zip(network.eval()(x), file.network(x), strict=True):
            # Every weight is rounded to half precision, by 2**-12 of it at most; float32 rounding
            # is far below that.
            tolerance = 2**-9 * float(answer.abs().max())
            torch.testing.assert_close(loaded, answer, rtol=0, atol=tolerance)
            assert answer.std() > 10 * tolerance


def test_weights_that_are_none_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "small.safetensors"
    save_net(path, PhaseNet(**OPTIONS), CONFIG)
    data = path.read_bytes()
    cut, junk, wider = (
        tmp_path / "cut.safetensors",
        tmp_path / "junk.safetensors",
        tmp_path / "wider.safetensors",
    )
    cut.write_bytes(data[:-100])
    junk.write_bytes(b"not weights at all")
    wide = PhaseNet(**OPTIONS | {"widths": [4, 8]})
    save_net(wider, wide, replace(CONFIG, options=wide.options))
    wider.write_bytes(wider.read_bytes().replace(rb"\"widths\":[4,8]", rb"\"widths\":[4,6]"))
    with pytest.raises(WeightsError, match=r"tensor .*: expected float32"):
        save_net(
            tmp_path / "not.safetensors", PhaseNet(**OPTIONS), replace(CONFIG, options=wide.options)
        )
    unet = next(SHIPPED.glob("*.safetensors"))
    for file, message in (
        (tmp_path / "none.safetensors", "found nothing"),
        (cut, "damaged"),
        (junk, "cut off|damaged"),
        (unet, "expected weights of fpp-ml-bench phase-net"),
        (wider, "tensor .*: expected float32"),
    ):
        with pytest.raises(WeightsError, match=message):
            load_net(file)
    with pytest.raises(WeightsError, match="phase-nut"):
        load_net("phase-nut")
    bad = PhaseNet(**OPTIONS)
    with torch.no_grad():
        bad.answer.bias[0] = float("nan")
    with pytest.raises(WeightsError, match="not finite"):
        save_net(path, bad, CONFIG)
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    assert header["__metadata__"]["format"] == "fpp-ml-bench phase-net"


def test_a_training_in_small_is_resumed_and_predicts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From its own views to weights that a method takes; views whose light nothing calibrates are
    left out."""
    rig = paper_rig(320)
    groups = [
        Group("paper", named_light("paper"), (("wood_block", "A0"), ("duct_tape", "A60"))),
        Group("validation-paper", named_light("paper"), (("mug", "A0"),), "validation"),
    ]
    monkeypatch.setattr(training, "groups_of", lambda *args: groups)
    out, recipe = tmp_path / "run", replace(SMALL, steps=2, validate_every=1, batch=1, albedo="any")
    first = train_net(recipe, out, rig=rig, minutes=1e-9)
    assert first.weights is None and first.steps == 1
    trained = train_net(recipe, out, rig=rig)
    assert trained.weights is not None and 0 <= trained.validation["missed_percent"] <= 100
    assert (out / "reliability.png").stat().st_size > 1000
    assert train_net(recipe, out, rig=rig) == trained
    with pytest.raises(TrainingError, match="another training"):
        train_net(replace(recipe, albedo="one"), out, rig=rig)
    method = load_method("phase-net", rig, weights=trained.weights)
    assert "any albedo" in method.title and method.settings["shading"] is False
    view = next(read_views(out / "views", groups, "validation"))
    answer = method.answer([view.frames[0]] + [None] * (len(rig.sequence) - 1))
    assert answer.depth.dtype == np.float32 and np.array_equal(
        answer.sigma_mm > 0, answer.depth > 0
    )
    dark = replace(view, frames=view.frames // 50)
    its_task = replace(recipe, albedo="one").task(rig)
    assert len(its_task.samples([view])) == 1 and its_task.samples([dark]) == []
