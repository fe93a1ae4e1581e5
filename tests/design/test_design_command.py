"""``fpp-bench patterns --design``: the table, the rig file and the picture it writes, and what it
refuses."""

import pytest

from fpp_ml_bench.cli import main
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.optics.rig_file import load_rig, rig_from_dict, save_rig


def call(*arguments):
    return main(["patterns", *map(str, arguments), "--design"])


def test_a_rig_gets_the_proposed_pair(tmp_path, capsys):
    written, picture = tmp_path / "crossed.yaml", tmp_path / "design.png"
    assert (
        call(
            "paper", "--pitches", "9-20", "--pair", "18,14", "--out", written, "--picture", picture
        )
        == 0
    )
    said = capsys.readouterr().out
    assert (
        "39 degrees runs along the epipolar lines" in said
        and "asked for" in said
        and "its pair" in said
    )
    assert (
        "18 / 14" in said
        and "0.71" in said
        and "0.98" in said
        and picture.read_bytes().startswith(b"\x89PNG")
    )
    rig = load_rig(written)
    assert len(rig.crossed) == 3 and len(rig.sequence) == 55
    (first, second), (first_deg, second_deg) = rig.crossed.pitches_px, rig.crossed.angles_deg
    assert (
        f"proposed        {first:g} / {second:g} px at {first_deg:g} / {second_deg:g} degrees"
        in said
    )
    assert call(written) == 0
    assert "its crossed" in capsys.readouterr().out


def test_a_rig_of_one_direction_keeps_its_code(tmp_path, capsys):
    data = {**paper_rig(480).to_dict(), "translation_m": [0.16, 0.0, 0.0], "background_m": None}
    del data["pitch_px"]
    wave = {"scheme": "phase-shift", "pitches_px": [114, 912], "steps": 3}
    save_rig(rig_from_dict({**data, "sequence": {"vertical": wave}}), tmp_path / "rig.yaml")
    written = tmp_path / "crossed.yaml"
    assert call(tmp_path / "rig.yaml", "--pair", "30,30", "--out", written) == 0
    said = capsys.readouterr().out
    assert (
        "a carrier at 0 degrees runs along" in said
        and "the carrier of 30 px at 0 degrees tells no depth" in said
    )
    assert load_rig(written).sequence.order == ("crossed", "vertical") and load_rig(
        written
    ).directions == ("vertical",)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["paper", "--pitches", "x"], "expected numbers such as 12,14,18"),
        (["paper", "--pitches", "2-3"], "none of 2 periods covers 6 to 40 px"),
        (["paper", "--pair", "18"], "two periods, or two periods and two angles"),
        (["paper", "--pair", "18,14,30,31"], "parallel"),
        (["paper", "--image-px", "40,10"], "LEAST,MOST"),
        (["paper", "--phase-error", "0"], "expected a number above 0"),
        (["paper", "--surfaces", "1000,1900"], "a part of the working range"),
        (["paper", "--out", "rig.txt"], "expected a rig file ending in"),
    ],
)
def test_bad_input_exits_2_with_a_message(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert call(*arguments) == 2
    assert message in capsys.readouterr().err and not list(tmp_path.iterdir())
