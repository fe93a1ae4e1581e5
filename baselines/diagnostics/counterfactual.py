"""Counterfactual scenes (own probe): does the answer follow the fringe's phase, or the object's outline?

Each test object is photographed again with one thing changed: its phase but not its outline or brightness, its outline
but not its phase, no fringes inside or outside it, fringes of the other direction or of another pitch. What the answer
should do is known, and one number says whether it does: `fpp_ml_bench.baselines.diagnostics.reliance`.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from fpp_ml_bench.baselines.diagnostics.counterfactual_report import draw, summary, tables
from fpp_ml_bench.baselines.diagnostics.counterfactual_scenes import VIEWS_PER_OBJECT, SceneBook
from fpp_ml_bench.baselines.diagnostics.probe import Finding, ProbeSettings, Progress
from fpp_ml_bench.baselines.diagnostics.reliance_measure import measure
from fpp_ml_bench.baselines.diagnostics.subject import Subject

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.store import DatasetFolder

MOST_VIEWS = 6


class Counterfactual:
    """Every counterfactual scene of every test object, the phase-reliance score, and what the answers look like."""

    name = "counterfactual"
    title = "Counterfactual scenes"
    question = "Does the answer follow the fringe's phase, or the object's outline?"
    version = 1

    def applies_to(self, subject: Subject) -> str | None:
        return None

    def run(
        self, subject: Subject, dataset: "DatasetFolder", settings: ProbeSettings, folder: Path, progress: Progress
    ) -> Finding:
        views = 1 if settings.quick else VIEWS_PER_OBJECT
        if settings.samples is not None:
            objects = len({dataset.measured(sample)["object"] for sample in dataset.samples("test")})
            views = min(max(settings.samples // max(objects, 1), 1), MOST_VIEWS)
        book = SceneBook(dataset, views)
        found, samples = measure(subject, book, subject.weights_sha256, progress)
        return Finding(
            self.name,
            self.title,
            summary(found),
            {
                "reliance": found.model_dump(mode="json"),
                "per_sample": {
                    one.sample: {"score": one.score, "order_free_score": one.order_free_score, **one.parts}
                    for one in samples
                },
            },
            tables(found, samples),
            draw(subject, book, found, samples, folder),
        )
