"""The page in headless Chromium: sorting, filters, keyboard, both colour schemes, a phone, and
hostile rows."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
from board_rows import entry_with_errors, named_benchmarks, some_rows, timing, write_result_file
from chromium import Browser
from conftest import fpp_bench
from scored_dataset import make_dataset

from fpp_ml_bench.evaluation.submission.description import LearnedFrom
from fpp_ml_bench.leaderboard import rows
from fpp_ml_bench.leaderboard.page.page import predicted_samples, write_page
from fpp_ml_bench.leaderboard.ranking import (
    is_trivial,
    more_than_trivial,
    rank,
    read_entries,
    shipped_rows,
)
from fpp_ml_bench.leaderboard.tables import chosen_tables

pytestmark = pytest.mark.long

HOSTILE = "</script><script>window.hacked = 1</script><img src=x onerror='window.hacked = 1'>"


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The page of four rows and a hostile one, opened from disk."""
    work = tmp_path_factory.mktemp("board")
    dataset = make_dataset(work / "tiny")
    files = some_rows(work / "rows", dataset)
    files.append(
        write_result_file(
            work / "rows" / "bad.json",
            dataset,
            16.0,
            1.0,
            name=HOSTILE,
            frames_used=[0, 1],
            timing=timing(4.0, 2),
        )
    )
    row = work / "row.json"
    assert fpp_bench("leaderboard", files[0], "--row", row) == 0
    with pytest.MonkeyPatch.context() as patch:
        listed = rows.vouching_line(
            read_entries([row])[0].row, row.read_bytes(), "verified", "fpp-eval verify"
        )
        (work / "vouched.txt").write_text(f"{listed}\n")
        patch.setattr(rows, "VOUCHED", work / "vouched.txt")
        assert fpp_bench("leaderboard", row, *files[1:], "--page", work / "page") == 0
    return work / "page" / "index.html"


@pytest.fixture(scope="module")
def browser():
    started = Browser()
    yield started
    started.close()


@pytest.fixture
def opened(browser, page):
    browser.open(page)
    yield browser
    assert browser.complaints() == []
    assert [address for address in browser.requests() if not address.startswith("file://")] == []


NAMES = """[...document.querySelector('.ranking').querySelectorAll('tbody tr')].filter(row => !row.hidden)
    .map(row => row.querySelector('th a').innerText.slice(0, 14))"""
TABLE = "document.querySelector('.ranking').id"
SORTED = """[...document.querySelector('.ranking').querySelectorAll('th')]
    .map(head => head.getAttribute('aria-sort')).filter(Boolean).join()"""
RANKED = ["Slow and fine", "Fast and rough", "Beaten", HOSTILE[:14]]


def test_the_browser_would_tell(browser, tmp_path):
    """What the other tests rely on: exceptions, console messages and what the policy stops do show
    up."""
    policy = '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'">'
    for odd in (
        "<script>throw 1</script>",
        "<script>console.log(1)</script>",
        f"{policy}<img src='x.png'>",
    ):
        (tmp_path / "odd.html").write_text(f"<!doctype html>{odd}")
        browser.open(tmp_path / "odd.html")
        assert browser.complaints() != []
    (tmp_path / "odd.html").write_text(
        "<!doctype html><link rel=icon href=data:,><img src='y.png'>"
    )
    browser.open(tmp_path / "odd.html")
    assert [address.rsplit("/", 1)[1] for address in browser.requests()] == ["odd.html", "y.png"]


def test_a_click_sorts_and_another_turns_it_round(opened, page):
    assert opened.requests() == [page.resolve().as_uri()]
    assert opened.run(NAMES) == RANKED and opened.run(SORTED) == "ascending"
    opened.click(".ranking button[data-key=ms]")
    assert opened.run(NAMES) == ["Fast and rough", HOSTILE[:14], "Slow and fine", "Beaten"]
    assert (
        opened.run("document.querySelector('.ranking [data-key=ms]').closest('th').ariaSort")
        == "ascending"
    )
    opened.click(".ranking button[data-key=ms]")
    assert opened.run(NAMES) == ["Beaten", "Slow and fine", HOSTILE[:14], "Fast and rough"]
    assert opened.run(SORTED) == "descending"
    assert f"{opened.run(TABLE)}=ms.descending" in opened.run("location.hash")
    opened.click(".ranking button[data-key=name]")
    assert opened.run(NAMES) == [HOSTILE[:14], "Beaten", "Fast and rough", "Slow and fine"]
    opened.click(".ranking button[data-key=object_mae_mm]")
    assert opened.run(NAMES) == RANKED


def tab_to(browser, condition):
    """Press the Tab key until the element with the focus fulfils a JavaScript condition on
    ``e``."""
    for _ in range(60):
        browser.key("Tab")
        if browser.run(f"(e => {condition})(document.activeElement)"):
            assert browser.run("getComputedStyle(document.activeElement).outlineStyle") != "none"
            return
    pytest.fail(f"the Tab key never reached an element with {condition}")


def test_keys_alone_reach_everything(opened):
    opened.key("Tab")
    assert opened.run("document.activeElement.className") == "skip"
    assert (
        opened.run("document.activeElement.getBoundingClientRect().left") >= 0
    )  # seen when focused
    tab_to(opened, "e.id === 'q'")
    opened.type("e")
    assert "q=e" in opened.run("location.hash")
    tab_to(opened, "e.id === 'columns'")
    opened.key(" ", " ")
    assert "columns=all" in opened.run("location.hash")
    tab_to(opened, "e.dataset.key === 'frames'")
    opened.key("Enter", "\r")
    assert opened.run(NAMES)[-1] == "Slow and fine" and opened.run(SORTED) == "ascending"
    assert opened.run(_CUT_CELLS) == [] and not opened.run("document.activeElement.closest('.cut')")


def test_a_key_opens_what_a_phone_has_no_room_for(browser, page):
    browser.open(page, 390, 844)
    assert browser.run(_TITLES) == ["Method", "Two-sided MAE, mm"]  # a table without ranks
    terms = "[...document.querySelectorAll('.ranking .rest[open] dt')].map(term => term.innerText)"
    assert browser.run(terms) == []
    tab_to(browser, "e.matches('.rest > summary')")
    browser.key("Enter", "\r")
    browser.run("new Promise(done => setTimeout(done, 50))")
    shown = browser.run(terms)
    assert {
        "95% interval, mm",
        "Overall MAE, mm",
        "Time, ms",
        "Frames",
        "Code",
        "Provenance",
    } <= set(shown)
    assert browser.run("document.documentElement.scrollWidth") <= 390
    browser.open(f"{page.resolve().as_uri()}#columns=all", 390, 844)
    opened = "[...document.querySelectorAll('.rest')].every(rest => rest.open)"
    assert browser.run(opened) and browser.run("document.getElementById('columns').checked")
    assert browser.complaints() == []


@pytest.mark.parametrize("width", [390, 900, 1440])
def test_the_first_screen_holds_the_one_frame_table(browser, shipped_page, width):
    browser.open(shipped_page, width, 900)
    titles = ["Rank", "Method", "Two-sided MAE, mm"]
    if width > 390:
        titles += [
            "95% interval, mm",
            "Object MAE, mm",
            "Time, ms",
            "Phase reliance",
            "Disturbed, mm",
        ]
    assert browser.run(_TITLES) == titles
    assert browser.run("document.querySelector('.board h2').innerText").startswith(
        "One frame, metric track"
    )
    bottoms = browser.run(
        "[...document.querySelectorAll('.ranking tbody tr')].map(r => "
        "r.getBoundingClientRect().bottom)"
    )
    assert sum(0 < bottom <= 900 for bottom in bottoms) >= (3 if width == 390 else 5)
    assert browser.run(
        "(box => box.scrollWidth <= box.clientWidth)(document.querySelector('.board .scroll'))"
    )
    processors = r"/Xeon|EPYC|AMD|Intel/"
    cells = (
        f"[...document.querySelectorAll('.ranking tbody tr > *')].filter(c => "
        f"{processors}.test(c.textContent)).length"
    )
    assert browser.run(cells) == 0 and "(a) AMD EPYC" in browser.run(
        "document.querySelector('.board p').innerText"
    )


@pytest.mark.parametrize("width", [390, 900, 1440])
def test_no_cell_is_covered_or_cut_wherever_a_table_is_scrolled_to(browser, shipped_page, width):
    browser.open(f"{shipped_page.resolve().as_uri()}#columns=all", width, 900)
    browser.run("document.querySelectorAll('details').forEach(part => part.open = true)")
    for number in range(browser.run("document.querySelectorAll('.scroll:has(thead)').length")):
        box = f"document.querySelectorAll('.scroll:has(thead)')[{number}]"
        end = browser.run(f"{box}.scrollWidth - {box}.clientWidth")
        for left in range(0, min(end, 1200) + 1, 171):
            frames = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
            browser.run(f"{box}.scrollLeft = {left}, {frames}")
            assert browser.run(f"({_CUT})({box})") == [], (number, left)
            # The head of a column that stays is above its cells.
            assert browser.run(f"({_APART})({box})") <= 0.5, (number, left)
    browser.open(f"{shipped_page.resolve().as_uri()}#columns=all", width, 900)
    browser.run("document.querySelector('.board .scroll').scrollLeft = 0")
    shown = browser.run(_TITLES)
    assert ("Code" in shown) == (width > 390)


def test_the_check_of_cut_cells_would_tell(browser, shipped_page):
    browser.open(f"{shipped_page.resolve().as_uri()}#columns=all", 900, 900)
    box, found = "document.querySelector('.board .scroll')", []
    for left in range(0, 120, 20):  # the frame may end between two columns
        browser.run(f"{box}.scrollLeft = {left}, new Promise(done => setTimeout(done, 50))")
        browser.run("document.querySelectorAll('.cut').forEach(cell => { cell.style.opacity = 1 })")
        found += browser.run(f"({_CUT})({box})")
    assert found


def test_filters_hide_rows_marks_and_say_so(opened):
    marks = """[...document.querySelectorAll('figure:first-child .wide .point')]
        .filter(point => point.style.display !== 'none').length"""
    assert opened.run(marks) == 5
    opened.click("#q")
    opened.type("BEATEN")
    assert opened.run(NAMES) == ["Beaten"] and opened.run(marks) == 1
    assert opened.run("document.getElementById('shown').innerText") == "1 of 5 rows shown"
    assert opened.run("document.getElementById('shown').getAttribute('role')") == "status"
    assert opened.run(
        "[...document.querySelectorAll('.board')].map(section => section.hidden)"
    ) == [False, True]
    opened.click("#filters button[type=reset]")
    assert opened.run("new Promise(done => setTimeout(done, 20))") is None
    assert opened.run(NAMES) == RANKED
    opened.click("input[value=verified]")
    assert opened.run(NAMES) == [name for name in RANKED if name != "Fast and rough"]
    assert "hide=verified" in opened.run("location.hash")
    choose = (
        "(s) => { s.value = 'oracle range'; s.dispatchEvent(new Event('input', {bubbles: true})) }"
    )
    opened.run(f"({choose})(document.querySelector('select[name=track]'))")
    assert (
        opened.run(NAMES) == []
        and opened.run("document.getElementById('shown').innerText") == "1 of 5 rows shown"
    )
    assert "track=oracle+range" in opened.run("location.hash")


def test_a_view_can_be_linked_to(browser, page):
    browser.open(page)
    address, table = page.resolve().as_uri(), browser.run(TABLE)
    browser.open(f"{address}#{table}=frames.descending&q=a&track=metric&hide=verified")
    assert browser.run(NAMES) == ["Slow and fine", "Beaten", HOSTILE[:14]]
    assert browser.run("document.getElementById('q').value") == "a"
    for odd in (f"#{table}=__proto__.x&track=<b>&hide=%00", f"#{table}=&q=" + "x" * 5000, "#=&=&%"):
        browser.open(address + odd)
        assert browser.run("document.querySelectorAll('.ranking tbody tr').length") == 5
        assert browser.complaints() == []


def test_hostile_text_is_shown_and_does_nothing(opened, page):
    assert HOSTILE[:28] in opened.run("document.body.innerText")
    assert opened.run("typeof window.hacked") == "undefined"
    links = "[...document.querySelectorAll('.ranking tbody a')].map(a => a.title)"
    assert HOSTILE in opened.run(links)
    for sub in sorted((page.parent / "submissions").glob("*.html")):
        opened.open(sub)
        assert opened.run("typeof window.hacked") == "undefined"
        assert opened.complaints() == [] and opened.requests() == [sub.resolve().as_uri()]
        assert opened.run("document.querySelectorAll('table').length") >= 2


@pytest.mark.parametrize(("width", "dark"), [(320, False), (375, True), (768, False), (1440, True)])
def test_every_width_in_both_schemes(browser, page, width, dark):
    for path in (page, sorted((page.parent / "submissions").glob("*.html"))[0]):
        browser.open(path, width, 844, dark)
        assert (
            browser.run("document.documentElement.scrollWidth") <= width
        )  # only tables scroll sideways
        assert browser.run(_LEAST_CONTRAST) >= 4.5  # WCAG 2.2, level AA
        assert browser.complaints() == []
    browser.open(page, width, 844, dark)
    shown = (
        "[...document.querySelectorAll('.scatter')].filter(s => s.getBoundingClientRect().width > "
        "0).length"
    )
    assert browser.run(shown) == 2  # against time and against frames


@pytest.fixture(scope="module")
def shipped_page(tmp_path_factory):
    """The page of the rows that ship with the package."""
    out = tmp_path_factory.mktemp("shipped") / "page"
    assert fpp_bench("leaderboard", "--page", out) == 0
    return out / "index.html"


def test_the_shipped_page_has_all_rows(shipped_page):
    groups = rank(read_entries(shipped_rows()))
    shown = more_than_trivial(groups)
    pages = sum(path.is_file() for path in shipped_page.parent.rglob("*"))
    assert pages == 3 + sum(len(group.rows) for group in shown)
    assert all(is_trivial(row) for group in groups if group not in shown for row in group.rows)


@pytest.mark.parametrize("width", [390, 1240])
def test_the_shipped_page_fits(browser, shipped_page, width):
    browser.open(shipped_page, width)
    assert browser.run("document.documentElement.scrollWidth") <= width
    lines = "e => e.getBoundingClientRect().height / parseFloat(getComputedStyle(e).lineHeight)"
    most_lines = 2 if width == 390 else 1  # beside two other columns
    assert (
        browser.run(f"Math.max(...[...document.querySelectorAll('.ranking tbody a')].map({lines}))")
        < most_lines + 0.5
    )
    assert browser.run("document.querySelector('.links').getBoundingClientRect().height") < 220


@pytest.mark.parametrize("width", [390, 1240])
def test_labels_of_the_shipped_pictures_are_apart_and_whole(browser, shipped_page, width):
    browser.open(shipped_page, width)
    browser.run("document.querySelectorAll('details').forEach(part => part.open = true)")
    pictures = browser.run(_LABEL_BOXES)
    datasets = {
        group.key.data_title for group in more_than_trivial(rank(read_entries(shipped_rows())))
    }
    assert len(pictures) == 2 * len(datasets)
    for picture in pictures:
        left, top, right, bottom = picture["frame"]
        boxes = picture["labels"]
        for number, box in enumerate(boxes):
            assert left <= box[0] and top <= box[1] and box[2] <= right and box[3] <= bottom
            for placed in boxes[:number]:
                apart = (
                    box[2] <= placed[0]
                    or placed[2] <= box[0]
                    or box[3] <= placed[1]
                    or placed[3] <= box[1]
                )
                assert apart, (box, placed)


@pytest.fixture(scope="module")
def axe():
    """The accessibility checks of Deque's axe, as text."""
    if os.environ.get("CI", "").lower() in ("1", "true"):
        import axe_core_python
    else:
        axe_core_python = pytest.importorskip("axe_core_python")
    return Path(axe_core_python.__file__).with_name("axe.min.js").read_text(encoding="utf-8")


def findings(browser, axe) -> list[str]:
    """What axe finds on the page with all of its details open, as far as it is serious or
    critical."""
    browser.run("document.querySelectorAll('details').forEach(part => part.open = true)")
    browser.run(f"{axe}; 1")
    heavy = "v => ['serious', 'critical'].includes(v.impact)"
    return browser.run(
        f"axe.run().then(r => r.violations.filter({heavy}).map(v => v.id + v.nodes[0].html))"
    )


@pytest.fixture(scope="module")
def ranked_page(tmp_path_factory):
    """A page with ranks, pairs and both test sets."""
    work = tmp_path_factory.mktemp("ranked")
    file = write_result_file(
        work / "base.json", make_dataset(work / "tiny"), 1.0, timing=timing(3.0)
    )
    (base,), full, unseen = read_entries([file]), {"test/depth": "f" * 32}, {"test/depth": "e" * 32}
    entries = []
    learned = (
        LearnedFrom(data="generated"),
        LearnedFrom(data="train-split", versions=["a benchmark"]),
        None,
    )
    for number, name in enumerate(("first", "second", "third")):
        for objects, data in ((5, full), (20, unseen)):
            errors = {f"{objects} {n}": float((1 + n) * (1 + number)) for n in range(objects)}
            about = {"method": "constant" if number == 2 else name, "learned_from": learned[number]}
            entry = entry_with_errors(base, errors, name, data, **about)
            entries.append(replace(entry, path=work / f"{name}-{objects}.json"))
    with pytest.MonkeyPatch.context() as patch:
        named_benchmarks(patch, full=full, unseen=unseen)
        write_page(rank(entries), chosen_tables(None), work / "page")
    return work / "page" / "index.html"


@pytest.fixture(scope="module")
def page_with_samples(tmp_path_factory):
    """The own page of a row with the pictures of its predictions."""
    work = tmp_path_factory.mktemp("samples")
    dataset = make_dataset(work / "tiny")
    entries = read_entries([write_result_file(work / "mine.json", dataset, 1.0, 0.5)])
    samples = predicted_samples(entries, [(work / "mine-predictions", dataset)])
    write_page(rank(entries), [], work / "page", samples)
    return next((work / "page" / "submissions").glob("*.html"))


@pytest.mark.parametrize("width", [390, 900, 1440])
def test_pictures_of_predictions_are_shown_whole(browser, page_with_samples, width):
    browser.open(page_with_samples, width)
    assert browser.run(
        "[...document.querySelectorAll('img.panels')].map(image => image.naturalWidth > 1000)"
    ) == [
        True,
        True,
    ]
    assert (
        browser.run("document.documentElement.scrollWidth") <= width and browser.complaints() == []
    )


def test_axe_finds_nothing(browser, axe, page, ranked_page, page_with_samples):
    (broken := ranked_page.with_name("broken.html")).write_text(
        "<!doctype html><html><body><input></body></html>"
    )
    browser.open(broken)
    assert findings(browser, axe)  # or the check could not fail
    own_page = next((ranked_page.parent / "submissions").glob("*.html"))
    for path, width, dark in (
        (page, 1440, False),
        (ranked_page, 375, True),
        (own_page, 768, False),
        (page_with_samples, 900, True),
    ):
        browser.open(path, width, 900, dark)
        assert findings(browser, axe) == []


def test_rows_by_what_they_learned_from(browser, ranked_page):
    browser.open(ranked_page.resolve().as_uri() + "#learned=train-split")
    assert browser.run(NAMES) == ["second"]
    column = (
        "[...document.querySelectorAll('.ranking th')].findIndex(head => head.innerText === "
        "'Learned from')"
    )
    assert browser.run(
        f"document.querySelector('.ranking tbody tr:not([hidden])').cells[{column}].innerText"
    ) == ("train-split")
    browser.open(ranked_page.resolve().as_uri() + "#learned=not+said")
    assert browser.run(NAMES) == ["third"]


def test_ranks_parts_and_pairs_are_on_the_page(browser, ranked_page):
    browser.open(ranked_page)
    titles = browser.run(
        "[...document.querySelectorAll('.ranking thead th')].map(head => head.innerText)"
    )
    cells = (
        "[...document.querySelectorAll('.ranking tbody tr')].map(row => [...row.cells].map(c => "
        "c.innerText))"
    )
    shown = [dict(zip(titles, row, strict=True)) for row in browser.run(cells)]
    columns = ("Rank", "Object MAE, mm", "On test, mm", "On unseen, mm", "× trivial")
    assert [tuple(row[column] for column in columns) for row in shown] == [
        ("1", "9.000", "3.000", "10.500", "0.33"),
        ("2", "18.000", "6.000", "21.000", "0.67"),
        ("3", "27.000", "9.000", "31.500", "1"),
    ]
    browser.run("document.querySelectorAll('details').forEach(part => part.open = true)")
    matrix = browser.run(
        "[...document.querySelectorAll('.matrix tbody td')].map(cell => cell.className)"
    )
    assert matrix == ["", "ahead", "ahead", "behind", "", "ahead", "behind", "behind", ""]
    browser.click(".ranking button[data-key=rank]")  # ascending as it is written
    assert browser.run("document.querySelector('.ranking tbody tr td').innerText") == "3"


_TITLES = """[...document.querySelector('.ranking').querySelectorAll('thead th')]
    .filter(head => head.getBoundingClientRect().width > 0)
    .map(head => head.firstChild.textContent.trim())"""
# Texts that a reader sees a part of: cut by the table's edge, or below a column that stays.
_CUT = """
box => {
  const frame = box.getBoundingClientRect(), cut = [];
  for (const row of box.querySelectorAll("tr")) {
    const cells = [...row.cells].filter(cell => cell.getBoundingClientRect().width > 0);
    const stays = cells.filter(cell => getComputedStyle(cell).position === "sticky");
    const left = Math.max(frame.left, ...stays.map(cell => cell.getBoundingClientRect().right));
    for (const cell of cells) {
      if (stays.includes(cell) || getComputedStyle(cell).opacity === "0") continue;
      const text = document.createRange();
      text.selectNodeContents(cell);
      const place = text.getBoundingClientRect();
      const seen = place.right > left + 1 && place.left < frame.right - 1;
      if (seen && (place.left < left - 1 || place.right > frame.right + 1)) cut.push(cell.innerText);
    }
  }
  return cut;
}
"""
_CUT_CELLS = f"({_CUT})(document.querySelector('.board .scroll'))"
_APART = """
box => {
  const left = cell => cell.getBoundingClientRect().left, heads = box.querySelector("thead tr").cells;
  const cells = [...box.querySelectorAll("tbody tr:not([hidden]) > *")];
  return Math.max(...cells.filter(cell => cell.getBoundingClientRect().width > 0)
    .map(cell => Math.abs(left(cell) - left(heads[cell.cellIndex]))));
}
"""
# Boxes of the labels of every picture that is shown: across as drawn, and a line's height without
# its leading.
_LABEL_BOXES = """
[...document.querySelectorAll("svg.scatter")].filter(svg => svg.getBoundingClientRect().width > 0).map(svg => ({
  frame: (b => [b.left, b.top, b.right, b.bottom])(svg.getBoundingClientRect()),
  labels: [...svg.querySelectorAll(".name text")].map(text => {
    const b = text.getBoundingClientRect(), cut = 0.15 * b.height;
    return [b.left, b.top + cut, b.right, b.bottom - cut];
  }),
}))
"""
_LEAST_CONTRAST = """
(() => {
  const context = document.createElement("canvas").getContext("2d", {willReadFrequently: true});
  const rgba = (colour) => {
    context.clearRect(0, 0, 1, 1); context.fillStyle = colour; context.fillRect(0, 0, 1, 1);
    return [...context.getImageData(0, 0, 1, 1).data];
  };
  const linear = (v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4;
  const light = ([r, g, b]) => 0.2126 * linear(r / 255) + 0.7152 * linear(g / 255) + 0.0722 * linear(b / 255);
  const ground = (element) => {
    for (let at = element; at; at = at.parentElement) {
      const colour = rgba(getComputedStyle(at).backgroundColor);
      if (colour[3] === 255) return colour;
    }
    return [255, 255, 255, 255];
  };
  let least = 21;
  const texts = "h1, h2, p, a, th, td, small, caption, label, button, figcaption, summary, dt, dd, .badge";
  for (const element of document.querySelectorAll(texts)) {
    const box = element.getBoundingClientRect();
    if (!box.width || !element.innerText?.trim()) continue;
    const [text, behind] = [light(rgba(getComputedStyle(element).color)), light(ground(element))];
    least = Math.min(least, (Math.max(text, behind) + 0.05) / (Math.min(text, behind) + 0.05));
  }
  return least;
})()
"""
