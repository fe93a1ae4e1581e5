"""The static page as files: the same bytes, no way out of it, and nothing that a submission's text
could do."""

import html
import re
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scored_dataset
from board_rows import changed, named_benchmarks, timing, write_result_file
from conftest import file_bytes, fpp_bench, read_json, refusal
from hypothesis import given, settings
from hypothesis import strategies as st
from scored_dataset import make_dataset

from fpp_ml_bench.baselines.tradeoff.report import Mark, Scatter
from fpp_ml_bench.cli import leaderboard as leaderboard_command
from fpp_ml_bench.evaluation.metrics import RANK_KEY
from fpp_ml_bench.evaluation.report.report_page import write_report
from fpp_ml_bench.evaluation.result.file import parse_result, write_result
from fpp_ml_bench.evaluation.score.evaluator import evaluate
from fpp_ml_bench.leaderboard.page.page import (
    LogScale,
    overview,
    page_files,
    predicted_samples,
    slug,
)
from fpp_ml_bench.leaderboard.ranking import expand, rank, read_entries
from fpp_ml_bench.leaderboard.tables import chosen_tables
from fpp_ml_bench.optics.named_rigs import paper_rig
from fpp_ml_bench.style import escaped, page

pytestmark = pytest.mark.long


class Parsed(HTMLParser):
    """Elements with their attributes, and the visible text."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, {key: value or "" for key, value in attrs}))

    def handle_data(self, data):
        self.text += data


def pages(paths) -> dict[str, bytes]:
    return page_files(rank(read_entries(expand(paths))), chosen_tables(None))


def test_same_rows_same_bytes_whatever_their_order(files, tmp_path):
    assert pages(files) == pages(files[::-1])
    assert fpp_bench("leaderboard", *files, "--page", tmp_path / "page") == 0
    assert file_bytes(tmp_path / "page") == pages(files) and len(pages(files)) == 3 + len(files)


def test_a_page_ranks_once(files, tmp_path, monkeypatch):
    ranked = []
    monkeypatch.setattr(
        leaderboard_command, "rank_files", lambda *given: ranked.append(given) or rank(*given)
    )
    assert fpp_bench("leaderboard", *files, "--page", tmp_path, "--csv", tmp_path / "t.csv") == 0
    assert len(ranked) == 1
    words = ["leaderboard", *files, "--page", tmp_path, "--sort", "object_rmse_mm"]
    assert "leave out --sort" in refusal(fpp_bench, *words) and len(ranked) == 1


def test_pages_of_rows_that_left_are_removed_and_nothing_else_is(files, tmp_path):
    out = tmp_path / "page"
    assert fpp_bench("leaderboard", *files, "--page", out) == 0
    (out / "submissions" / "notes.html").write_text("mine")
    (out / "CNAME").write_text("example.org")
    assert fpp_bench("leaderboard", files[0], "--page", out) == 0
    remaining = sorted(path.name for path in (out / "submissions").iterdir())
    assert len(remaining) == 2 and "notes.html" in remaining and (out / "CNAME").exists()


def test_groups_stay_apart_and_the_papers_rows_too(files):
    index = pages(files)["index.html"].decode()
    metric, oracle = re.findall(
        r'<section id="[a-z0-9-]+" class="board">.*?</section>', index, flags=re.DOTALL
    )
    assert "Was told" in oracle and "Was told" not in metric and "Fast and rough" not in oracle
    assert "were given the test sample's depth range" in html.unescape(oracle)
    reported = html.unescape(index[index.index("<h2>Reported by others</h2>") :])
    row = re.search(r'<th scope="row">UNet</th>.*?</tr>', reported, re.DOTALL)
    assert re.findall(r"<td[^>]*>(.*?)</td>", row[0])[2:5] == ["14.54", "17.88", "3.31"]
    assert (
        "Other data, not ranked with the rows above" in reported
        and "reported by the paper" in index
    )
    assert "TransUNet" not in metric + oracle


def test_front_is_those_nobody_beats(files):
    groups = rank(read_entries(files))
    for cost in ("seconds", "frames"):
        picture = overview(groups, cost)
        assert [mark.name for mark in picture.front] == ["Fast and rough", "Slow and fine"]
        assert len(picture.marks) == 4  # the row that was told is drawn, and leads no front


def test_links_lead_to_the_page_and_nowhere_else(files):
    written = pages(files)
    for name, content in written.items():
        if not name.endswith(".html"):
            continue
        parsed = Parsed(content.decode())
        ids = {attributes.get("id") for _, attributes in parsed.elements}
        for tag, attributes in parsed.elements:
            assert not any(key.startswith("on") or key == "style" for key in attributes), (
                name,
                tag,
                attributes,
            )
            for key in ("href", "src"):
                address = attributes.get(key, "#main")
                if address.startswith("#"):
                    assert address[1:] in ids, (name, address)
                elif not address.startswith("data:"):
                    target = str(
                        Path("/", name).parent.joinpath(address).resolve().relative_to("/")
                    )
                    assert target in written, (name, address)
        policy = next(a["content"] for t, a in parsed.elements if t == "meta" and "http-equiv" in a)
        assert "default-src 'none'" in policy and "unsafe" not in policy and "http" not in policy


def test_tables_are_tables(files):
    parsed = Parsed(pages(files)["index.html"].decode())
    heads = [attributes for tag, attributes in parsed.elements if tag == "th"]
    assert heads and all(attributes.get("scope") in ("col", "row") for attributes in heads)
    sorted_by = [attributes["aria-sort"] for attributes in heads if "aria-sort" in attributes]
    assert sorted_by == ["ascending"] * 2  # a table for each group, by object MAE
    assert {"main", "nav"} <= {tag for tag, _ in parsed.elements}


HOSTILE = [
    "<script>hacked = 1</script>",
    "</script><script>hacked = 1</script>",
    '"><img src=x onerror=hacked=1>',
    "' onmouseover='hacked=1",
    "--><svg/onload=hacked=1>",
    "javascript:hacked=1",
    "../../../etc/passwd",
    "{{7*7}}${7*7}<%= 7 %>",
    "]]></style><style>*{display:none}",
    "&lt;b&gt; &amp; </title>",
    "مرحبا \N{GREEK SMALL LETTER MU}m 漢字",
]


@pytest.mark.parametrize("name", HOSTILE)
def test_a_name_is_only_a_name(name, dataset, tmp_path, files):
    def pages_with(text):
        hardware = {"cpu": text, "cores": 1, "memory_gib": 1.0, "gpu": text, "platform": text}
        path = write_result_file(
            tmp_path / "x.json",
            dataset,
            1.0,
            name=text,
            method=text,
            settings={text[:50]: text},
            timing=timing(3.0, hardware=hardware),
        )
        return pages([path, files[0]])

    written, expected = pages_with(name), pages_with("p" * len(name))
    for file in written:
        assert re.fullmatch(
            r"index\.html|data\.json|data\.csv|submissions/[a-z0-9-]+-[0-9a-f]{12}\.html", file
        )
    index, plain = Parsed(written["index.html"].decode()), Parsed(expected["index.html"].decode())
    assert [tag for tag, _ in index.elements] == [tag for tag, _ in plain.elements]
    assert [tuple(attributes) for _, attributes in index.elements] == [
        tuple(a) for _, a in plain.elements
    ]
    assert name in index.text
    for file, content in written.items():
        if file.startswith("submissions/"):
            assert not any(tag == "script" for tag, _ in Parsed(content.decode()).elements)


def test_escaping_holds_without_the_checks_before_it():
    assert escaped("\x1b[31m<b>\u202e") == "\\x1b[31m&lt;b&gt;\\u202e"
    assert len(escaped("<" * 10_000_000)) < 1000
    assert (
        "<title>&lt;/title&gt;</title>" in page("fpp_ml_bench", "parts.html", "</title>").decode()
    )


def test_a_slug_is_a_file_name_of_its_own(files):
    entry = read_entries(files[:1])[0]
    earlier = changed(entry, created="2020-01-01T00:00:00+00:00")
    assert re.fullmatch(r"fast-and-rough-[0-9a-f]{12}", slug(entry)) and slug(entry) != slug(
        earlier
    )


@st.composite
def drawings(draw):
    """Marks as far apart, as close together and as equal as they come, with and without intervals
    and names."""
    value = st.floats(1e-9, 1e9) | st.sampled_from([1.0, 1.01, 2.0])
    marks = []
    for number in range(1, draw(st.integers(1, 15)) + 1):
        x, y = draw(value), draw(value)
        span = (0.0, y * 1.5) if draw(st.booleans()) else None
        name = "x" * draw(st.integers(1, 36))
        marks.append(Mark(x, y, number, name, "verified", y_span=span))
    return Scatter(marks, "a cost", names=draw(st.booleans()))


@given(drawings(), st.sampled_from([(360, 380), (860, 430)]))
@settings(max_examples=25, deadline=None)
def test_every_mark_has_a_place_and_every_number_an_explanation(picture, size):
    svg = picture.svg(*size, "wide scatter", "A picture")
    parsed = Parsed(svg)
    assert [tag for tag, _ in parsed.elements].count("use") >= len(picture.marks)
    for tag, attributes in parsed.elements:
        assert "style" not in attributes and (
            tag != "use" or -1 <= float(attributes["x"]) <= size[0]
        )
    labels = [
        (number, name) for name, number in re.findall(r'<g class="name">.*?>(x+|(\d+))</text>', svg)
    ]
    numbers = [number for number, _ in labels if number]
    assert len(set(numbers)) == len(numbers)
    assert set(numbers) <= {str(mark.number) for mark in picture.marks}
    shown_names = {name for number, name in labels if not number}
    assert shown_names <= {mark.name for mark in picture.marks} and (
        picture.names or not shown_names
    )
    assert picture.svg(*size, "wide scatter", "A picture") == svg


def test_hostile_names_are_text_in_a_picture():
    """Also what matplotlib would take for mathematics, and what looks like an attribute that is
    rewritten."""
    names = [*HOSTILE, "$x^2$ and \\frac", 'x style="fill: #191c20" id="mark-1"']
    marks = [
        Mark(10.0**n, 10.0**-n, n, name, "verified", title=name, row=name)
        for n, name in enumerate(names)
    ]
    svg = Scatter(marks, "a cost").svg(3000, 2000, "wide scatter", "A picture")
    parsed = Parsed(svg)
    assert all(parsed.text.count(name) >= 2 for name in names)  # label and tooltip
    assert {tag for tag, _ in parsed.elements} == {
        "svg",
        "g",
        "path",
        "defs",
        "use",
        "text",
        "title",
    }
    assert not any(key.startswith("on") for _, attributes in parsed.elements for key in attributes)


def test_empty_board_says_how_to_begin(tmp_path, monkeypatch):
    from fpp_ml_bench.leaderboard import rows

    monkeypatch.setattr(rows, "SHIPPED_ROWS", tmp_path / "none")
    assert fpp_bench("leaderboard", "--page", tmp_path / "page") == 0
    assert "No submission yet" in (tmp_path / "page" / "index.html").read_text()


def test_unwritable_page_is_an_error(files, tmp_path):
    (tmp_path / "file").write_text("")
    assert "file: is a file; give a folder" in refusal(
        fpp_bench, "leaderboard", files[0], "--page", tmp_path / "file"
    )


@pytest.fixture
def predicted(tmp_path, monkeypatch):
    """A dataset with a camera of its size, predictions that say what they are of, and their
    result."""
    monkeypatch.setattr(scored_dataset, "paper_rig", lambda _: paper_rig(48))
    dataset = make_dataset(tmp_path / "data", (48, 48))
    source = {"dataset": str(dataset.path), "split": "test", "content": dict(dataset.content)}
    result = write_result_file(tmp_path / "mine.json", dataset, 2.0, 1.0, predicted=source)
    return dataset, tmp_path / "mine-predictions", result


def test_a_rows_page_shows_its_predictions(predicted, files, tmp_path):
    dataset, folder, result = predicted
    out = tmp_path / "page"
    command = ["leaderboard", str(result), str(files[0]), "--page", str(out)]
    assert fpp_bench(*command, "--predictions", folder) == 0
    mine = {path.name: path.read_text() for path in (out / "submissions").glob("a-method-*")}
    (name,) = (name for name in mine if not name.endswith("-cloud.html"))
    cloud = name.replace(".html", "-cloud.html")
    assert set(mine) == {name, cloud} and f'href="{cloud}"' in mine[name]
    assert "A method: " in mine[cloud] and "points in mm" in mine[cloud]
    report = write_report(
        parse_result(read_json(result), result), dataset, folder, tmp_path / "report"
    )
    pictures = re.findall(r'<img [^>]*src="(data:image/png;base64,[^"]+)"', mine[name])
    assert len(set(pictures)) == 2 and all(picture in report.read_text() for picture in pictures)
    assert (
        "Median: " in mine[name]
        and "Worst: " in mine[name]
        and "Signed error: blue is too near" in mine[name]
    )
    assert fpp_bench(*command) == 0  # without predictions, there are no pictures and no cloud
    (left,) = (out / "submissions").glob("a-method-*")
    assert "<img" not in left.read_text()


def test_predictions_that_no_result_is_of_are_refused(predicted, files, tmp_path):
    dataset, folder, result = predicted
    page_of = ["--page", str(tmp_path / "page"), "--predictions", str(folder)]
    row = tmp_path / "row.json"
    assert fpp_bench("leaderboard", result, "--row", row) == 0
    for given_file, why in (
        (files[0], "is not what was scored"),
        (row, "row files name no samples"),
    ):
        message = refusal(fpp_bench, "leaderboard", given_file, *page_of)
        assert why in message and f"{folder}: no given result was scored from it" in message
    for sample in dataset.samples("test"):
        np.save(folder / f"{sample}.npy", dataset.depth_mm(sample))
    assert "is not the file that was scored" in refusal(fpp_bench, "leaderboard", result, *page_of)
    assert "give it with --page DIR" in refusal(
        fpp_bench, "leaderboard", result, "--predictions", folder
    )
    assert not (tmp_path / "page").exists()


def test_predictions_without_a_depth_have_no_cloud(predicted, tmp_path):
    dataset, folder, _ = predicted
    for sample in dataset.samples("test"):
        np.save(folder / f"{sample}.npy", np.zeros(dataset.size, np.float32))
    write_result(evaluate(folder, dataset), tmp_path / "none.json")
    entries = read_entries([tmp_path / "none.json"])
    (samples,) = predicted_samples(entries, [(folder, dataset)]).values()
    assert samples.cloud is None and len(samples.shown) == 2
    files = page_files(rank(entries), [], samples={entries[0].row.result_sha256: samples})
    assert not any(name.endswith("-cloud.html") for name in files)


@given(st.lists(st.floats(1e-6, 1e6), min_size=1, max_size=8))
@settings(max_examples=100, deadline=None)
def test_a_scale_holds_every_mean(means):
    rows = [
        SimpleNamespace(
            rank_key="", value=lambda key, m=m: m, interval=lambda key, m=m: (0.0, 1.5 * m)
        )
        for m in means
    ]
    scale = LogScale.of(rows)
    assert all(scale.low < mean / 9 and 1.5 * mean < scale.high for mean in means)
    places = [scale.share(mean) for mean in sorted(means)]
    assert places == sorted(places) and scale.share(0.0) == 0.0 and scale.share(1e12) == 1.0
    ticks = [float(label) for _, label in scale.ticks]
    assert len(ticks) >= 2 and ticks == sorted(ticks)


def test_an_interval_that_reaches_zero_is_clipped_where_it_shows(files):
    (entry,) = read_entries(files[:1])
    reaching = changed(entry, intervals={RANK_KEY: [0.0, 9.0]})
    for shown, expected in ((entry, False), (reaching, True)):
        index = page_files(rank([shown]), [])["index.html"].decode()
        assert ('<path class="beyond"' in index) is expected and (
            "an arrow marks those" in index
        ) is expected
    assert "on one logarithmic scale" in index


def test_a_picture_is_of_one_target(dataset, tmp_path, monkeypatch):
    """Errors against exact and against decoded depth are in tables of their own; a picture holds
    one of them."""
    made = [
        write_result_file(
            tmp_path / f"{target}.json",
            dataset,
            2.0,
            name=target,
            target=target,
            timing=timing(3.0),
        )
        for target in ("depth", "depth_exact")
    ]
    entries = read_entries(made)
    named_benchmarks(monkeypatch, full=dataset.content, unseen={})
    index = page_files(rank(entries), [])["index.html"].decode()
    assert "All points are errors against exact depth; the rows against other ground truth" in index
    assert index.count("<b>Error against run time.</b>") == 1 and index.count('class="board"') == 2
    assert len(set(re.findall(r'class="point[^>]*data-row="([^"]+)"', index))) == 1
