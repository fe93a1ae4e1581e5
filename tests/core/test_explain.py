"""``--explain`` counts agree with the data, and skipping changes no result."""

from dataclasses import replace

import pytest
from conftest import (
    TINY_SIZE,
    file_bytes,
    fpp_bench,
    fpp_eval,
    printed,
    read_json,
    refusal,
    tiny_settings,
)

from fpp_ml_bench.cli.console import explanation_table, show
from fpp_ml_bench.errors import BuildError
from fpp_ml_bench.loaders.render.builder import explain_build
from fpp_ml_bench.loaders.render.light import named_light
from fpp_ml_bench.loaders.storage.store import DatasetFolder
from fpp_ml_bench.skipping import SWITCH, Explanation, LeftOut, explained, skipping

PIXELS = TINY_SIZE**2


@pytest.fixture(autouse=True)
def _switch(monkeypatch):
    monkeypatch.delenv(SWITCH, raising=False)


def lines_of(account):
    return {line["what"]: line for line in account["left_out"]}


def test_the_account_adds_up_and_drops_lines_with_nothing_left_out():
    rays = LeftOut("rays", "rays", 10, 30, 7)
    explanation = explained("build", "nothing", [rays, LeftOut("more", "frames", 5, 0)])
    assert explanation == Explanation("build", "nothing", (rays,), True) and rays.share == 0.75
    content = explanation.to_dict()
    assert content["bytes_saved"] == 7 and content["left_out"][0]["share"] == 0.75
    with skipping(False):
        assert not explained("build", "nothing", [rays]).skipping


@pytest.mark.long
def test_build_and_its_account(tmp_path):
    line = f"build --size {TINY_SIZE} --objects cork --config single_shot --workers 1"
    said = printed(fpp_bench, line, f"--out {tmp_path}/on --explain-json {tmp_path}/account.json")
    assert "left out" in said
    with skipping(False):
        assert fpp_bench(line, f"--out {tmp_path}/off") == 0
    assert file_bytes(tmp_path / "on") == file_bytes(tmp_path / "off")
    content = read_json(tmp_path / "account.json")
    lines = lines_of(content)
    rows = DatasetFolder(tmp_path / "on").manifest.samples["train"]
    assert content["skipping"] and len(rows) == 6
    background = lines["empty background again, in one process"]
    assert (background["done"], background["left_out"]) == (PIXELS, 5 * PIXELS)
    truth = lines["ground truth off the object"]
    assert truth["left_out"] == 50 * sum(PIXELS - row["exact_px"] for row in rows)
    frames = lines["frames not asked for"]
    assert (frames["done"], frames["left_out"], frames["bytes_saved"]) == (6, 306, 306 * PIXELS)
    exposures = lines["exposures that nothing reads"]
    assert exposures["done"] + exposures["left_out"] == 6 * 52 * PIXELS


def test_under_a_lens_that_blurs_only_black_and_white_are_not_exposed(opened):
    settings = tiny_settings(
        stored="single_shot", light=named_light("paper").changed("camera", blur_px=0.5)
    )
    account = explain_build(opened.manifest, settings)
    exposures = next(line for line in account.lines if line.what == "exposures that nothing reads")
    assert (exposures.done, exposures.left_out) == (24 * 50 * PIXELS, 24 * 2 * PIXELS)


def test_an_object_that_moves_is_lit_and_exposed_in_each_frame(opened):
    light = named_light("paper").changed("bounces", shadows=True).changed("camera", rays_across=1)
    part = [
        {**row, "shadow_rays": 8 * PIXELS, "mixed_rays": 0}
        for row in opened.manifest.samples["test"]
    ]
    settings = tiny_settings(stored="single_shot", light=light.changed(motion_mm=0.2))
    account = explain_build(replace(opened.manifest, samples={"test": part}), settings)
    lines = {line.what: (line.done, line.left_out) for line in account.lines}
    assert lines["shadow rays past the object's box"] == (6 * 8 * PIXELS, 6 * 42 * PIXELS)
    assert lines["exposures that nothing reads"] == (6 * 50 * PIXELS, 6 * 2 * PIXELS)
    assert "rays across pixels that see one surface" not in lines  # there is one ray a pixel


def test_the_table_shows_all_counts_in_a_pipe(opened, monkeypatch, capsys):
    monkeypatch.delenv("COLUMNS", raising=False)
    show(explanation_table(explain_build(opened.manifest, tiny_settings())))
    printed = capsys.readouterr().out
    assert "share" in printed and "bytes" in printed and "A wider terminal" not in printed


def test_a_dataset_of_an_earlier_version_is_refused_in_words(opened):
    rows = [
        {key: value for key, value in row.items() if key != "mixed_rays"}
        for row in opened.manifest.samples["test"]
    ]
    generator = {"name": "fpp-ml-bench", "version": "0.1.0"}
    with pytest.raises(BuildError, match=r"built by version 0\.1\.0 .* build it again"):
        explain_build(
            replace(opened.manifest, samples={"test": rows}, generator=generator), tiny_settings()
        )


@pytest.mark.long
def test_predictions_scores_and_their_accounts(tiny, tmp_path):
    account = tmp_path / "account.json"
    explain = f"--explain-json {account}"
    predict = f"predict classical {tiny} --steps 4 --out {tmp_path}"
    with skipping(True):
        assert fpp_bench(f"{predict}/on {explain}") == 0
    with skipping(False):
        assert fpp_bench(f"{predict}/off") == 0
    skipped, complete = file_bytes(tmp_path / "on"), file_bytes(tmp_path / "off")
    assert len(skipped) == 6 * 2 + 1
    assert all(skipped[name] == complete[name] for name in skipped if name.endswith(".npy"))
    lines = lines_of(read_json(account))
    frames = lines["frames that the method does not use"]
    counts = frames["done"], frames["left_out"], frames["bytes_saved"]
    assert counts == (6 * 22, 6 * 30, 180 * PIXELS)
    second = lines["second direction where the first shows no object"]
    rows = DatasetFolder(tiny).manifest.samples["test"]
    object_px = sum(row["object_px"] for row in rows)
    assert 0.98 * object_px < second["done"] < 1.05 * object_px
    assert second["done"] + second["left_out"] == 6 * PIXELS
    scores = []
    for enabled in (True, False):
        with skipping(enabled):
            words = f"--json {tmp_path}/result.json {explain if enabled else ''}"
            assert fpp_eval(tmp_path / "on", tiny, words) == 0
        scores.append(read_json(tmp_path / "result.json") | {"created": None})
    assert scores[0] == scores[1]
    lines = lines_of(read_json(account))
    columns = lines["columns that no score needs"]
    counts = columns["done"], columns["left_out"], columns["bytes_saved"]
    assert counts == (6, 6 * 53, 6 * PIXELS * (52 + 4))
    assert lines["depth edges far from the object"]["done"] > object_px


def test_the_phase_route_is_counted_by_its_crop(tiny, tmp_path):
    account = tmp_path / "account.json"
    assert fpp_bench(f"predict phase {tiny} --out {tmp_path}/p --explain-json {account}") == 0
    lines = lines_of(read_json(account))
    line = lines["local fits and orders far from the object"]
    assert line["done"] + line["left_out"] == 6 * PIXELS and 0.1 < line["share"] < 0.95
    assert lines["frames that the method does not use"]["left_out"] == 6 * 51


def test_an_account_that_cannot_be_written_is_refused_before_any_work(tiny, tmp_path):
    words = f"--out {tmp_path}/p --explain-json {tmp_path}/none/a.json"
    assert "--explain-json" in refusal(fpp_bench, "predict classical", tiny, words)
    assert not (tmp_path / "p").exists()


def test_data_that_was_not_generated_has_no_account(opened):
    with pytest.raises(ValueError, match="generated"):
        explain_build(replace(opened.manifest, origin="published"), None)
