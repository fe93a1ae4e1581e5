"""The two plots of a stated uncertainty, as the lines that ``report.html`` draws: reliability and sparsification."""

from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace

from fpp_ml_bench.evaluation.report.html import millimetres, percent
from fpp_ml_bench.evaluation.result import Uncertainty

_WIDTH, _HEIGHT = 460, 300
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 12, 14, 44
_TICKS = 4
_LABEL_PX = 15

Points = Sequence[tuple[float, float]]


def uncertainty_plots(block: Uncertainty | None) -> list[SimpleNamespace]:
    """The plots of a result's block; none where it states nothing."""
    plots = []
    if block is not None and (reliability := block.reliability) is not None:
        observed = [(0.0, 0.0), *zip(reliability.nominal, reliability.observed, strict=True)]
        lines = {"as stated": [(0.0, 0.0), (1.0, 1.0)], "observed": observed}
        plots.append(_plot(lines, 1.0, "nominal coverage", percent))
    if block is not None and (curves := block.sparsification) is not None:
        lines = {
            "best order": list(zip(curves.left_out, curves.best_mae_mm, strict=True)),
            "by sigma": list(zip(curves.left_out, curves.mae_mm, strict=True)),
        }
        highest = max(curves.mae_mm) or 1.0
        plots.append(_plot(lines, highest, "share of object pixels left out; MAE of the rest, mm", millimetres))
    return plots


def _plot(
    lines: Mapping[str, Points], highest: float, label: str, write: Callable[[float | None], str]
) -> SimpleNamespace:
    """Lines over [0, 1] in px, the first of them dashed; ``write`` gives a height as text. The legend stands where no
    line is: left of rising lines, right of falling ones."""
    base = _HEIGHT - _BOTTOM

    def across(value: float) -> float:
        return round(_LEFT + (_WIDTH - _LEFT - _RIGHT) * value, 1)

    def up(value: float) -> float:
        return round(base - (base - _TOP) * value / highest, 1)

    drawn = [
        SimpleNamespace(
            title=title,
            dashed=number == 0,
            kind="ideal" if number == 0 else "curve",
            points=" ".join(f"{across(x)},{up(y)}" for x, y in points),
        )
        for number, (title, points) in enumerate(lines.items())
    ]
    rising = all(points[-1][1] > points[0][1] for points in lines.values())
    ticks = [step / _TICKS for step in range(_TICKS + 1)]
    ends = "; ".join(f"{title}: {write(points[0][1])} to {write(points[-1][1])}" for title, points in lines.items())
    return SimpleNamespace(
        width=_WIDTH,
        height=_HEIGHT,
        left=_LEFT,
        right=_WIDTH - _RIGHT,
        base=base,
        lines=drawn,
        label=label,
        levels=[(up(highest * tick), write(highest * tick)) for tick in ticks],
        edges=[(across(tick), percent(tick)) for tick in ticks],
        legend=[(_TOP + _LABEL_PX * number, line) for number, line in enumerate(drawn)],
        legend_x=_LEFT + 12 if rising else _WIDTH - _RIGHT - 110,
        description=f"{label[0].upper()}{label[1:]}. {ends}",
    )
