"""Finding methods: of this package, of an installed package, of a file, and by weights; and what is
refused."""

import sys
from importlib import metadata
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from fpp_ml_bench.baselines import registry
from fpp_ml_bench.baselines.method import Method
from fpp_ml_bench.baselines.registry import find, load_method, methods
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.options import described, options_of

RIG = paper_rig(224)
MINE = """
from dataclasses import dataclass

import numpy as np
from fpp_ml_bench import Method
from fpp_ml_bench.options import option


@dataclass(frozen=True)
class Options:
    depth: float = option(1500.0, "depth of what is lit", "MM")


class Mine(Method):
    name, title, frames_used, Options = "mine", "Everything lit is near", (0,), Options

    def predict(self, frames):
        return np.where(frames[0] > 60, np.float32(self.options.depth), np.float32(0))


class Half(Method):
    name, title, frames_used = "half", "No prediction", (0,)


here = 3
"""


UNHEARD = """
from fpp_ml_bench.baselines.phase.method import PhaseMethod
class Unheard(PhaseMethod):
    def predict(self, frames):
        return super().predict(frames) + 1
"""
FIXED = """
class Fixed(Mine):
    settings = property(lambda self: {})
    def __init__(self, rig):
        pass
"""


@pytest.fixture
def mine(tmp_path: Path) -> str:
    (tmp_path / "mine.py").write_text(MINE)
    return str(tmp_path / "mine.py")


def test_a_method_of_a_file_with_its_options(mine):
    method = load_method(f"{mine}:Mine", RIG, depth=900.0)
    source = method.settings["source_sha256"]
    assert (method.name, method.settings) == ("mine", {"depth": 900.0, "source_sha256": source})
    assert method.learned_from is None  # its author has not said it
    frame = np.full((224, 224), 61, np.uint8)
    assert (method.predict([frame]) == 900).all()
    found = find(f"{mine}:Mine")
    assert found is not find(f"{mine}:Mine") and found.method is find(f"{mine}:Mine").method
    (depth,) = options_of(found.method.Options)
    assert (depth.name, described(depth).metavar) == ("depth", "MM")
    with pytest.raises(PredictionError, match=r"mine: has no option dept; did you mean 'depth'\?"):
        load_method(f"{mine}:Mine", RIG, dept=1.0)


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("mine.py:Min", r"mine.py: has no 'Min'; did you mean 'Mine'\?"),
        ("mine.py:Half", "does not define predict"),
        ("unheard.py:Unheard", "answers without its predict; define answer instead"),
        ("fixed.py:Fixed", "settings is read only"),
        ("mine.py:here", "expected a subclass of fpp_ml_bench.Method, got int"),
        ("none.py:Mine", "none.py: no such file"),
        (
            "broken.py:Mine",
            r"broken.py: importing it failed: ZeroDivisionError: division by zero \(line 1\)",
        ),
        ("untitled.py:Mine", "has no title, which a method needs"),
        ("spaces.py:Mine", "its name is 'a b'; expected text without spaces"),
    ],
)
def test_files_that_hold_no_method(mine, name, says):
    folder = Path(mine).parent
    (folder / "broken.py").write_text("1 / 0\n")
    (folder / "unheard.py").write_text(UNHEARD)
    (folder / "fixed.py").write_text(MINE + FIXED)
    (folder / "untitled.py").write_text(MINE.replace("name, title, ", "name, other, "))
    (folder / "spaces.py").write_text(MINE.replace('"mine"', '"a b"'))
    with pytest.raises(PredictionError, match=says):
        load_method(str(folder / name), RIG)


def test_the_code_of_a_file_is_it_its_helpers_and_its_weights(mine, monkeypatch):
    folder = Path(mine).parent
    (folder / "nets").mkdir()
    (folder / "nets" / "block.py").write_text("SIZE = 3\n")
    (folder / "helper_of_mine.py").write_text(
        "from nets.block import SIZE\nimport json\nWEIGHTS = 'own.npz'\n"
    )
    (folder / "own.npz").write_bytes(b"1")
    (folder / "mine.py").write_text(f"import helper_of_mine\n{MINE}")
    (folder / "unused.py").write_text("")
    monkeypatch.delitem(sys.modules, "helper_of_mine", raising=False)
    find(f"{mine}:Mine")
    first = registry.code_in.__wrapped__(Path(mine))
    assert list(first) == ["helper_of_mine.py", "mine.py", "nets/block.py", "own.npz"]
    for name in first:
        before = (folder / name).read_bytes()
        (folder / name).write_bytes(before + b"\n")
        changed = registry.code_in.__wrapped__(Path(mine))
        assert [key for key in first if first[key] != changed[key]] == [name]
        (folder / name).write_bytes(before)
    (folder / "unused.py").write_text("2")
    assert registry.code_in.__wrapped__(Path(mine)) == first


def test_the_code_and_the_files_of_options_are_settings(mine, tmp_path):
    first = load_method(f"{mine}:Mine", RIG).settings["source_sha256"]
    (tmp_path / "again").mkdir()
    (tmp_path / "again" / "mine.py").write_text(MINE)
    again = load_method(tmp_path / "again" / "mine.py:Mine", RIG)
    assert again.settings["source_sha256"] == first and list(again.code) == [
        "mine.py"
    ]  # wherever it lies
    (tmp_path / "again" / "more.py").write_text(MINE + "class Other(Mine):\n    pass\n")
    classes = [
        load_method(tmp_path / "again" / f"more.py:{name}", RIG) for name in ("Mine", "Other")
    ]
    assert len({first, *(method.settings["source_sha256"] for method in classes)}) == 3
    mask = tmp_path / "mask.png"
    masks = []
    for value in (1, 255):
        Image.fromarray(np.full((224, 224), value, np.uint8)).save(mask)
        masks.append(load_method("phase", RIG, mask=mask).settings["mask_sha256"])
    assert masks[0] != masks[1]
    assert not load_method("phase", RIG).settings.keys() & {"source_sha256", "mask_sha256"}


STATED = """
class Stated(Mine):
    learned_from = {"data": "other", "versions": ["my scans"]}
    packages = ("numpy", "scipy")
"""


def test_what_a_file_does_not_say_is_unknown(mine, tmp_path):
    (tmp_path / "stated.py").write_text(
        f"import cv2\nfrom fpp_ml_bench.baselines.phase.method import PhaseMethod\n{MINE}"
        f"{STATED}class Trained(PhaseMethod):\n    name = 'trained'\n"
    )
    silent, stated, trained = (
        load_method(tmp_path / f"stated.py:{n}", RIG) for n in ("Mine", "Stated", "Trained")
    )
    assert silent.learned_from is None and trained.learned_from is None  # whatever it inherits from
    assert stated.learned_from == {"data": "other", "versions": ["my scans"]}
    assert {"numpy", "cv2"} <= silent.software.keys() and {"scipy", "cv2"} <= stated.software.keys()
    assert load_method("phase", RIG).software.keys() == {"fpp_ml_bench", "python", "numpy", "numba"}


def test_a_file_without_its_class_is_told_what_there_is(mine):
    with pytest.raises(
        PredictionError, match=r"mine.py:NAME, which says what of it; there are .*Mine"
    ):
        find(mine)


def test_where_code_of_a_file_failed(mine):
    method = load_method(f"{mine}:Mine", RIG)
    with pytest.raises(IndexError) as caught:
        method.predict([])
    assert f"{mine}, line 18, in predict: IndexError" in str(registry.failure_in_file(caught.value))
    with pytest.raises(KeyError) as elsewhere:
        {}["a"]
    assert registry.failure_in_file(elsewhere.value) is None


class Installed(Method):
    name, title, frames_used = "installed", "Of a package", (0,)

    def predict(self, frames):
        return np.zeros(frames[0].shape, np.float32)


class Taken(Installed):
    name = "phase"


def test_methods_of_installed_packages(monkeypatch):
    """By the entry point group; one that can't be used does no harm until it is asked for."""
    dist = SimpleNamespace(name="strangers")

    def entry(name, load):
        return SimpleNamespace(name=name, value=f"strangers:{name}", dist=dist, load=load)

    def offered(group: str) -> list[SimpleNamespace]:
        assert group == "fpp_ml_bench.methods"
        broken = entry("broken", lambda: 1 / 0)
        return [
            entry("one", lambda: Installed),
            entry("taken", lambda: Taken),
            broken,
            entry("no", lambda: 3),
        ]

    monkeypatch.setattr(metadata, "entry_points", offered)
    registry._installed.cache_clear()
    try:
        assert [*methods()][-2:] == ["nearest", "installed"]
        assert load_method("installed", RIG).title == "Of a package"
        assert load_method("phase", RIG).title.startswith("Phase route")
        for name, says in (
            ("broken", "ZeroDivisionError"),
            ("taken", "name 'phase' is taken"),
            ("no", "got int"),
        ):
            with pytest.raises(PredictionError, match=says):
                find(name)
    finally:
        registry._installed.cache_clear()


def test_a_name_that_is_almost_right():
    with pytest.raises(
        PredictionError, match=r"unknown method 'fringe-nte'; did you mean 'fringe-net'\?"
    ):
        find("fringe-nte")
    with pytest.raises(PredictionError, match="there are classical, phase, crossed, fringe-net"):
        find("something else")


@pytest.mark.parametrize("method", methods().values(), ids=str)
def test_a_method_says_what_it_needs_to(method):
    """One line for ``--help``, and help for each option; no option that its class does not take."""
    assert method.purpose and method.name
    for options in filter(None, (method.Options, method.Training)):
        assert all(described(entry).help for entry in options_of(options))
    assert all(
        set(options) <= set(method.Options.__dataclass_fields__) for options in method.variants(RIG)
    )
