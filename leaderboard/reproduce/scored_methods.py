"""A trained network as the methods that are scored: its bare output, and its metric twins."""

from fpp_ml_bench.baselines.method import Setting
from fpp_ml_bench.baselines.networks import Model, NetworkMethod
from fpp_ml_bench.baselines.training import TrainingRun
from fpp_ml_bench.leaderboard.reproduce.plan import Job, Variant


def named_method(job: Job, variant: Variant, model: Model, run: TrainingRun) -> NetworkMethod:
    """The method of one row of ``job``, whose training was ``run``; title and settings say so."""
    about: dict[str, Setting] = {
        "recipe_digest": job.recipe.digest,
        "epochs_trained": run.epochs,
        "training_seconds": round(run.seconds, 1),
    }
    return NetworkMethod(model, variant.depth_range, remark=f"{job.recipe.preset} preset", about=about)
