"""What `fpp-eval compare` prints: the paired differences of the headline errors, and the sentence."""

from rich.console import Group
from rich.table import Table
from rich.text import Text

from fpp_ml_bench.evaluation.compare import Comparison
from fpp_ml_bench.evaluation.numbers import interval_text, signed
from fpp_ml_bench.evaluation.text import printable


def comparison_table(comparison: Comparison) -> Group:
    """The comparison as rich tables; every text from a submission is shown as plain text, never as markup."""
    table = Table(caption="mm; mean of second - first over samples, 95% interval over objects", caption_justify="left")
    table.add_column("Error")
    for heading in ("Second - first", "95% interval", "Second lower in", "Second higher in", "Samples", "Objects"):
        table.add_column(heading, justify="right", no_wrap=True)
    for key, row in comparison.differences.items():
        low, high = row.interval_mm
        ends = None if low is None or high is None else (low, high)
        pixels, error = key.removesuffix("_mm").split("_")
        table.add_row(
            f"{pixels} {error.upper()}", signed(row.mean_mm), interval_text(ends), str(row.lower), str(row.higher),
            str(row.samples), str(row.objects), style="bold" if row.told_apart else None,
        )  # fmt: skip
    title = Text(
        f"\nfirst:  {printable(comparison.first)}\nsecond: {printable(comparison.second)}\n"
        f"{comparison.split} split ({comparison.fingerprint[:8]}), against {comparison.target}, "
        f"{comparison.track} track\n"
    )
    return Group(title, table, Text(f"{comparison.sentence}\n"))
