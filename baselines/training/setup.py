"""From a recipe to the data, the objective with its networks, and the configuration in the weights file."""

from pathlib import Path
from typing import Any

from torch import nn

from fpp_ml_bench.baselines import networks
from fpp_ml_bench.baselines.training.objectives import Adversarial, Objective, Regression
from fpp_ml_bench.baselines.training.provenance_of_data import training_benchmark
from fpp_ml_bench.baselines.training.recipe import Recipe
from fpp_ml_bench.baselines.training.tables import GAN
from fpp_ml_bench.baselines.training.weights import ModelConfig
from fpp_ml_bench.errors import TrainingError
from fpp_ml_bench.loaders.training import FringeDepthDataset


def open_data(recipe: Recipe, dataset: Path) -> tuple[FringeDepthDataset, FringeDepthDataset]:
    """Training and validation pairs. TrainingError for another image size than the recipe's, or an empty split."""
    datasets = []
    for split in ("train", "validation"):
        data = FringeDepthDataset(dataset, split, recipe.data_config, recipe.normalisation, recipe.background_removed)
        if data.source.size != (recipe.size, recipe.size):
            height, width = data.source.size
            raise TrainingError(
                f"{dataset}: holds images of {width} x {height} px, recipe {recipe.name} with preset {recipe.preset} "
                f"expects {recipe.size} x {recipe.size}; build the size it needs: fpp-bench build DIR --preset full "
                f"--size {recipe.size}"
            )
        if not len(data):
            raise TrainingError(f"{dataset}: split {split} holds no sample; training needs train and validation")
        datasets.append(data)
    return datasets[0], datasets[1]


def objective_of(recipe: Recipe) -> Objective:
    """The objective of a recipe, with freshly initialised networks. Seed torch first."""
    network = networks.build(recipe.network, width=recipe.width, **recipe.options)
    if recipe.loss.name == GAN:
        return Adversarial(network, networks.discriminator(width=recipe.width))
    return Regression(network, recipe.loss.name, recipe.loss.alpha)


def model_config(
    recipe: Recipe, network: nn.Module, fingerprint: str, epoch: int, scores: dict[str, Any]
) -> ModelConfig:
    """Configuration for the weights file."""
    return ModelConfig(
        name=recipe.name,
        title=recipe.title,
        network=recipe.network,
        options=dict(network.options),  # type: ignore[arg-type, call-overload]
        normalisation=recipe.normalisation,
        image_size=(recipe.size, recipe.size),
        dataset_fingerprint=fingerprint,
        benchmark=training_benchmark(fingerprint),
        data_config=recipe.data_config,
        background_removed=recipe.background_removed,
        recipe=recipe.to_dict(),
        epoch=epoch,
        validation=scores,
    )
