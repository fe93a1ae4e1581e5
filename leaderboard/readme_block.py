"""The ranking in README.md, between two markers: made from the rows, never written by hand."""

from collections.abc import Sequence
from pathlib import Path

from fpp_ml_bench.errors import SubmissionError
from fpp_ml_bench.evaluation.numbers import millimetres
from fpp_ml_bench.evaluation.text import printable
from fpp_ml_bench.leaderboard.columns import NAME_WIDTH, SELF_REPORTED, device, reliance
from fpp_ml_bench.leaderboard.export import markdown_rows, markdown_text
from fpp_ml_bench.leaderboard.ranking import DEFAULT_SORT, Group, Ranked
from fpp_ml_bench.loaders.manifest import write_atomically

BEGIN, END = "<!-- leaderboard:begin -->", "<!-- leaderboard:end -->"
_TITLES = ("Rank", "Method", "Object MAE, mm", "95% interval", "Time, ms", "Frames", "Phase reliance", "Provenance")
_RIGHT = (True, False, True, True, True, True, True, False)
_MADE_BY = "Made by `fpp-bench leaderboard --readme README.md` from the files in `leaderboard/rows/`."
_NOTE = (
    f"{_MADE_BY} Rank: 1 and the number of methods whose whole interval is better (95%, bootstrap over objects). Time: "
    f"median latency of one image. \\{SELF_REPORTED} self-reported. Phase reliance: 1 follows the fringe's phase and "
    "nothing else, 0 does not follow it (docs/reliance.md)."
)
SHOWN = 5
"""Rows of a group that README shows; the page shows them all."""
_NOBODY = f"No row yet. {_MADE_BY}"


def readme_block(groups: Sequence[Group]) -> str:
    """What stands between the markers: the best of each group (`SHOWN`); the same rows give the same bytes."""
    lines: list[str] = []
    for group in groups:
        height, width = group.key.size
        against = "exact depth" if group.key.target == "depth_exact" else "decoded depth"
        mode = "" if group.key.mode == "standard" else f", mode {group.key.mode}"
        title = f"{group.key.track} track, {group.key.split} split, {width} x {height} px, against {against}{mode}"
        machines = sorted({device(row.entry) for row in group.rows if row.entry.time_measured})
        timed = f"; measured on {', '.join(machines)}" if machines else ""
        title = f"{title[0].upper()}{title[1:]} ({group.key.fingerprint[:8]}){timed}"
        rows = [[markdown_text(cell) for cell in _cells(row)] for row in group.rows[:SHOWN]]
        lines += [f"**{markdown_text(title)}**", "", *markdown_rows(_TITLES, _RIGHT, rows), ""]
        more = len(group.rows) - SHOWN
        lines += [f"… and {more} more on the page", ""] if more > 0 else []
    return "\n".join([*lines, _NOTE if groups else _NOBODY]) + "\n"


def _cells(row: Ranked) -> list[str]:
    entry = row.entry
    interval = entry.interval(DEFAULT_SORT)
    time = "-" if entry.latency_ms is None else f"{entry.latency_ms:.3g}{'' if entry.time_measured else SELF_REPORTED}"
    return [
        str(row.rank),
        printable(entry.name, NAME_WIDTH),
        millimetres(entry.value(DEFAULT_SORT)),
        "-" if interval is None else f"{millimetres(interval[0])} - {millimetres(interval[1])}",
        time,
        str(entry.frames),
        reliance(entry),
        entry.provenance,
    ]


def with_block(text: str, block: str, path: Path) -> str:
    """``text`` of the file ``path`` with ``block`` between the markers. SubmissionError unless each stands there once,
    in order."""
    begin, end = text.find(BEGIN), text.find(END)
    if text.count(BEGIN) != 1 or text.count(END) != 1 or end < begin:
        raise SubmissionError(
            f"{printable(str(path), 500)}: expected {BEGIN} and below it {END}, each once; put them where the ranking "
            "belongs"
        )
    return f"{text[: begin + len(BEGIN)]}\n\n{block}\n{text[end:]}"


def update_readme(path: Path, groups: Sequence[Group], check: bool) -> bool:
    """Whether ``path`` holds the block of ``groups`` already; if not, write it, unless ``check`` only asks."""
    try:
        text = path.read_bytes().decode("utf-8")
        wanted = with_block(text, readme_block(groups), path)
        if wanted == text:
            return True
        if not check:
            write_atomically(path, wanted.encode("utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        reason = "is no UTF-8 text" if isinstance(error, UnicodeDecodeError) else f"failed: {error.strerror}"
        raise SubmissionError(f"{printable(str(path), 500)} {reason}") from None
    return False
