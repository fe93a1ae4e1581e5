"""The heat maps as a picture for the docs."""

from collections.abc import Sequence
from pathlib import Path

from fpp_ml_bench.baselines.stability.heat import LEVELS, families, level
from fpp_ml_bench.baselines.stability.run import Row

_MOST_ACROSS = 24


def write_picture(rows: Sequence[Row], path: Path) -> None:
    """Write the heat maps as PNG: two columns of groups, a line per family, a square per case."""
    import matplotlib

    matplotlib.use("Agg", force=False)
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch, Rectangle

    colours = {name: colour for name, _, colour in LEVELS}
    blocks: list[tuple[str, list[tuple[str, list[Row]]]]] = []
    for group, kinds in families(rows).items():
        lines: list[tuple[str, list[Row]]] = []
        for family, members in kinds.items():
            for start in range(0, len(members), _MOST_ACROSS):
                lines.append((family if start == 0 else "", list(members[start : start + _MOST_ACROSS])))
        blocks.append((group, lines))
    heights = [len(lines) + 2 for _, lines in blocks]
    columns: list[list[int]] = [[], []]
    for number in range(len(blocks)):  # the left column until it holds half
        left = sum(heights[i] for i in columns[0])
        columns[0 if left + heights[number] / 2 <= sum(heights) / 2 else 1].append(number)
    tallest = max(sum(heights[i] for i in column) for column in columns)
    figure = Figure(figsize=(13.5, 0.215 * tallest + 0.7), dpi=110, facecolor="white")
    for side, column in enumerate(columns):
        axes = figure.add_axes((0.005 + 0.5 * side, 0.0, 0.49, 1 - 0.6 / figure.get_figheight()))
        axes.set_xlim(-15.5, _MOST_ACROSS)
        axes.set_ylim(tallest, 0)
        axes.axis("off")
        y = 0.0
        for number in column:
            group, lines = blocks[number]
            axes.text(-15.4, y + 1.0, group, fontsize=11, fontweight="bold", va="center")
            y += 1.6
            for family, members in lines:
                axes.text(-0.4, y + 0.5, family, fontsize=8, va="center", ha="right", color="#333333")
                for x, row in enumerate(members):
                    axes.add_patch(Rectangle((x + 0.05, y + 0.08), 0.86, 0.84, color=colours[level(row)], lw=0))
                y += 1.0
            y += 0.4
    key = [Patch(color=colour, label=meaning) for _, meaning, colour in LEVELS]
    figure.legend(handles=key, ncols=4, fontsize=8, frameon=False, loc="upper center")
    figure.savefig(path, metadata={"Software": None})
