"""How numbers are written in tables: the same digits in the terminal, in Markdown and on the page."""


def millimetres(value: float | None) -> str:
    """An error in mm to three decimals, in powers of ten where very small or large, a dash for an empty pixel set."""
    if value is None:
        return "-"
    if value == 0:
        return "0"
    return f"{value:.3f}" if 5e-4 <= value < 1e6 else f"{value:.2e}"


def percent(share: float | None) -> str:
    """A share as per cent with one decimal, a dash where there is none."""
    return "-" if share is None else f"{100 * share:.1f}%"


def seconds(value: float | None) -> str:
    """A time in seconds to three significant digits, a dash when unknown."""
    return "-" if value is None else f"{value:.3g}"


def signed(value: float | None) -> str:
    """A signed error in mm: `millimetres` with its sign, a dash where there is none."""
    if value is None:
        return "-"
    return ("-" if value < 0 else "+" if value > 0 else "") + millimetres(abs(value))


def interval_text(ends: "tuple[float, float] | None") -> str:
    """The two ends of an interval in mm, a dash where there is none."""
    return "-" if ends is None else f"{_end(ends[0])}..{_end(ends[1])}"


def _end(value: float) -> str:
    return ("-" if value < 0 else "") + millimetres(abs(value))
