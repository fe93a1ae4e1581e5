"""Counterfactual scenes (own probe): does the predicted depth follow the fringe's phase, or the object's outline?

Each test object is rendered again with a single property changed: its phase but not its outline or brightness, its
outline but not its phase, no fringes inside or outside it, fringes of the other direction or of another pitch. The
correct change of depth is known for each scene. A score compares it with the change of the prediction
(`fpp_ml_bench.baselines.diagnostics.reliance`).
"""

from pathlib import Path
from typing import TYPE_CHECKING

from fpp_ml_bench.baselines.diagnostics.counterfactual_report import draw, summary, tables
from fpp_ml_bench.baselines.diagnostics.counterfactual_scenes import VIEWS_PER_OBJECT, SceneSet
from fpp_ml_bench.baselines.diagnostics.probe import Finding, ProbeSettings, Progress
from fpp_ml_bench.baselines.diagnostics.reliance_measure import measure
from fpp_ml_bench.baselines.diagnostics.subjects import Subject

if TYPE_CHECKING:
    from fpp_ml_bench.loaders.storage import DatasetFolder

MOST_VIEWS = 6


class Counterfactual:
    """The phase-reliance score over the counterfactual scenes of all test objects, with its parts and pictures."""

    name = "counterfactual"
    title = "Counterfactual scenes"
    question = "Does the predicted depth follow the fringe's phase, or the object's outline?"
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
        scene_set = SceneSet(dataset, views)
        reliance, samples = measure(subject, scene_set, subject.weights_sha256, progress)
        return Finding(
            self.name,
            self.title,
            summary(reliance),
            {
                "reliance": reliance.model_dump(mode="json"),
                "per_sample": {
                    sample.sample: {"score": sample.score, "order_free_score": sample.order_free_score, **sample.parts}
                    for sample in samples
                },
            },
            tables(reliance, samples),
            draw(subject, scene_set, reliance, samples, folder),
        )
