"""``fpp-bench diagnose``: reports that are whole, probes that are not run twice, models that can't
be looked into."""

import re
from copy import deepcopy

import pytest
import torch
from conftest import read_json
from tiny_network import config_of, one_thread, rounding_error, tiny_network  # noqa: F401

from fpp_ml_bench.baselines.diagnostics import probe
from fpp_ml_bench.baselines.diagnostics.grad_cam import GradCam
from fpp_ml_bench.baselines.diagnostics.linear import LinearProbing
from fpp_ml_bench.baselines.diagnostics.probe import (
    PROBES,
    Figure,
    Finding,
    ProbeResult,
    ProbeSettings,
    load_finding,
    save_finding,
    spread,
    table_of,
)
from fpp_ml_bench.baselines.diagnostics.subjects import subject
from fpp_ml_bench.baselines.training.weights import save_weights
from fpp_ml_bench.cli import main
from fpp_ml_bench.depth import object_mask
from fpp_ml_bench.errors import DiagnosisError

NETWORK = """
import torch
from torch import nn

class Net(nn.Module):
    def __init__(self, weight=None, bias=0.0):
        super().__init__()
        self.encoder = nn.Sequential(nn.Conv2d(1, 4, 3, padding=1), nn.ReLU())
        self.decoder = nn.Sequential(nn.Conv2d(4, 4, 3, padding=1), nn.ReLU())
        self.head = nn.Conv2d(4, 1, 1)
        self.unused = nn.Conv2d(4, 1, 1)
        if weight is not None:
            nn.init.constant_(self.head.weight, weight)
            nn.init.constant_(self.head.bias, bias)
    def forward(self, x):
        return self.head(self.decoder(self.encoder(x)))

class Odd(Net):
    def __init__(self, how):
        super().__init__()
        self.how = how
    def forward(self, x):
        y = super().forward(x)
        if self.how == "fails":
            return y @ 1
        return {"shape": y[:, :, ::2], "nan": y / 0 * 0, "tuple": (y, y)}[self.how]

def make(): return Net()
def silent(): return Net(0.0)
def constant(): return Net(0.0, 0.5)
def far(): return Net(0.0, 1.8)
def dead():
    net = Net()
    nn.init.zeros_(net.decoder[0].weight)
    nn.init.constant_(net.decoder[0].bias, -1.0)
    nn.init.constant_(net.head.bias, 0.5)
    return net
def nearly_nothing():
    net = Net()
    nn.init.constant_(net.head.weight, 1e-4)
    nn.init.zeros_(net.head.bias)
    return net
def beside_a_dead_layer():
    net = dead()
    net.forward = lambda x: net.head(net.decoder(net.encoder(x))) + x
    return net
def shape(): return Odd("shape")
def nan(): return Odd("nan")
def several(): return Odd("tuple")
def fails(): return Odd("fails")
def raises(): raise RuntimeError("no weights here")
def number(): return 3
"""


@pytest.fixture(scope="module")
def module_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("module") / "my_net.py"
    path.write_text(NETWORK)
    return path


def call(*arguments):
    return main(["diagnose", *map(str, arguments)])


# ---- the command


@pytest.mark.long
def test_a_module_of_the_users_is_diagnosed_and_nothing_is_run_twice(
    tiny, module_file, tmp_path, capsys, monkeypatch
):
    out = tmp_path / "report"
    arguments = (
        f"{module_file}:make",
        tiny,
        "--out",
        out,
        "--layers",
        "encoder,decoder",
        "--quick",
        "--samples",
        4,
    )
    assert call(*arguments, "--probe", "linear", "--threads", 1) == 0
    assert call(*arguments, "--probe", "grad-cam", "--threads", 1) == 0
    printed = capsys.readouterr().out
    assert "reused" in printed  # the linear probe joined the second report
    content = read_json(out / "diagnose.json")
    assert set(content["findings"]) == {"linear", "grad-cam"}
    assert content["subject"]["layers"] == ["encoder", "decoder"]
    values = content["findings"]["linear"]["values"]
    assert set(values["linear"]["trained"]) == {"encoder", "decoder"}
    assert set(values["linear"]["controls"]) == {"input", "silhouette"}
    targets = {"edges", "depth", "object_depth", "distance", "phase", "order"}
    assert set(values["linear"]["untrained"]["encoder"]) == targets
    assert set(values["four_convolutions"]["controls"]) == {"input", "silhouette"}
    layer = values["four_convolutions"]["trained"]["encoder"]
    assert layer["edges"]["r2"] == pytest.approx(
        1 - layer["edges"]["mse"] / layer["edges"]["mse_of_mean"]
    )
    page = (out / "index.html").read_text()
    assert page.count("data:image/png;base64,") == 2 and "encoder" in page
    assert not re.search(r'(?:src|href)="(?!data:|#)', page)
    assert "fpp-bench diagnose" in page and "--layers encoder,decoder" in page

    def never(*args):
        raise AssertionError("run again")

    monkeypatch.setattr(LinearProbing, "run", never)
    monkeypatch.setattr(GradCam, "run", never)
    assert call(*arguments, "--probe", "linear", "--probe", "grad-cam", "--threads", 1) == 0
    assert (out / "index.html").read_text().count("data:image/png") == 2


def test_a_method_without_a_network_says_why_layers_are_not_looked_into(tiny, tmp_path):
    out = tmp_path / "report"
    assert call("classical", tiny, "--out", out, "--probe", "linear", "--probe", "grad-cam") == 0
    content = read_json(out / "diagnose.json")
    assert all(
        "without a network" in finding["skipped"] for finding in content["findings"].values()
    )
    assert "Not run: classical is a method without a network" in (out / "index.html").read_text()


@pytest.mark.long
@pytest.mark.parametrize(
    ("network", "units", "what"),
    [
        ("silent", "mm", "background"),
        ("constant", "normalised", "0.5 of the depth range"),
        ("far", "m", "1800 mm"),
        ("nearly_nothing", "normalised", "background"),
    ],
)
def test_a_network_that_predicts_nothing_gets_a_sentence_and_no_ratio(
    tiny, module_file, tmp_path, capsys, network, units, what
):
    out = tmp_path / "report"
    assert call(f"{module_file}:{network}", tiny, "--out", out, "--units", units) == 0
    findings = read_json(out / "diagnose.json")["findings"]
    sentence = f"my_net predicts nothing but {what} on the object pixels of 6 samples."
    for name in PROBES:
        assert findings[name]["skipped"] == sentence and findings[name]["values"] == {}
    assert (out / "index.html").read_text().count(f"Not run: {sentence}") == 5
    assert "R2" not in capsys.readouterr().out


def test_layers_that_are_constant_get_a_sentence_though_the_network_predicts(
    tiny, module_file, tmp_path
):
    out = tmp_path / "report"
    model, probes = (
        f"{module_file}:beside_a_dead_layer",
        ("--probe", "linear", "--probe", "grad-cam", "--quick"),
    )
    assert call(model, tiny, "--out", out, "--layers", "decoder", "--samples", 4, *probes) == 0
    findings = read_json(out / "diagnose.json")["findings"]
    assert "every probed layer of my_net (decoder) is constant" in findings["linear"]["skipped"]
    assert (
        "the heatmaps of every layer of my_net (decoder) are constant"
        in findings["grad-cam"]["skipped"]
    )


@pytest.mark.parametrize(
    ("model", "options", "says"),
    [
        ("MINE:make", ("--probe", "gradcam"), "--probe gradcam: did you mean 'grad-cam'"),
        ("MINE:make", ("--layers", "encodr"), "has no layer 'encodr'; there are encoder"),
        (
            "MINE:make",
            ("--layers", "unused", "--probe", "linear"),
            "'unused' takes no part in a forward pass",
        ),
        ("MINE:make", ("--frame", "99"), "expected 0 to 51"),
        ("MINE:nothing", (), "has no 'nothing'"),
        (
            "MINE:shape",
            (),
            "expected an output of shape (1, 1, 176, 176), one depth per pixel, got (1, 1, 88, "
            "176)",
        ),
        ("MINE:nan", (), "30976 of 30976 values of its output are NaN"),
        ("MINE:several", (), "got tuple"),
        ("MINE:fails", (), "on fringes of shape (1, 1, 176, 176) it failed"),
        ("MINE:raises", (), "RuntimeError: no weights here"),
        ("MINE:number", (), "expected it to return a torch module, got int"),
        ("classical", ("--layers", "enc1"), "has no layers"),
        ("phase", ("--units", "mm"), "its units are known"),
    ],
)
def test_what_cannot_be_looked_into_is_refused_with_a_reason(
    tiny, module_file, tmp_path, capsys, model, options, says
):
    model = model.replace("MINE", str(module_file))
    assert call(model, tiny, "--out", tmp_path / "report", *options) == 2
    printed = capsys.readouterr().err
    assert says in printed and "Traceback" not in printed
    assert not (tmp_path / "report" / "index.html").exists()


def test_a_folder_with_something_else_in_it_is_not_written_into(
    tiny, module_file, tmp_path, capsys
):
    (tmp_path / "thesis.tex").write_text("x")
    assert call("classical", tiny, "--out", tmp_path) == 2
    assert "holds thesis.tex" in capsys.readouterr().err
    assert call("classical", tiny, "--out", tmp_path / "thesis.tex") == 2
    assert call("classical", tiny, "--out", tmp_path / "r", "--samples", 0) == 2


# ---- resuming


class Counted:
    name, title, question, version = "linear", "Counted", "How often?", 1

    def __init__(self) -> None:
        self.runs = 0

    def applies_to(self, model):
        return None

    def run(self, model, dataset, settings, progress):
        self.runs += 1
        if settings.samples == 13:
            raise KeyboardInterrupt
        return Finding("Once.", {"runs": self.runs})


@pytest.mark.long
def test_a_finding_is_kept_until_something_it_depends_on_changes(opened, tmp_path, monkeypatch):
    counted = Counted()
    monkeypatch.setattr(probe, "make_probe", lambda name: counted)
    classical, phase = subject("classical", opened), subject("phase", opened)

    def ask(model, settings):
        probe.diagnose(
            model,
            opened,
            ["linear"],
            settings,
            tmp_path / "out",
            lambda probe: lambda *progress: None,
        )
        return counted.runs

    assert ask(classical, ProbeSettings()) == 1
    assert ask(classical, ProbeSettings()) == 1
    assert ask(classical, ProbeSettings(seeds=3)) == 2
    assert ask(phase, ProbeSettings(seeds=3)) == 3
    with pytest.raises(KeyboardInterrupt):
        ask(phase, ProbeSettings(samples=13))
    assert (
        ask(phase, ProbeSettings(seeds=3)) == 4
    )  # what the stopped run did not replace is still there
    counted.version = 2
    assert ask(phase, ProbeSettings(seeds=3)) == 5


def test_findings_come_back_as_they_were_and_only_whole(tmp_path):
    finding = Finding(
        "Said.",
        {"a": [1, None], "b": {"c": 0.5}},
        table_of("T", "x", {"a": {"y": 1.5}, "b": {}}, {"y": "y"}),
        Figure("F", "alt", b"png"),
    )
    save_finding(tmp_path, "linear", "key", finding, 1.25)
    stored, seconds = load_finding(tmp_path, "linear", "key")
    assert seconds == 1.25 and stored.values == finding.values and stored.figure == finding.figure
    assert (str(stored.table.title), stored.table.titles) == ("T", ["x", "y"])
    assert stored.table.texts == [("a", "1.5"), ("b", "-")]
    assert (
        load_finding(tmp_path, "linear", "other") is None
        and load_finding(tmp_path, "absent", "key") is None
    )
    (tmp_path / "linear.png").unlink()
    assert load_finding(tmp_path, "linear", "key") is None
    (tmp_path / "linear.json").write_text('{"key": "key"')
    assert load_finding(tmp_path, "linear", "key") is None
    with pytest.raises(ValueError, match="Out of range float"):
        save_finding(tmp_path, "x", "key", Finding("", {"a": float("nan")}), 0.0)


def test_text_of_a_finding_can_only_be_text(tmp_path):
    context = {
        "subject": {
            "name": "<b>x</b>",
            "title": "t",
            "frames_used": [0],
            "direction": "both",
            "layers": [],
        },
        "dataset": {"name": "d", "fingerprint": "0" * 64, "size": [4, 4], "samples": {"test": 1}},
        "settings": {"samples": None},
        "software": {},
        "command": "fpp-bench <i>",
        "hardware": {"cpu": "c", "cores": 1},
    }
    table = table_of("<u>", "<u>", {"<script>": {"<u>2": 0.123456}, "b": {}}, {"<u>2": "<u>2"})
    counted = Counted()
    counted.title, counted.question = "<t>", "<q>?"
    page = probe.report_page(
        context, [ProbeResult(counted, Finding("<s>", table=table), 1.0, False)]
    ).decode()
    for tag in ("<b>x", "<script>", "<s>", "<t>", "<u>", "<q>", "fpp-bench <i>"):
        assert tag not in page
    assert "0.1235" in page


def test_samples_evenly():
    assert spread("abcdefgh", 3) == ["b", "e", "g"]
    assert spread("abc", None) == spread("abc", 9) == ["a", "b", "c"]


# ---- subjects


def test_a_weights_file_is_a_subject_with_the_networks_own_layers(opened, tmp_path):
    network = tiny_network("unet", width=4, seed=3)
    path = tmp_path / "net.safetensors"
    save_weights(
        path,
        network,
        config_of(network, image_size=opened.size, normalisation="raw", background_removed=True),
    )
    weights_subject = subject(str(path), opened)
    sample = opened.samples("test")[0]
    frames = weights_subject.captured(opened, sample)
    inside = object_mask(opened.depth_mm(sample))
    assert (*weights_subject.layer_names[::8],) == ("enc1", "dec1")
    assert len(weights_subject.layer_names) == 9
    assert (weights_subject.units, weights_subject.direction) == ("mm", "horizontal")
    assert weights_subject.uses_ground_truth_mask
    assert not frames[0][~inside].any() and frames[0][inside].any() and frames[1] is None
    with torch.inference_mode():
        expected = (
            deepcopy(network).double()(weights_subject.input_batch([frames]).double())[0, 0].numpy()
        )
    tolerance = rounding_error(network, expected)
    assert weights_subject.predict(frames) == pytest.approx(expected, abs=tolerance)
    same_seed, other_seed = weights_subject.untrained(3), weights_subject.untrained(4)
    assert torch.equal(
        next(same_seed.parameters()), next(network.parameters())
    )  # seed 3 is what made the network
    assert not torch.equal(next(other_seed.parameters()), next(same_seed.parameters()))
    assert list(weights_subject.layers_of(other_seed)) == list(weights_subject.layer_names)
    two_layers = subject(str(path), opened, layers=["dec1", "enc1"])
    assert (
        two_layers.layer_names == ("enc1", "dec1") and two_layers.sha256 == weights_subject.sha256
    )
    with pytest.raises(DiagnosisError, match="no network"):
        subject("classical", opened).networks()


def test_units_of_a_users_module_turn_its_output_into_mm(opened, module_file):
    frames = opened.frames(opened.samples("test")[0], range(1))
    normalised, metres, mm = (
        subject(f"{module_file}:make", opened, units=units) for units in ("normalised", "m", "mm")
    )
    assert (normalised.units, metres.units, mm.units) == ("normalised", "mm", "mm")
    expected = mm.predict(frames)
    tolerance = rounding_error(mm.network, expected)
    assert metres.predict(frames) == pytest.approx(1000 * expected, abs=1000 * tolerance)
    assert normalised.predict(frames) == pytest.approx(expected, abs=tolerance)
    assert len({module_subject.sha256 for module_subject in (normalised, metres, mm)}) == 3
    assert (
        subject(f"{module_file}:make", opened, units="mm").sha256 == mm.sha256
    )  # drawn weights are the same every time
    assert mm.layer_names == ("encoder", "decoder", "head", "unused")
    assert subject(f"{module_file}:make", opened, layers=["decoder.0"]).layer_names == (
        "decoder.0",
    )
