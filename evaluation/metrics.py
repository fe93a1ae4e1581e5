"""The metrics: an entry says everything about one. From the entries come the result model and its
JSON Schema, the table of PROTOCOL.md, the reports, the columns and the sort keys of the
leaderboard, and the metric of the training.

To add one, write an entry here and give PROTOCOL.md the table of `protocol_table`; no other file
changes. Its function gets a `fpp_ml_bench.evaluation.score.SampleScores`: prediction, target and
masks of a sample, its errors on the object, and the statistics that the built-in metrics share.
"""

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from itertools import groupby, pairwise
from operator import attrgetter, methodcaller
from typing import Any, Literal

from fpp_ml_bench.evaluation.protocol import COVERED, WIDE_BAND_PX, WITHIN_MM

Unit = Literal["mm", "signed mm", "share", "ratio", "nats"]
"""A ``share`` is from 0 to 1, a ``ratio`` may exceed 1; both are shown as per cent."""
WIDE, WIDEST = 140, 170


@dataclass(frozen=True)
class Metric:
    """``of`` computes it for a sample, None where the sample has no pixel for it, or names a
    statistic that a sample has; ``title`` and ``rule`` say what it is in reports and in
    PROTOCOL.md. The order of the entries is that of the keys in a file and of all tables.

    ``optional``: a file leaves its key out where no sample has it, so that files from before the
    entry stay readable; else it is null. ``charged``: rules without a charge for missing and
    invented pixels don't have it. ``cancels``: a small difference of large numbers, which two
    machines compute to 1e-9 of the error.

    Roles: ``headline``: one of the paper's six numbers, which have intervals and ranks; ``role``:
    ``rank``, the leaderboard's order, and ``range``, which stands beside it; ``helped_by_missing``:
    a method improves it by answering fewer pixels, so nothing is sorted by it; ``training``:
    `DepthScores` has it; ``over``: it is null exactly where this pixel set is empty; ``column``:
    title of its column in the leaderboard's tables, in terminals of ``column_from`` characters and
    more; ``terminal``: title of its column in the tables of ``fpp-eval``."""

    key: str
    title: str
    unit: Unit
    of: Callable[[Any], Any] | str
    rule: str
    optional: bool = True
    charged: bool = False
    cancels: bool = False
    better: Literal["lower", "higher", "nearer 0", "neither"] = "lower"
    headline: bool = False
    role: Literal["", "rank", "range"] = ""
    helped_by_missing: bool = False
    training: bool = False
    over: str = ""
    column: str = ""
    column_from: int = 0
    terminal: str = ""

    def value(self, sample: Any) -> Any:
        """The metric of a sample."""
        return attrgetter(self.of)(sample) if isinstance(self.of, str) else self.of(sample)


def share(part: Any, whole: Any) -> Any:
    """``part / whole``; None where there is no whole."""
    return part / whole if whole else None


def _mae(pixels: str, title: str, where: str, error: str = "mae", **about: Any) -> Metric:
    """The MAE over a set of pixels, or another ``error`` that `ErrorStats` has."""
    name, statistic = error.upper(), f"{pixels.removeprefix('object_')}.{error}_mm"
    return Metric(
        f"{pixels}_{error}_mm", f"{title} {name}", "mm", statistic, f"{name} over {where}", **about
    )


def _errors(
    pixels: str, title: str, where: str, mae: Any = None, rmse: Any = None, **about: Any
) -> tuple[Metric, ...]:
    """MAE and RMSE over a set of pixels; ``mae`` and ``rmse``: what only one of them has."""
    both = {"mae": mae or {}, "rmse": rmse or {}}
    return tuple(_mae(pixels, title, where, error, **about, **own) for error, own in both.items())


_headline = partial(_errors, headline=True, training=True, optional=False)
_always = partial(Metric, optional=False)
_object = partial(_always, over="object", training=True)
_ENTRIES = (
    *_headline("overall", "Overall", "object and background", {"column": "Overall MAE"}),
    *_headline(
        "object",
        "Object",
        "the object",
        {"column": "Object MAE", "terminal": "Object\nMAE"},
        {"column": "Object RMSE", "terminal": "Object\nRMSE"},
        over="object",
    ),
    *_headline(
        "background",
        "Background",
        "the background",
        {"column": "Backgr. MAE", "column_from": WIDE, "terminal": "Background\nMAE"},
        over="background",
    ),
    *_errors(
        "object_interior",
        "Object away from edges,",
        "the object interior",
        {"column": "Interior MAE", "column_from": WIDEST},
        optional=False,
    ),
    *_errors(
        "object_edge",
        "Object along edges,",
        "the object edge",
        {"column": "Edge MAE", "column_from": WIDEST},
        optional=False,
    ),
    _mae(
        "object_valid",
        "Object where predicted,",
        "the measured pixels",
        helped_by_missing=True,
        training=True,
        optional=False,
    ),
    _mae(
        "object_interior_valid",
        "Object where predicted, away from edges,",
        "the measured pixels of the interior",
        helped_by_missing=True,
        optional=False,
    ),
    _always(
        "object_edge_share",
        "Object along edges, share of pixels",
        "share",
        lambda s: share(s.edge.pixels, s.object.pixels),
        "share of the object that is object edge",
        better="neither",
        over="object",
        terminal="Near\nedges",
    ),
    _object(
        "object_missing_share",
        "Object not predicted",
        "share",
        lambda s: share(s.missing, s.object.pixels),
        "share of pixels predicted 0 or less",
        column="Missing",
        column_from=WIDE,
        terminal="Not\nmeasured",
    ),
    _always(
        "object_interior_missing_share",
        "Object away from edges, not predicted",
        "share",
        lambda s: share(s.interior.pixels - s.interior_valid.pixels, s.interior.pixels),
        "the same share of the interior",
    ),
    _object(
        "object_median_mm",
        "Object, median error",
        "mm",
        methodcaller("quantile", 0.5),
        "median of |e|, linear interpolation",
    ),
    _object(
        "object_p95_mm",
        "Object, 95th percentile",
        "mm",
        methodcaller("quantile", 0.95),
        "95th percentile of |e|, linear interpolation",
    ),
    _object(
        "object_max_mm", "Object, largest error", "mm", methodcaller("quantile", 1.0), "largest |e|"
    ),
    *(
        _object(
            f"object_within_{limit}mm_share",
            f"Object within {limit} mm",
            "share",
            methodcaller("within", limit),
            f"share of pixels with |e| <= {limit} mm",
            better="higher",
        )
        for limit in WITHIN_MM
    ),
    _object(
        "object_bias_mm",
        "Object, signed bias",
        "signed mm",
        "bias_mm",
        "mean of e",
        cancels=True,
        better="nearer 0",
        helped_by_missing=True,
    ),
    _always(
        "object_valid_bias_mm",
        "Object where predicted, signed bias",
        "signed mm",
        "valid_bias_mm",
        "mean of e over the measured pixels",
        cancels=True,
        better="nearer 0",
        helped_by_missing=True,
        training=True,
    ),
    _object(
        "object_shift_free_mae_mm",
        "Object MAE without one offset",
        "mm",
        "shift_free_mae_mm",
        "MAE after the median of e is subtracted: the error without a constant offset",
        cancels=True,
        helped_by_missing=True,
    ),
    _mae(
        "object_wide_band",
        f"Object within {WIDE_BAND_PX} px of edges,",
        "the object wide band",
        optional=False,
    ),
    _mae(
        "object_wide_interior",
        f"Object {WIDE_BAND_PX} px or more from edges,",
        "the object wide interior",
        optional=False,
    ),
    _always(
        "object_wide_band_share",
        f"Object within {WIDE_BAND_PX} px of edges, share of pixels",
        "share",
        lambda s: share(s.wide_band.pixels, s.object.pixels),
        "share of the object that is wide band",
        better="neither",
        over="object",
    ),
    Metric(
        "two_sided_mae_mm",
        "Two-sided MAE",
        "mm",
        methodcaller("two_sided_mm"),
        "sum of |e| over the measured pixels, and of the charge for each object pixel that is not "
        "measured and each "
        "background pixel predicted above 0, over the object's pixels",
        charged=True,
        role="rank",
        training=True,
        column="Two-sided MAE",
        terminal="Two-sided\nMAE",
    ),
    Metric(
        "two_sided_with_void_mae_mm",
        "Two-sided MAE, void surface in the object",
        "mm",
        methodcaller("two_sided_mm", True),
        "the same, with the void pixels whose target has a depth in the object",
        charged=True,
    ),
    Metric(
        "invented_share",
        "Background with an answer, over the object",
        "ratio",
        "invented_share",
        "background pixels predicted above 0 over the object's pixels; may exceed 1",
        charged=True,
        training=True,
        column="Invented",
        column_from=WIDE,
    ),
    Metric(
        "void_share",
        "Void, share of the image",
        "share",
        lambda s: (
            None if s.void is None else s.void / (s.object.pixels + s.background.pixels + s.void)
        ),
        "void pixels over all pixels of the image",
        better="neither",
    ),
    *_errors("unlit", "Unlit,", "the unlit set, missing pixels included", over="unlit"),
    _mae(
        "unlit_valid",
        "Unlit where predicted,",
        "the measured pixels of the unlit set",
        helped_by_missing=True,
    ),
    Metric(
        "unlit_missing_share",
        "Unlit, not predicted",
        "share",
        lambda s: share(s.unlit.pixels - s.unlit_valid.pixels, s.unlit.pixels),
        "share of the unlit set predicted 0 or less",
        over="unlit",
    ),
    Metric(
        "object_mae_range_share",
        "Object MAE, share of its depth range",
        "ratio",
        lambda s: share(s.object.mae_mm, s.range_mm),
        "object MAE over (D_max - D_min) of the object pixels that are scored; may exceed 1; none "
        "for a flat object",
        training=True,
        role="range",
    ),
)
METRICS = {metric.key: metric for metric in _ENTRIES}
"""Every metric by its key, in the order of a file."""
HEADLINE = tuple(key for key, metric in METRICS.items() if metric.headline)
"""The paper's six numbers (Section 5.3.2): MAE and RMSE over the full grid, the object and the
background, in mm."""
RANK_KEY, RANGE_KEY = (
    next(m.key for m in _ENTRIES if m.role == role) for role in ("rank", "range")
)
OBJECT_KEY = "object_mae_mm"
"""What rows are ranked by where nothing is charged: the paper's rules."""
RANKED = (*HEADLINE, RANK_KEY)
"""What has an interval, means of objects, and ranks."""

_ORDER = "object median, 95th percentile, RMSE and maximum are out of order"
_BIAS = "bias or shift-free MAE is above the MAE, which no error has"
_TAIL = "object median or 95th percentile is above what MAE and RMSE leave to it"
BOUNDS = (
    ("object_median_mm", "object_p95_mm", 1.0, _ORDER),
    ("object_p95_mm", "object_max_mm", 1.0, _ORDER),
    ("object_rmse_mm", "object_max_mm", 1.0, _ORDER),
    ("object_bias_mm", "object_mae_mm", 1.0, _BIAS),
    ("object_valid_bias_mm", "object_valid_mae_mm", 1.0, _BIAS),
    ("object_shift_free_mae_mm", "object_mae_mm", 1.0, _BIAS),
    *(
        (
            key,
            key.replace("_mae_", "_rmse_"),
            1.0,
            f"{key.split('_mae')[0]} RMSE is below its MAE, which no error has",
        )
        for key in METRICS
        if key.replace("_mae_", "_rmse_") in METRICS.keys() - {key}
    ),
    # Markov's inequality: the share 1 - q of the errors is at or above their quantile q.
    ("object_median_mm", "object_mae_mm", 2.0, _TAIL),
    ("object_p95_mm", "object_mae_mm", 20.0, _TAIL),
    ("object_median_mm", "object_rmse_mm", math.sqrt(2.0), _TAIL),
    ("object_p95_mm", "object_rmse_mm", math.sqrt(20.0), _TAIL),
    *(
        (
            f"object_within_{less}mm_share",
            f"object_within_{more}mm_share",
            1.0,
            "a wider tolerance holds fewer pixels",
        )
        for less, more in pairwise(WITHIN_MM)
    ),
)
"""Of any errors, and so of means over samples, the magnitude of the first score is at most so many
times the second's; what is said where it is not."""
MIXTURES = (
    ("object_mae_mm", "object_edge_mae_mm", "object_interior_mae_mm", "object_edge_share"),
    ("object_rmse_mm", "object_edge_rmse_mm", "object_interior_rmse_mm", "object_edge_share"),
    (
        "object_mae_mm",
        "object_wide_band_mae_mm",
        "object_wide_interior_mae_mm",
        "object_wide_band_share",
    ),
    ("object_mae_mm", "", "object_valid_mae_mm", "object_missing_share"),
    ("object_interior_mae_mm", "", "object_interior_valid_mae_mm", "object_interior_missing_share"),
    ("unlit_mae_mm", "", "unlit_valid_mae_mm", "unlit_missing_share"),
)
"""The first score is that of a set of two parts, whose errors are the second (empty: any) and the
third; the fourth is the second part's share of its pixels."""

NOTES = (
    "Two-sided MAE {two_sided_mae_mm} mm, by which the leaderboard ranks: object pixels that are "
    "not measured are "
    "charged, and so is background with an answer, {invented_share} of the object's pixels. "
    "{two_sided_with_void_mae_mm} mm with the void pixels of its surface.",
    "Object: |error| median {object_median_mm}, 95th percentile {object_p95_mm}, maximum "
    "{object_max_mm} mm; pixels "
    f"within {', '.join(f'{limit} mm {{object_within_{limit}mm_share}}' for limit in WITHIN_MM)}. "
    "MAE {object_mae_range_share} of each sample's depth range.",
    "Bias {object_bias_mm} mm ({object_valid_bias_mm} mm where measured); MAE "
    "{object_shift_free_mae_mm} mm once each "
    "sample's best single offset is removed.",
    f"MAE {{object_wide_band_mae_mm}} mm within {WIDE_BAND_PX} px of depth edges, "
    f"{{object_wide_interior_mae_mm}} mm "
    "inside.",
    "Object pixels near a depth edge: {object_edge_share}.",
    "Object pixels not measured: {object_missing_share} ({object_interior_missing_share} of those "
    "away from edges), "
    "scored with their whole depth. MAE where measured: {object_valid_mae_mm} mm, away from edges "
    "{object_interior_valid_mae_mm} mm.",
    "Void pixels, in no set: {void_share} of the image (unlit, or of mixed depths).",
    "Unlit pixels: MAE {unlit_mae_mm}, RMSE {unlit_rmse_mm} mm; {unlit_missing_share} not "
    "measured, MAE of the others "
    "{unlit_valid_mae_mm} mm.",
)
"""What the terminal says below its table; a line whose first score may be left out of a file is
left out with it."""


_sigma = partial(Metric, helped_by_missing=True, optional=False)
_STATED = (
    *(
        _sigma(
            f"coverage_{percent}",
            f"Pixels with a sigma in their {percent}% interval",
            "share",
            methodcaller("within", percent),
            f"share of these with |e| <= z s, z of the central Gaussian interval of {percent}%",
            better="neither",
            terminal=f"In {percent}%\ninterval",
        )
        for percent in COVERED
    ),
    _sigma(
        "sigma_mean_mm",
        "Mean sigma",
        "mm",
        "sigma_mean_mm",
        "mean of s over these",
        terminal="Sigma\nmean",
    ),
    _sigma(
        "sigma_median_mm",
        "Median sigma",
        "mm",
        "sigma_median_mm",
        "median of s over these",
        terminal="Sigma\nmedian",
    ),
    _sigma(
        "nll",
        "Negative log-likelihood, nats",
        "nats",
        "nll",
        "mean over these of ln s' + ln(2 pi) / 2 + min(|e| / s', 10)^2 / 2, with s' = max(s, 0.01 "
        "mm)",
        terminal="NLL",
    ),
    *(
        _sigma(
            f"ause_{error}_mm",
            f"AUSE, {error.upper()}",
            "mm",
            methodcaller("area_mm", f"{error}_mm"),
            f"{error.upper()} without the share x of least sure pixels, minus that without the "
            f"share x of largest "
            "errors; mean over x = 0, 0.05, ... 0.95",
            cancels=True,
            terminal="AUSE\nMAE" if error == "mae" else "",
        )
        for error in ("mae", "rmse")
    ),
    *(
        _sigma(
            f"sure_{error}_mm",
            f"{error.upper()} of the surest 95%",
            "mm",
            methodcaller("sure_mm", f"{error}_mm"),
            f"{error.upper()} without the 5% of least sure pixels",
            terminal=f"{error.upper()} of the\nsurest 95%",
        )
        for error in ("mae", "rmse")
    ),
    _sigma(
        "unstated_share",
        "Object without a sigma",
        "share",
        "unstated_share",
        "share of object pixels that state none",
        terminal="Not\nstated",
    ),
)
UNCERTAINTY = {metric.key: metric for metric in _STATED}
"""Scores of a stated uncertainty (``{sample}.sigma.npy``), a block of their own in a result; ``of``
gets a `SigmaSample`."""


def with_column(width: int) -> list[Metric]:
    """Those with a column in the leaderboard's tables where the terminal has ``width`` characters,
    the most important and the errors over the object first."""
    shown = (metric for metric in METRICS.values() if metric.column and metric.column_from <= width)

    def place(metric: Metric) -> tuple[int, bool, bool]:
        return (
            metric.column_from,
            metric.role != "rank",
            not (metric.headline and metric.over == "object"),
        )

    return sorted(shown, key=place)


def sort_keys() -> tuple[str, ...]:
    """What the leaderboard can be sorted by."""
    keys = (key for key, metric in METRICS.items() if not metric.helped_by_missing)
    return (*keys, "seconds_per_sample", "frames_used")


_VARIED = re.compile(r"MAE|RMSE|\d+(?= mm|%)")
"""What the rules of neighbouring entries may differ in and still share a line."""


def protocol_table(metrics: Iterable[Metric]) -> list[str]:
    """Lines of the table in PROTOCOL.md; neighbours of the same rule share a line. Units are in the
    keys. A direction is named where it is not "lower"."""
    other = {
        "lower": "",
        "higher": " (higher is better)",
        "nearer 0": " (nearer 0 is better)",
        "neither": " (neither)",
    }
    lines = ["| key | rule |", "|---|---|"]
    for (rule, better), entries in groupby(
        metrics, lambda m: (_VARIED.sub("{}", m.rule), m.better)
    ):
        alike = list(entries)
        values = zip(*(_VARIED.findall(metric.rule) for metric in alike), strict=True)
        said = rule.format(*(", ".join(dict.fromkeys(options)) for options in values)).replace(
            "|", "\\|"
        )
        lines.append(
            f"| {', '.join(f'`{metric.key}`' for metric in alike)} | {said}{other[better]} |"
        )
    return lines
