"""The classical method: its error obeys the noise law over N, and it reads only the frames that it
names."""

from dataclasses import replace

import numpy as np
import pytest
import yaml
from conftest import TINY_SIZE, fpp_bench, printed, refusal
from edges import edge_distance_px
from flat_planes import DIRECT, RIG, plane_depth_m, plane_fringe

from fpp_ml_bench.baselines.classical import ClassicalMethod
from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.baselines.registry import load_method, methods
from fpp_ml_bench.baselines.run import predict_split
from fpp_ml_bench.decoding.triangulation import coordinate_slope_px_per_mm, noise_by_light
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DatasetError, DecodeError, FppBenchError, PredictionError, RigError
from fpp_ml_bench.loaders.render.builder import build
from fpp_ml_bench.loaders.render.scene import BuildSettings
from fpp_ml_bench.loaders.render.sensor import camera_noise
from fpp_ml_bench.loaders.sample import VOID, Flag
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig_file import rig_from_dict

STEPS = (3, 4, 6, 9, 18)


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    """A cork at 240 px and noise of 3 grey levels, where sensor noise and not the 8-bit pattern
    decides. In direct light on one ray a pixel: further bounces and mixed pixels move the phase by
    what no step averages away."""
    folder = tmp_path_factory.mktemp("noisy") / "set"
    noisy = DIRECT.changed("camera", **camera_noise(3.0))
    build(folder, BuildSettings(paper_rig(240), ("bowl", "cork"), light=noisy), workers=1)
    return DatasetFolder(folder)


def interior_rmse_mm(opened, direction, steps):
    """RMSE against exact depth over all object pixels 3 px or more from an edge that are
    decoded."""
    classical = ClassicalMethod(opened.rig, direction=direction, steps=steps)
    squares, count = 0.0, 0
    for sample in opened.samples("all"):
        exact = opened.depth_mm(sample, "depth_exact")
        depth = classical.predict(opened.frames(sample, range(len(opened.sequence))))
        inside = object_mask(exact) & (edge_distance_px(exact) >= 3) & object_mask(depth)
        error = depth[inside].astype(np.float64) - exact[inside]
        # A handful of grazing pixels of almost no modulation would decide alone: leave out the
        # dimmest tenth.
        white = opened.frame(sample, opened.sequence.white)[inside]
        bright = white > np.quantile(white, 0.1)
        squares += float((error[bright] ** 2).sum())
        count += int(bright.sum())
    assert count > 5000
    return np.sqrt(squares / count)


@pytest.mark.long
def test_error_follows_one_over_root_n(noisy):
    errors = np.array([interior_rmse_mm(noisy, "both", steps) for steps in STEPS])
    scaled = errors * np.sqrt(STEPS)
    assert np.abs(scaled / scaled.mean() - 1).max() < 0.10
    assert (np.diff(errors) < 0).all()


@pytest.mark.long
def test_both_directions_are_better_than_either(noisy):
    errors = {d: interior_rmse_mm(noisy, d, 18) for d in ("vertical", "horizontal", "both")}
    assert errors["vertical"] < errors["horizontal"]  # baselines of 125 and 100 mm
    combined = 1 / np.sqrt(errors["vertical"] ** -2 + errors["horizontal"] ** -2)
    assert errors["both"] == pytest.approx(combined, rel=0.05)


@pytest.mark.long
@pytest.mark.parametrize(("direction", "steps"), [("both", 18), ("vertical", 6), ("horizontal", 4)])
def test_the_stated_uncertainty_covers_what_it_says(noisy, direction, steps, monkeypatch):
    """Where noise is all there is, before what light and calibration may add; of grazing pixels of
    almost no modulation only the luckier ones are decoded."""
    monkeypatch.setattr("fpp_ml_bench.baselines.classical.STATED_SYSTEMATIC_RAD", 0.005)
    classical = ClassicalMethod(noisy.rig, direction=direction, steps=steps)
    deviations = []
    for sample in noisy.samples("all"):
        exact = noisy.depth_mm(sample, "depth_exact")
        answer = classical.answer(noisy.frames(sample, range(len(noisy.sequence))))
        np.testing.assert_array_equal(answer.sigma_mm > 0, answer.depth > 0)
        white = noisy.frame(sample, noisy.sequence.white)
        inside = (
            object_mask(exact)
            & (edge_distance_px(exact) >= 3)
            & object_mask(answer.depth)
            & (white > 60)
        )
        deviations.append(
            np.abs(answer.depth.astype(np.float64) - exact)[inside] / answer.sigma_mm[inside]
        )
    found = np.concatenate(deviations)
    for sigmas, nominal in ((0.9945, 0.68), (1.96, 0.95), (2.576, 0.99)):
        assert (found < sigmas).mean() == pytest.approx(nominal, abs=0.02)


@pytest.mark.long
def test_the_calibration_s_error_is_stated_and_moves_no_depth(noisy):
    known = replace(noisy.rig, calibration_px=0.25)
    assert known == noisy.rig and rig_from_dict(known.to_dict()).calibration_px == 0.25
    frames = noisy.frames(noisy.samples("all")[0], range(len(noisy.sequence)))
    plain, stated = (
        ClassicalMethod(rig, direction="vertical").answer(frames) for rig in (noisy.rig, known)
    )
    np.testing.assert_array_equal(stated.depth, plain.depth)
    found = plain.depth > 0
    rays = tuple(axis[found] for axis in noisy.rig.camera.rays())
    of_px = 0.25 / np.abs(
        coordinate_slope_px_per_mm(noisy.rig, plain.depth[found], "vertical", rays)
    )
    np.testing.assert_allclose(
        stated.sigma_mm[found], np.hypot(plain.sigma_mm[found], of_px), rtol=1e-5
    )
    with pytest.raises(RigError, match="calibration_px: expected 0 or more"):
        replace(noisy.rig, calibration_px=-0.1)


def test_noise_that_light_brings_is_told_from_noise_in_the_dark():
    rig, random = paper_rig(64), np.random.default_rng(3)
    rows, columns = np.indices((64, 64))
    bright = 10 + columns * 2.0
    turns = rig.code("vertical").fringes[0].turns
    frames = [None] * len(rig.sequence)
    for index, turn in zip(rig.sequence.sinusoids("vertical"), turns, strict=True):
        light = bright * (1 + 0.9 * np.cos(2 * np.pi * (rows / 20 + turn)))
        frames[index] = (
            light + random.normal(0, np.sqrt(0.5 + 0.02 * bright), light.shape)
        ).astype(np.float32)
    dark, per_grey = noise_by_light(frames, rig)
    assert dark == pytest.approx(0.5, abs=0.1)
    assert per_grey == pytest.approx(0.02, abs=0.003)
    assert noise_by_light([None] * len(frames), rig) is None


@pytest.mark.long
def test_steps_that_do_not_divide_eighteen(noisy):
    assert interior_rmse_mm(noisy, "both", 7) < 1.5 * interior_rmse_mm(noisy, "both", 18) * np.sqrt(
        18 / 7
    )


@pytest.mark.long
def test_accuracy_in_the_papers_light(opened):
    """With further bounces and pixels with an area: 0.31 to 1.15 mm, of which single bounced and
    mixed pixels bring the more; 0.26 to 0.62 mm without them."""
    classical = ClassicalMethod(opened.rig)
    for sample in opened.samples("test"):
        exact, flags = opened.depth_mm(sample, "depth_exact"), opened.flags(sample)
        depth = classical.predict(opened.frames(sample, range(52)))
        inside = object_mask(exact) & (edge_distance_px(exact) >= 3) & object_mask(depth)
        error = np.abs(depth.astype(np.float64) - exact)
        plain = inside & ((flags & (VOID | Flag.INTERREFLECTION)) == 0)
        assert error[inside].mean() < 1.5
        assert plain.sum() > 0.7 * inside.sum()
        assert error[plain].mean() < 0.8


@pytest.mark.parametrize(("direction", "steps"), [("vertical", 3), ("horizontal", 7), ("both", 18)])
def test_only_the_frames_it_names_are_used(opened, direction, steps):
    classical = ClassicalMethod(opened.rig, direction=direction, steps=steps)
    used = classical.frames_used
    assert list(used) == sorted(set(used))
    allowed = {
        "horizontal": {*range(18), *range(36, 43)},
        "vertical": {*range(18, 36), *range(43, 50)},
    }
    named = allowed if direction == "both" else [direction]
    for name in named:
        assert len(allowed[name].intersection(used)) == steps + 7
    assert len(used) == len(named) * (steps + 7)
    captured = opened.frames("mug_A0", range(52))
    everything = classical.predict(captured)
    only = classical.predict([frame if i in used else None for i, frame in enumerate(captured)])
    np.testing.assert_array_equal(everything, only)
    for gone in (used[0], used[-1]):
        with pytest.raises(DecodeError):
            classical.predict([None if i == gone else frame for i, frame in enumerate(captured)])


def test_without_a_mask_background_is_not_in_range(opened):
    """The method is not told where the object is: the background plane at 3.2 m must come out as
    0."""
    sample = "bowl_A60"
    depth = ClassicalMethod(opened.rig).predict(opened.frames(sample, range(52)))
    exact = opened.depth_mm(sample, "depth_exact")
    assert (depth[edge_distance_px(exact) * ~object_mask(exact) > 2] == 0).all()
    decoded = opened.depth_mm(sample)
    both = object_mask(depth) & object_mask(decoded)
    assert both.sum() > 0.97 * object_mask(decoded).sum()
    np.testing.assert_array_equal(
        depth[both], decoded[both]
    )  # all steps, both directions: the same process


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("classical", {"steps": 3, "direction": "vertical"}),
        ("classical", {"steps": 3, "fewest": True}),
    ],
)
def test_beyond_the_end_of_the_range_there_is_no_depth(name, options):
    method, exact_m = load_method(name, RIG, **options), plane_depth_m(RIG, 2.1, (0.025, 0.0))
    frames = [
        plane_fringe(RIG, index, exact_m, (0.025, 0.0)) if index in method.frames_used else None
        for index in range(len(RIG.sequence))
    ]
    answer, exact_mm = method.answer(frames), exact_m * 1000
    assert answer.depth.max() <= 2100 and not answer.sigma_mm[answer.depth == 0].any()
    assert (answer.depth[exact_mm > 2106] == 0).mean() > 0.999
    lit = exact_mm[:, 60:-60] < 2094  # the projector's field ends before the camera's
    assert (np.abs(answer.depth - exact_mm)[:, 60:-60][lit] < 8).mean() > 0.8


@pytest.mark.parametrize("steps", [2, 19])
def test_steps_out_of_bounds(opened, steps):
    with pytest.raises(DecodeError, match="3 to the 18"):
        ClassicalMethod(opened.rig, steps=steps)


UNIT_CUE = {"scheme": "phase-shift", "pitches_px": [57, 912], "steps": 3, "sign": -1}
GRAY = {"scheme": "gray", "cell_px": 2}
PLAIN = {"scheme": "phase-shift", "pitch_px": 18, "steps": 9, "gray": {}}


@pytest.mark.parametrize(
    ("sequence", "direction", "title", "frames"),
    [
        ({"vertical": UNIT_CUE}, "vertical", "Classical, vertical phase-shift 57 + 912 px", 6),
        ({"vertical": GRAY}, "vertical", "Classical, vertical Gray code, cells of 2 px", 11),
        (
            {"horizontal": UNIT_CUE, "vertical": PLAIN},
            "both",
            "Classical, horizontal phase-shift 57 + 912 px, vertical phase-shift 18 px + Gray code",
            22,
        ),
        ({"vertical": PLAIN}, "vertical", "Classical 9-step + Gray code, vertical fringes", 16),
    ],
)
def test_any_rig(sequence, direction, title, frames):
    """All that the rig codes; with the paper's kind of code the paper's title and settings."""
    data = paper_rig(TINY_SIZE).to_dict()
    del data["pitch_px"]
    rig = rig_from_dict({**data, "sequence": {"order": ["white", *sequence, "black"], **sequence}})
    method = ClassicalMethod(rig)
    assert (method.title, method.direction, len(method.frames_used)) == (title, direction, frames)
    assert set(method.settings) == {
        "direction",
        "steps" if "9-step" in title else "code",
        "threads",
    }
    grey = np.full((TINY_SIZE, TINY_SIZE), 40, np.uint8)
    used = [grey if i in method.frames_used else None for i in range(len(rig.sequence))]
    assert not method.predict(used).any()  # nothing varies, and no frame is missing
    for gone in (method.frames_used[0], method.frames_used[-1]):
        with pytest.raises(DecodeError, match="got None"):
            method.predict([None if i == gone else frame for i, frame in enumerate(used)])


def one_direction(code):
    data = paper_rig(TINY_SIZE).to_dict()
    del data["pitch_px"]
    return rig_from_dict({**data, "sequence": {"order": ["white", "vertical"], "vertical": code}})


def test_the_phase_route_refuses_an_error_where_no_gray_code_can_be_added():
    with pytest.raises(PredictionError, match="error_mm needs fringes of one period with Gray"):
        load_method("phase", one_direction({**UNIT_CUE, "sign": 1}), error_mm=3.0)


def test_the_phase_route_takes_the_only_direction_that_a_rig_has():
    assert load_method("phase", one_direction({**UNIT_CUE, "sign": 1}), frames=3).frames_used == (
        1,
        2,
        3,
    )
    assert load_method("phase", one_direction(UNIT_CUE)).settings["direction"] == "vertical"
    assert load_method("constant", one_direction(UNIT_CUE)).frames_used == (1,)


def test_methods_by_name(opened):
    assert tuple(methods()) == (
        "classical",
        "phase",
        "crossed",
        "fringe-net",
        "constant",
        "nearest",
    )
    assert (
        load_method("classical", opened.rig, steps=4).title
        == "Classical 4-step + Gray code, both directions"
    )
    network = load_method("unet-individual-rmse", opened.rig, device="cpu")
    assert (network.frames_used, network.units, network.mode) == ((0,), "normalised", "paper")
    with pytest.raises(FppBenchError, match="there are classical"):
        load_method("magic", opened.rig)
    assert network.learned_from == {
        "data": "train-split",
        "versions": ["fpp-bench-full-224 version 2"],
    }
    learned = [
        load_method("constant", opened.rig, at=at).learned_from["data"]
        for at in ("standoff", "training-mean")
    ]
    assert learned == ["none", "train-split"]
    assert load_method("phase", opened.rig).learned_from == {"data": "none"}


# ---- predictions


def test_prediction_folder(opened, tmp_path):
    out, samples_done = tmp_path / "out", []
    classical = ClassicalMethod(opened.rig, direction="vertical", steps=4)
    seconds = predict_split(opened, classical, "validation", out, samples_done.append)
    assert seconds > 0 and samples_done == [1] * 6
    assert sorted(p.name for p in out.iterdir()) == sorted(
        [
            *(f"mug_A{a}{end}" for a in range(0, 360, 60) for end in (".npy", ".sigma.npy")),
            "submission.yaml",
        ]
    )
    for sample in opened.samples("validation"):
        depth = np.load(out / f"{sample}.npy")
        assert depth.dtype == np.float32 and depth.shape == (TINY_SIZE, TINY_SIZE)
        np.testing.assert_array_equal(depth, classical.predict(opened.frames(sample, range(52))))
    submission = yaml.safe_load((out / "submission.yaml").read_text())
    assert submission["frames_used"] == list(classical.frames_used) and submission["units"] == "mm"
    assert (
        submission["uses_ground_truth_range"] is False
        and submission["seconds_source"] == "measured"
    )
    assert submission["settings"] == {"direction": "vertical", "steps": 4, "threads": 1}
    assert submission["seconds_per_sample"] == pytest.approx(seconds, rel=1e-4)


def test_predictions_at_a_url(tiny, tmp_path):
    url = (tmp_path / "there").as_uri()
    words = ["predict", "constant", str(tiny), "--split", "validation", "--out", url]
    assert f"next: copy {url} to a disk" in printed(fpp_bench, *words)
    names = sorted([*(f"mug_A{a}.npy" for a in range(0, 360, 60)), "submission.yaml"])
    assert sorted(path.name for path in (tmp_path / "there").iterdir()) == names
    assert f"{url}: already holds submission.yaml and more" in refusal(fpp_bench, *words)


def test_method_sees_copies_and_no_other_frame(opened, tmp_path):
    class Spy(Method):
        name, title, frames_used = "spy", "Spy", (0, 20)

        def predict(self, frames):
            assert [i for i, f in enumerate(frames) if f is not None] == [0, 20] and len(
                frames
            ) == 52
            frames[0][:] = 0  # a method may work in place: the dataset is not its to change
            return np.ones(opened.size, np.float32)

    before = opened.frame("mug_A0", 0).copy()
    predict_split(opened, Spy(opened.rig), "validation", tmp_path / "out")
    np.testing.assert_array_equal(opened.frame("mug_A0", 0), before)


def test_an_answer_that_is_none_is_named(opened, tmp_path):
    class Bare(Method):
        name, title, frames_used = "x", "X", (0,)

        def answer(self, frames):
            return np.ones(opened.size, np.float32)

    with pytest.raises(PredictionError, match=r"answer gave ndarray, expected Answer\(depth\)"):
        predict_split(opened, Bare(opened.rig), "validation", tmp_path / "out")


@pytest.mark.parametrize(
    ("depth", "says"),
    [
        (np.ones((TINY_SIZE, TINY_SIZE)), "expected float32"),
        (np.ones((10, 10), np.float32), "expected float32"),
        (np.full((TINY_SIZE, TINY_SIZE), np.nan, np.float32), "not finite"),
    ],
)
def test_faulty_methods_are_caught(opened, tmp_path, depth, says):
    class Faulty(Method):
        name, title, frames_used = "x", "X", (0,)

        def predict(self, frames):
            return depth

    with pytest.raises(PredictionError, match=says):
        predict_split(opened, Faulty(opened.rig), "validation", tmp_path / "out")
    assert not list((tmp_path / "out").glob("*"))


def test_foreign_folders_are_not_taken_over(opened, tmp_path):
    classical = ClassicalMethod(opened.rig, direction="vertical", steps=3)
    out = tmp_path / "out"
    predict_split(opened, classical, "validation", out)
    with pytest.raises(PredictionError, match=r"already holds submission.yaml"):
        predict_split(opened, classical, "validation", out)
    (out / "submission.yaml").unlink()  # predictions of whatever run
    with pytest.raises(PredictionError, match=r"already holds mug_A0.npy and more"):
        predict_split(opened, classical, "validation", out)
    (tmp_path / "file").write_text("x")
    with pytest.raises(PredictionError, match="can't be made a folder"):
        predict_split(opened, classical, "validation", tmp_path / "file")


def test_dataset_without_the_frames(dataset, tmp_path):
    with pytest.raises(DatasetError, match=r"frame 18 is not stored.*--config all"):
        predict_split(
            dataset, ClassicalMethod(dataset.rig, direction="vertical"), "train", tmp_path / "out"
        )
