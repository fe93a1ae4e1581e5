"""The page's own words: what is ranked, how to read it, who stands for a number, and the paper's tables apart."""

from collections.abc import Sequence

from fpp_ml_bench.evaluation.report_html import escaped
from fpp_ml_bench.leaderboard.columns import PAPER_TITLES, paper_cells
from fpp_ml_bench.leaderboard.page_table import badge
from fpp_ml_bench.leaderboard.paper import PaperTable
from fpp_ml_bench.leaderboard.rows import BY_THE_PAPER, MEANING

INTRODUCTION = (
    "<h1>FPP-ML-Bench leaderboard</h1><p>Depth from fringe projection, scored in mm on the object, with the run time "
    "and the captures that it costs. Every number comes from a file in the repository.</p>"
)

SCATTER_KEY = (
    'Error against run time: lower and further left is better. <span class="front-key">The line</span> is the front: '
    "nobody is both faster and more exact. Area of a mark: frames needed. Whiskers: 95% interval of the error, 5th to "
    "95th percentile of the time. Hollow: time self-reported."
)

_READING = (
    "Object MAE is the mean of |prediction - truth| over the pixels of the object, averaged over samples. Its 95% "
    "interval comes from a bootstrap over objects, since views of one object are not independent. A rank is 1 and the "
    "number of methods whose whole interval is better: methods that can't be told apart share one. What differs in "
    "track, data, split, target or rules is never ranked together. Time is the median latency of one image at batch 1."
)

_ADD_A_ROW = (
    "<h3>Add a row</h3><p>Score your predictions and open a pull request with one file:</p>"
    "<pre><code>fpp-eval predictions --dataset data/full --split test --target depth_exact \\\n"
    "    --json leaderboard/rows/my-method.json</code></pre>"
)


def paper_section(papers: Sequence[PaperTable]) -> str:
    """The paper's tables, as reported and ranked with nothing."""
    if not papers:
        return ""
    return (
        f'<section id="paper"><h2>Reported by the paper</h2><p>{badge(BY_THE_PAPER)}</p>'
        f"<p>{escaped(MEANING[BY_THE_PAPER], 300)} They are no part of any ranking above.</p>"
        f"{''.join(map(_paper_table, papers))}</section>\n"
    )


def _paper_table(paper: PaperTable) -> str:
    head = "".join(
        f'<th scope="col"{" class=text" if place < 2 else ""}>{title}</th>' for place, title in enumerate(PAPER_TITLES)
    )
    lines = ""
    for row in paper.rows:
        first, second, *rest = (escaped(cell) for cell in paper_cells(row))
        cells = "".join(f"<td>{cell}</td>" for cell in rest)
        lines += f'<tr><th scope="row">{first}</th><td class="text">{second}</td>{cells}</tr>\n'
    title = escaped(f"{paper.title}, mm")
    return (
        f'<h3>{title}</h3><div class="scroll" tabindex="0" role="region" aria-label="{title}">'
        f"<table><thead><tr>{head}</tr></thead>\n<tbody>\n{lines}</tbody></table></div>\n"
    )


def reading_section() -> str:
    """How to read the page, and how to get onto it."""
    meanings = "".join(f"<dt>{badge(name)}</dt><dd>{escaped(text, 300)}</dd>" for name, text in MEANING.items())
    return (
        f'<section id="reading"><h2>How to read this</h2><p>{_READING}</p><h3>Who stands for a number</h3>'
        f'<dl class="meanings">{meanings}</dl>{_ADD_A_ROW}</section>\n'
    )
