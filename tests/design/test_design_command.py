"""``fpp-bench patterns --design``: the table, the rig file and the picture it writes, and what it
refuses."""

import pytest
from captures import rig_with
from conftest import fpp_bench, printed, refusal

from fpp_ml_bench.optics.rig_file import load_rig, save_rig


@pytest.mark.long
def test_a_rig_gets_the_proposed_pair(tmp_path):
    written, picture = tmp_path / "crossed.yaml", tmp_path / "design.png"
    words = f"--pitches 9-20 --pair 18,14 --out {written} --picture {picture}"
    said = printed(fpp_bench, "patterns paper --design", words)
    for words in (
        "39 degrees runs along the epipolar lines",
        "asked for",
        "its pair",
        "18 / 14",
        "0.71",
        "0.98",
    ):
        assert words in said
    assert picture.read_bytes().startswith(b"\x89PNG")
    rig = load_rig(written)
    assert len(rig.crossed) == 3 and len(rig.sequence) == 55
    (first, second), (first_deg, second_deg) = rig.crossed.pitches_px, rig.crossed.angles_deg
    proposed = f"{first:g} / {second:g} px at {first_deg:g} / {second_deg:g} degrees"
    assert f"proposed        {proposed}" in said
    assert "its crossed" in printed(fpp_bench, "patterns --design", written)


@pytest.mark.long
def test_a_rig_of_one_direction_keeps_its_code(tmp_path):
    wave = {"scheme": "phase-shift", "pitches_px": [114, 912], "steps": 3}
    rig = rig_with({"vertical": wave}, 480, translation_m=[0.16, 0.0, 0.0], background_m=None)
    save_rig(rig, tmp_path / "rig.yaml")
    line = f"patterns {tmp_path}/rig.yaml --design --pair 30,30 --out {tmp_path}/crossed.yaml"
    said = printed(fpp_bench, line)
    assert "a carrier at 0 degrees runs along" in said
    assert "the carrier of 30 px at 0 degrees tells no depth" in said
    written = load_rig(tmp_path / "crossed.yaml")
    assert written.sequence.order == ("crossed", "vertical")
    assert written.directions == ("vertical",)


@pytest.mark.long
@pytest.mark.parametrize(
    "words, message",
    [
        ("--pitches x", "expected numbers such as 12,14,18"),
        ("--pitches 2-3", "none of 2 periods covers 6 to 40 px"),
        ("--pair 18", "two periods, or two periods and two angles"),
        ("--pair 18,14,30,31", "parallel"),
        ("--image-px 40,10", "LEAST,MOST"),
        ("--phase-error 0", "expected a number above 0"),
        ("--surfaces 1000,1900", "a part of the working range"),
        ("--out rig.txt", "expected a rig file ending in"),
    ],
)
def test_bad_input_exits_2_with_a_message(tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    assert message in refusal(fpp_bench, "patterns paper --design", words)
    assert not list(tmp_path.iterdir())
