"""The page's own text: what is ranked, how to read it, who vouches for a number, and the paper's tables."""

from collections.abc import Sequence

from fpp_ml_bench.evaluation.report import escaped
from fpp_ml_bench.leaderboard.columns import PAPER_TITLES, RANK_NOTE, paper_cells, paper_note
from fpp_ml_bench.leaderboard.page.table import badge
from fpp_ml_bench.leaderboard.paper import PaperTable
from fpp_ml_bench.leaderboard.rows import BY_THE_PAPER, MEANING

INTRODUCTION = (
    "<h1>FPP-ML-Bench leaderboard</h1><p>Depth from fringe projection: error in mm on the object, run time, and the "
    "number of captured frames. Every number comes from a file in the repository.</p>"
)

SCATTER_KEY = (
    'Error against run time: lower and further left is better. <span class="front-key">The line</span> is the front: '
    "no other row is both faster and more exact. Area of a mark: frames captured. Whiskers: 95% interval of the error, "
    "5th to 95th percentile of the time. Hollow marks: time self-reported. Numbers count the rows of the table above, "
    "best error first."
)

_READING = (
    "Object MAE is the mean of |prediction - truth| over the pixels of the object, averaged over samples. Its 95% "
    "interval comes from a bootstrap over objects, because views of one object are not independent. Object RMSE is "
    "taken over the same pixels, overall MAE over all pixels of the image. Rows are sorted by object MAE. "
    f"{RANK_NOTE} Rows that differ in track, data, split, target or protocol are never ranked together. Time is the "
    "median latency of one image at batch 1."
)

_ADD_A_ROW = (
    "<h3>Add a row</h3><p>Score your predictions and open a pull request with one file:</p>"
    "<pre><code>fpp-eval predictions --dataset data/full --split test --target depth_exact \\\n"
    "    --json leaderboard/rows/my-method.json</code></pre>"
)


def paper_section(papers: Sequence[PaperTable]) -> str:
    """The paper's tables as reported, outside every ranking."""
    if not papers:
        return ""
    return (
        f'<section id="paper"><h2>Reported by the paper</h2><p>{badge(BY_THE_PAPER)}</p>'
        f"<p>{escaped(MEANING[BY_THE_PAPER], 300)} They are in none of the rankings above.</p>"
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
        f"<table><thead><tr>{head}</tr></thead>\n<tbody>\n{lines}</tbody></table></div>"
        f'<p class="soft small">{escaped(paper_note(paper), 300)}</p>\n'
    )


def reading_section() -> str:
    """How to read the page, and how to add a row."""
    meanings = "".join(f"<dt>{badge(name)}</dt><dd>{escaped(text, 300)}</dd>" for name, text in MEANING.items())
    return (
        f'<section id="reading"><h2>How to read this</h2><p>{_READING}</p><h3>Who vouches for a number</h3>'
        f'<dl class="meanings">{meanings}</dl>{_ADD_A_ROW}</section>\n'
    )
