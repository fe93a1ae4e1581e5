"""FPP-C: conditions, charges, honesty, resuming; on one object at a small size."""

import json
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import fpp_bench, printed, refusal

from fpp_ml_bench.baselines.learned.scenes import HELD_OUT, drawn_light
from fpp_ml_bench.baselines.method import Answer, Method, checked
from fpp_ml_bench.baselines.robustness import axes
from fpp_ml_bench.baselines.robustness.axes import (
    CLEAN,
    SETS,
    Condition,
    FrameCache,
    Truth,
    corruptions,
    score,
)
from fpp_ml_bench.baselines.robustness.run import Setup, measure, robustness, write_page
from fpp_ml_bench.baselines.trivial import ConstantMethod
from fpp_ml_bench.constants import VIEWS
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.result.parts import Robustness
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.schema import validate

pytestmark = pytest.mark.long

SIZE, OBJECT = 176, "v_groove"
ONE_FRAME = (0,)
RULES = corruptions()
RIG = paper_rig(SIZE)
CHARGE_MM = RIG.half_range_mm


@pytest.fixture(autouse=True)
def one_object(monkeypatch):
    """Both sets are a single object of two views."""
    monkeypatch.setitem(SETS, "test", (OBJECT,))
    monkeypatch.setitem(SETS, "unseen", (OBJECT,))
    for name in SETS:
        monkeypatch.setitem(RULES.views, name, ["A0", "A60"])


def condition(axis: str, severity: int) -> Condition:
    return Condition(axis, severity, (OBJECT,), SIZE)


def frames(axis: str, severity: int, wanted=ONE_FRAME, cache=None):
    return FrameCache(cache).frames(condition(axis, severity), OBJECT, "A0", wanted)


class Noisy(Method):
    """Answers with the middle of the range and noise; ``silent`` answers nothing; ``sigma_mm`` is
    what it claims."""

    name, title, frames_used, settings = "noisy", "Noisy", ONE_FRAME, {}
    silent, sigma_mm, noise_mm = False, None, 0.0

    def predict(self, stack):
        return self.answer(stack).depth

    def answer(self, stack):
        noise = np.random.default_rng(1).normal(0, self.noise_mm, (SIZE, SIZE))
        depth = np.zeros((SIZE, SIZE)) if self.silent else 1800 + noise
        sigma = (
            None
            if self.sigma_mm is None
            else np.full((SIZE, SIZE), self.sigma_mm, dtype=np.float32)
        )
        return Answer(depth.astype(np.float32), sigma)


def test_the_issues_severities_are_those_of_the_file():
    severities = {name: list(axis.severities) for name, axis in RULES.axes.items()}
    assert severities["under-exposure"] == [0.7, 0.5, 0.35, 0.25, 0.15]
    assert severities["motion"] == [0.1, 0.25, 0.5, 1, 2]
    assert (
        len(severities) == 14
        and [name for name, axis in RULES.axes.items() if axis.beside] == list(severities)[12:]
    )
    assert all(set(views) <= set(VIEWS) for views in corruptions.__wrapped__().views.values())


@pytest.mark.parametrize("axis", RULES.axes)
def test_severity_0_is_the_clean_frame_bit_for_bit_and_5_is_another(axis):
    wanted = (0, 1, 2) if RULES.axes[axis].several_frames else ONE_FRAME
    clean, same, severe = frames(CLEAN, 0, wanted), frames(axis, 0, wanted), frames(axis, 5, wanted)
    for index in wanted:
        assert np.array_equal(clean[index], same[index])
    assert any(not np.array_equal(clean[index], severe[index]) for index in wanted)


def test_a_frame_is_that_of_the_dataset_whatever_else_is_asked_for():
    clean = frames(CLEAN, 0, (0, 18, 20))
    assert (
        np.array_equal(clean[0], frames(CLEAN, 0)[0]) and clean[1] is None and clean[18] is not None
    )


def test_frames_of_two_rigs_are_kept_apart(tmp_path):
    plain, crossed = condition(CLEAN, 0), Condition(CLEAN, 0, (OBJECT,), SIZE, "crossed-18")
    assert plain.key(ONE_FRAME) != crossed.key(ONE_FRAME)
    cache = FrameCache(tmp_path)
    first, second = (cache.frames(one, OBJECT, "A0", ONE_FRAME)[0] for one in (plain, crossed))
    assert not np.array_equal(first, second)


def test_dark_paint_is_on_the_object_and_a_dark_wall_behind_it():
    inside = FrameCache(None).truth(condition(CLEAN, 0), OBJECT, "A0").depth_mm > 0
    clean, painted, dark = (
        frames(*of)[0].astype(float) for of in ((CLEAN, 0), ("dark-paint", 5), ("dark-wall", 5))
    )
    assert painted[inside].mean() < 0.2 * clean[inside].mean()
    assert painted[~inside].mean() == pytest.approx(clean[~inside].mean(), rel=0.02)
    assert dark[inside].mean() == pytest.approx(
        clean[inside].mean(), rel=0.1
    )  # the wall lights the object a little
    assert dark[~inside].mean() < 1.0


def test_read_noise_is_in_grey_levels():
    camera = RULES.axes["read-noise"].light(RULES.clean, 3).camera
    assert camera.read_noise_e / (camera.full_well_e / 255) == pytest.approx(4)


def test_a_moving_object_rests_halfway_through_its_frames():
    moved, clean = frames("motion", 5, (0, 1, 2)), frames(CLEAN, 0, (0, 1, 2))
    assert np.array_equal(moved[1], clean[1])
    assert not np.array_equal(moved[0], clean[0]) and not np.array_equal(moved[2], clean[2])


def test_motion_is_nothing_to_one_frame_and_interreflection_to_convex_objects():
    setup = Setup(Noisy(RIG), "test", SIZE)
    assert "motion" not in setup.axes(()) and "interreflection" in setup.axes(())
    assert not RULES.axes["interreflection"].applies(("power_drill",), 1)


def truth() -> Truth:
    depth = np.zeros((SIZE, SIZE), dtype=np.float32)
    depth[20:60, 20:60] = 1700
    return Truth(depth, depth > 0, depth == 0)


def scored(depth_mm, sigma_mm=None):
    return score(depth_mm, sigma_mm, truth(), RULES, CHARGE_MM)


def test_two_axes_are_held_out_of_all_drawn_lights_and_the_rest_is_named():
    assert tuple(name for name, axis in RULES.axes.items() if axis.held_out) == HELD_OUT
    random = np.random.default_rng(0)
    for light in (drawn_light(random) for _ in range(50)):
        assert light.camera.blur_px == RULES.clean.camera.blur_px
        assert light.surface.object_share == RULES.clean.surface.object_share
    assert not RULES.axes["motion"].drawn and not RULES.axes["dark-paint"].drawn


def test_what_a_training_drew_is_said_by_its_recipe():
    class Learned(Noisy):
        weights_config = SimpleNamespace(recipe={"held_out": []})

    before = Setup(Learned(RIG), "test", SIZE).drawn
    assert "camera-blur" in before and "dark-paint" not in before and "motion" not in before
    Learned.weights_config.recipe["held_out"] = list(HELD_OUT)
    assert Setup(Learned(RIG), "test", SIZE).drawn == [
        name for name in before if name != "camera-blur"
    ]
    assert Setup(Noisy(RIG), "test", SIZE).drawn == []


def test_silence_costs_half_the_working_range():
    scores = scored(np.zeros((SIZE, SIZE)))
    assert scores["mae_mm"] == CHARGE_MM == 300
    assert (
        scores["unanswered_share"] == 1
        and scores["wrong_share"] == 0
        and scores["coverage"] is None
    )


def test_missed_invented_and_the_error_of_what_is_answered_are_told_apart():
    true, depth = truth(), truth().depth_mm + 3
    depth[20:30, 20:60] = 0  # a quarter of the object
    depth[~true.scored] = 0
    depth[:10] = 1500  # an eighth of the image
    scores = scored(depth)
    assert scores["unanswered_share"] == 0.25 and scores["answered_mae_mm"] == pytest.approx(3)
    assert scores["invented_share"] == pytest.approx(10 * SIZE / 40**2)
    assert scores["mae_mm"] == pytest.approx((0.25 + 10 * SIZE / 40**2) * CHARGE_MM + 0.75 * 3)


def test_a_right_answer_is_better_than_silence_and_silence_than_an_error_above_the_charge():
    right, wrong = (truth().depth_mm + error_mm * truth().scored for error_mm in (3, 400))
    assert scored(right)["mae_mm"] == pytest.approx(3)
    assert scored(wrong)["mae_mm"] == pytest.approx(400)
    assert scored(wrong)["wrong_share"] == 1


@pytest.mark.parametrize(("sigma_mm", "share"), [(74.0, 1.0), (76.0, 0.0)])
def test_a_lie_about_sigma_is_a_confident_error(sigma_mm, share):
    sigma = np.full((SIZE, SIZE), sigma_mm)
    scores = scored(truth().depth_mm + 300, sigma)
    assert scores["confident_share"] == share and scores["coverage"] == 1
    honest = scored(truth().depth_mm + 20, sigma)
    assert honest["confident_share"] == 0


def test_stating_no_sigma_at_all_is_no_coverage():
    scores = scored(truth().depth_mm + 300, np.zeros((SIZE, SIZE)))
    assert scores["confident_share"] == 0 and scores["coverage"] == 0


def test_no_number_is_refused():
    depth = truth().depth_mm.astype(np.float32)
    bad, size = depth.copy(), depth.shape
    bad[0, 0] = np.nan
    with pytest.raises(PredictionError, match="here: the method gave values that are not finite"):
        checked(Answer(bad), size, "here")
    with pytest.raises(PredictionError, match="not finite"):
        checked(Answer(depth, bad), size, "here")
    bad[0, 0] = -1.0
    with pytest.raises(PredictionError, match="a sigma below 0"):
        checked(Answer(depth, bad), size, "here")
    with pytest.raises(PredictionError, match="expected float32"):
        checked(Answer(depth[:-1]), size, "here")


def test_random_silent_and_lying_methods_land_where_they_should(tmp_path):
    chosen = ["ambient-light"]
    random, silent, liar = Noisy(RIG), Noisy(RIG), Noisy(RIG)
    random.noise_mm, silent.silent, liar.sigma_mm = 400.0, True, 1.0
    liar.noise_mm = 400.0
    means = {}
    for number, method in enumerate((random, silent, liar, ConstantMethod(RIG))):
        rows = measure(Setup(method, "test", SIZE, quick=True), tmp_path / str(number), chosen)
        assert set(rows) == {CLEAN, *chosen} and len(rows[chosen[0]]) == 3
        means[number] = rows[chosen[0]][0]
    assert means[1]["mae_mm"] == CHARGE_MM and means[1]["unanswered_share"] == 1
    assert (
        means[0]["mae_mm"] > 250 and means[0]["wrong_share"] > 0.5 and means[0]["coverage"] is None
    )
    assert means[2]["confident_share"] == means[2]["wrong_share"] > 0.5
    assert means[3]["answered_mae_mm"] < 150 and means[3]["wrong_share"] < 0.1


def test_measuring_resumes_axis_by_axis_and_refuses_another_methods_folder(tmp_path, monkeypatch):
    setup = Setup(Noisy(RIG), "test", SIZE, quick=True)
    first = measure(setup, tmp_path, ["ambient-light"])
    monkeypatch.setattr(Noisy, "answer", None)  # nothing is left to do
    assert measure(setup, tmp_path, ["ambient-light"]) == first
    with pytest.raises(PredictionError, match="other quick"):
        measure(Setup(Noisy(RIG), "test", SIZE), tmp_path, ["ambient-light"])
    (tmp_path / "clean.json").write_text('{"views": 3}')
    with pytest.raises(PredictionError, match=r"clean\.json: damaged"):
        measure(setup, tmp_path, ["ambient-light"])


def test_processes_and_a_cluster_give_the_same_rows_as_one(tmp_path, fake_ray):
    setup = Setup(ConstantMethod(RIG), "test", SIZE, quick=True)
    one, two = (measure(setup, tmp_path / str(n), ["ambient-light"], workers=n) for n in (1, 2))
    saved = []
    three = measure(
        setup,
        tmp_path / "3",
        ["ambient-light"],
        cluster=fake_ray.address,
        saved=lambda: saved.append(sorted(file.name for file in (tmp_path / "3").glob("*.json"))),
    )
    assert saved == [["clean.json"], ["ambient-light.json", "clean.json"]]
    for rows in (*one.values(), *two.values(), *three.values()):
        for row in rows:
            del row["seconds"]
    assert one == two == three


def test_the_cache_is_used_mended_and_kept_small(tmp_path, monkeypatch):
    first = frames("ambient-light", 2, cache=tmp_path)
    (file,) = tmp_path.rglob("*.npy")
    monkeypatch.setattr(axes.Studio, "trace", None)  # nothing is rendered
    assert np.array_equal(frames("ambient-light", 2, cache=tmp_path)[0], first[0])
    monkeypatch.undo()
    file.write_bytes(file.read_bytes()[:500])
    assert np.array_equal(frames("ambient-light", 2, cache=tmp_path)[0], first[0])
    frames("ambient-light", 3, cache=tmp_path)
    newer = file.parent.stat().st_mtime + 10
    for folder in tmp_path.iterdir():
        if folder != file.parent:
            os.utime(folder, (newer, newer))
    cache, size = FrameCache(tmp_path), file.stat().st_size
    cache.make_room(0, 2 * size)
    assert len(list(tmp_path.iterdir())) == 2
    cache.make_room(size, 2 * size)
    assert file.parent not in list(tmp_path.iterdir()) and len(list(tmp_path.iterdir())) == 1


def rows_of(axes_maes: dict[str, list[list[float]]]):
    """Rows by axis from errors by severity and sample; samples s0, s1, ... of objects o0, o0, o1,
    o1, ..."""
    found = {}
    for axis, severities in axes_maes.items():
        found[axis] = [
            {
                "sample": f"s{k}",
                "object": f"o{k // 2}",
                "severity": severity,
                "mae_mm": mae,
                "wrong_share": 0.0,
                "unanswered_share": 0.0,
                "invented_share": 0.0,
                "answered_mae_mm": mae,
                **dict.fromkeys(("confident_share", "coverage", "sure_mae_mm", "sure_rmse_mm")),
            }
            for severity, maes in enumerate(severities, 0 if axis == CLEAN else 1)
            for k, mae in enumerate(maes)
        ]
    return found


def test_the_headline_is_the_mean_over_axes_and_severities_also_of_axes_of_few_objects(monkeypatch):
    setup = Setup(Noisy(RIG), "test", SIZE)
    monkeypatch.setattr(Setup, "axes", lambda self, names: [CLEAN, "gloss", "interreflection"])
    rows = rows_of(
        {
            CLEAN: [[1, 1, 2, 2]],
            "gloss": [[s, s, 2 * s, 2 * s] for s in range(1, 6)],
            "interreflection": [[10.0, 30.0]] * 5,
        }
    )
    block = robustness(setup, rows)
    assert (
        robustness(setup, rows | rows_of({"dark-wall": [[900.0] * 4] * 5})).mae_mm == block.mae_mm
    )  # beside the others
    assert block.mae_mm == pytest.approx(((1 + 2 + 3 + 4 + 5) * 1.5 + 5 * 20) / 10)
    assert block.ratio == pytest.approx(block.mae_mm / 1.5)
    assert block.interval[0] < block.mae_mm < block.interval[1]
    assert block.mean("wrong_share") == 0 and block.mean("coverage") is None
    content = block.model_dump(mode="json")
    assert validate(Robustness, content, Path("x"), "block") == block
    with pytest.raises(Exception, match="mae_mm does not follow"):
        validate(Robustness, {**content, "mae_mm": 1.0}, Path("x"), "block")
    with pytest.raises(PredictionError, match="without gloss"):
        robustness(setup, {axis: found for axis, found in rows.items() if axis != "gloss"})
    with pytest.raises(PredictionError, match="--quick look"):
        robustness(replace(setup, quick=True), rows)


def test_a_normalised_answer_and_an_unknown_axis_are_refused():
    method = Noisy(RIG)
    method.units = "normalised"
    with pytest.raises(PredictionError, match="networks of raw or global normalisation"):
        Setup(method, "test", SIZE)
    with pytest.raises(PredictionError, match="unknown axis 'glos'; there are under-exposure"):
        corruptions().chosen(["glos"])
    assert axes.FILE.is_file()


def test_the_command_measures_draws_and_says_where(tmp_path):
    out, cache = tmp_path / "out", tmp_path / "cache"
    words = ["--quick", "--size", SIZE, "--axes", "read-noise", "--workers", 1]
    words += ["--out", out, "--cache", cache]
    said = printed(fpp_bench, "robustness", "constant", "--at", "training-mean", *words)
    assert "Constant depth: training-mean" in said
    assert fpp_bench("robustness", "constant", "--at", "1700", *words) == 0
    page = (out / "index.html").read_text(encoding="utf-8")
    assert (
        "Constant depth, 1700 mm" in page
        and "Constant depth: training-mean" in page
        and "<script" not in page
    )
    assert (out / "curves.png").read_bytes().startswith(b"\x89PNG")
    (method,) = (json.loads(file.read_text()) for file in out.glob("*mean*/read-noise.json"))
    assert [row["severity"] for row in method["views"]] == [1, 3, 5]
    assert write_page(out) == out / "index.html"
    assert "--into: needs all axes" in refusal(
        fpp_bench, "robustness", "constant", *words, "--into", "x.json"
    )


def test_the_scenes_show_the_fringes_that_an_option_asks_for(tmp_path):
    words = "fringe-net --fringes crossed --members 1 --size 256 --quick --axes gloss --no-cache"
    assert fpp_bench("robustness", *words.split(), "--workers", 1, "--out", tmp_path) == 0
    (file,) = tmp_path.glob("*/clean.json")
    (row,) = json.loads(file.read_text())["views"]
    assert row["answered_mae_mm"] < 5
