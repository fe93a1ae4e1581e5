"""Recipes: a YAML file for each row of a table, with the differences from the recipe it extends
(Sections 5.3-5.6). Resolved with a preset, which sets what depends on the machine, it is every
number that a training depends on."""

import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from fpp_ml_bench.constants import CONFIGS
from fpp_ml_bench.depth import Normalisation
from fpp_ml_bench.errors import RecipeError
from fpp_ml_bench.evaluation.submission.prediction_files import read_plain_file
from fpp_ml_bench.files import is_file, printable
from fpp_ml_bench.options import nearest
from fpp_ml_bench.schema import Positive, StrictModel, Text, problems_of

RECIPES = Path(__file__).resolve().parent.parent / "recipes"
_LONGEST_CHAIN = 8
ROWS: dict[str, tuple[str, ...]] = {
    "normalization": ("raw", "global", "individual"),
    "background_removed": ("raw", "global", "individual"),
    "multi_frame": ("frame0", "horizontal", "vertical", "sinusoidal", "all"),
    "loss": (
        "rmse",
        "l1",
        "masked_rmse",
        "masked_l1",
        "hybrid_rmse_0.5",
        "hybrid_rmse_0.7",
        "hybrid_rmse_0.9",
        "hybrid_l1_0.5",
        "hybrid_l1_0.7",
        "hybrid_l1_0.9",
    ),
    "architecture": ("unet", "transunet", "resunet", "pix2pix", "pix2pixhd", "hformer"),
    "further": ("plain", "guided", "physics"),
}
"""The paper's order; ``pix2pixhd`` is the authors' code, ``hformer`` the conference version's.
``further`` is no table of the paper: two of its further directions, and the network without
them."""
TABLES = tuple(ROWS)
PRESETS = ("small", "paper")
SEED = 42
"""Of the shipped recipes; a preset may name further ones."""
LOSSES = ("rmse", "l1", "masked_rmse", "masked_l1", "hybrid_rmse", "hybrid_l1")
GAN = "gan"
NETWORK_TITLES = {
    "unet": "UNet",
    "transunet": "TransUNet",
    "resunet": "ResUNet",
    "hformer": "Hformer",
    "pix2pix": "pix2pixHD",
    "pix2pix_unet": "Pix2Pix",
}
GENERATORS = "pix2pix", "pix2pix_unet"
"""Networks that a GAN trains."""
_OPTION_TITLES = {"standardised": "input standardised", "guided": "guided by phase"}
"""What the UNet's options are called in a title; in a name they stand as they are."""


def check_loss(name: str, alpha: float | None) -> None:
    """Raise `RecipeError` unless ``name`` is one of `LOSSES` and ``alpha`` is given exactly where
    it has a meaning."""
    if name not in LOSSES:
        raise RecipeError(f"unknown loss {name!r}; there are {', '.join(LOSSES)}")
    hybrid = name.startswith("hybrid_")
    if not hybrid and alpha is not None:
        raise RecipeError(
            f"loss {name} takes no alpha, got {alpha!r}; leave it out, or name hybrid_rmse or "
            f"hybrid_l1"
        )
    if hybrid and (
        isinstance(alpha, bool) or not isinstance(alpha, int | float) or not 0 <= alpha <= 1
    ):
        raise RecipeError(
            f"loss {name} needs alpha, the weight of the object's part, from 0 to 1, got {alpha!r}"
        )


class RmsProp(StrictModel):
    """``torch.optim.RMSprop``."""

    name: Literal["rmsprop"]
    learning_rate: Positive
    alpha: Annotated[float, Field(ge=0, lt=1)]
    weight_decay: Annotated[float, Field(ge=0)]


class Plateau(StrictModel):
    """The rate times ``factor`` after more than ``patience`` epochs without a lower loss; over at
    ``minimum``."""

    name: Literal["plateau"]
    factor: Annotated[float, Field(gt=0, lt=1)]
    patience: Annotated[int, Field(ge=0)]
    minimum: Positive


class Linear(StrictModel):
    """The rate constant for ``constant`` epochs, then down to zero in a line over ``decay`` epochs;
    then done."""

    name: Literal["linear"]
    constant: Annotated[int, Field(ge=0)]
    decay: Annotated[int, Field(ge=1)]


class Loss(StrictModel):
    """A name of `LOSSES` or ``gan``. Hybrids need ``alpha``; a GAN with it has
    the hybrid L1 instead of pix2pixHD's depth terms. ``physics``: weight of
    the re-projection of depth to phase (`networks.re_projection_loss`)."""

    name: Text
    alpha: Annotated[float, Field(ge=0, le=1)] | None = None
    physics: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _check(self) -> "Loss":
        if self.name != GAN:
            check_loss(self.name, self.alpha)
        elif self.physics is not None:
            raise ValueError("loss gan takes no physics")
        return self

    @property
    def label(self) -> str:
        label = self.name if self.alpha is None else f"{self.name}_{self.alpha:g}"
        return label if self.physics is None else f"{label}_physics_{self.physics:g}"


class Recipe(StrictModel):
    """Everything that a training depends on. ``size``: the image's width and height in px.
    ``pairs_per_epoch`` are drawn for each epoch, ``validation_pairs`` evenly over the validation
    split; null takes all. ``frames``: those that are training pairs of their own, one of `CONFIGS`.
    ``options`` go to `networks.build`. ``fold``: k of n, for a training without the objects of part
    k (from 0) of all, dealt into n parts; null trains on the training split."""

    preset: Text
    size: Annotated[int, Field(ge=16)]
    network: Text
    width: Annotated[int, Field(ge=1)]
    options: dict[Text, int | float] = Field(default_factory=dict)
    normalisation: Normalisation
    background_removed: bool
    frames: Text
    loss: Loss
    optimizer: RmsProp
    schedule: Annotated[Plateau | Linear, Field(discriminator="name")]
    fold: (
        Annotated[
            tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=3)]], Field(strict=False)
        ]
        | None
    ) = None
    batch: Annotated[int, Field(ge=1)]
    seed: Annotated[int, Field(ge=0, lt=2**31)]
    max_epochs: Annotated[int, Field(ge=1)]
    pairs_per_epoch: Annotated[int, Field(ge=1)] | None
    validation_pairs: Annotated[int, Field(ge=1)] | None
    precision: Literal["fp32", "bf16"]
    compile: bool

    @model_validator(mode="after")
    def _consistent(self) -> "Recipe":
        if self.network not in NETWORK_TITLES:
            raise ValueError(
                f"network: expected one of {', '.join(NETWORK_TITLES)}, got {self.network!r}"
            )
        if {"width", "name"} & set(self.options):
            raise ValueError("options: width and network are keys of their own, and no options")
        if self.frames not in CONFIGS:
            raise ValueError(f"frames: expected one of {', '.join(CONFIGS)}, got {self.frames!r}")
        if (self.loss.name == GAN) != (self.network in GENERATORS):
            raise ValueError(f"loss gan and network {' or '.join(GENERATORS)} belong together")
        if self.fold is not None and self.fold[0] >= self.fold[1]:
            raise ValueError(
                f"fold: expected a part from 0 to {self.fold[1] - 1}, got {self.fold[0]}"
            )
        if self.loss.physics is not None and (
            self.normalisation == "individual" or self.frames != "single_shot"
        ):
            raise ValueError(
                "loss: physics needs depth in mm or m, of frame 0 (normalisation raw or global, "
                "frames single_shot)"
            )
        if self.network in GENERATORS and self.normalisation != "individual":
            raise ValueError(
                f"network {self.network} answers in [0, 1], so its normalisation must be individual"
            )
        return self

    @property
    def name(self) -> str:
        """Name of runs and weights; rows that train the same network have the same name."""
        return "-".join(self._described())

    @property
    def title(self) -> str:
        """For people: network, normalisation, loss, and the settings that differ from the paper's
        usual ones."""
        return ", ".join(self._described().values())

    def _described(self) -> dict[str, str]:
        """Each part of the name, and of the title."""
        label, frames = self.loss.label, self.frames
        parts = {self.network: NETWORK_TITLES[self.network], self.normalisation: self.normalisation}
        parts[label] = label.replace("_", " ")
        if self.background_removed:
            parts["bgremoved"] = "background removed"
        parts |= {flag: title for flag, title in _OPTION_TITLES.items() if self.options.get(flag)}
        if frames != "single_shot":
            parts[frames] = f"trained on {frames} frames"
        if self.seed != SEED:
            parts[f"seed_{self.seed}"] = f"seed {self.seed}"
        if self.fold is not None:
            fold = "fold {} of {}".format(*self.fold)
            parts[fold.replace(" ", "_")] = fold
        return parts

    @property
    def epochs(self) -> int:
        """At most; a plateau may end the training sooner."""
        schedule, most = self.schedule, self.max_epochs
        return (
            min(schedule.constant + schedule.decay, most) if isinstance(schedule, Linear) else most
        )

    def to_dict(self) -> dict[str, Any]:
        return self.model_dump(mode="json")

    @property
    def digest(self) -> str:
        """SHA-256 of everything above, 64 hex digits."""
        return hashlib.sha256(json.dumps(self.to_dict(), sort_keys=True).encode()).hexdigest()


def table_rows(table: str) -> tuple[str, ...]:
    """Row names of a table in the paper's order. RecipeError for an unknown table."""
    if table not in ROWS:
        raise RecipeError(f"expected a table out of {', '.join(TABLES)}, got {printable(table)!r}")
    return ROWS[table]


def further_seeds(recipe: Recipe) -> list[int]:
    """Seeds beside its own with which the recipe's preset trains it; none for most."""
    return list(_preset(recipe.preset).get("seeds", {}).get(recipe.name, []))


def about_preset(preset: str) -> str:
    """What networks of a preset are beside the paper's, in a sentence."""
    return str(_preset(preset)["about"])


def load_recipe(name_or_path: str | Path, preset: str = PRESETS[0]) -> Recipe:
    """A shipped recipe by name (``loss/hybrid_l1_0.7``) or a YAML file of yours, resolved with a
    preset, which scales the shipped recipes alone. RecipeError for an unknown recipe, preset or
    key, an impossible value, or an endless chain of ``extends``."""
    path = _recipe_path(name_or_path)
    shipped, own = _resolved(path, 0)
    content = _merge(shipped, own)
    network = content.get("network")
    if not isinstance(network, str) or network not in NETWORK_TITLES:
        raise RecipeError(
            f"{path}: network: expected one of {', '.join(NETWORK_TITLES)}, got "
            f"{printable(repr(network), 60)}"
        )
    scale = _preset(preset)
    merged = _merge(shipped, scale["every"], pick=True)
    merged = _merge(
        merged, scale["normalisations"].get(str(content.get("normalisation")), {}), pick=True
    )
    merged = _merge(_merge(merged, scale["networks"].get(network, {})), own)
    return recipe_from_dict({"size": scale["size"], **merged, "preset": preset}, path)


def recipe_from_dict(content: dict[str, Any], path: Path = Path("recipe")) -> Recipe:
    """A `Recipe` of its plain mapping; RecipeError names ``path`` and every key that is wrong."""
    try:
        return Recipe.model_validate(content)
    except ValidationError as error:
        lines = "\n  ".join(problems_of(error))
        raise RecipeError(f"{printable(path)} is no valid recipe:\n  {lines}") from None


def _recipe_path(name_or_path: str | Path) -> Path:
    text = str(name_or_path)
    if text.endswith((".yaml", ".yml")):
        path = Path(text)
        if not is_file(path):
            raise RecipeError(f"{printable(text, 500)}: there is no such recipe file")
        return path
    path = RECIPES / f"{text}.yaml"
    if ".." in Path(text).parts or Path(text).is_absolute() or not is_file(path):
        names = [*(f"{table}/{row}" for table in TABLES for row in ROWS[table]), "base"]
        closest = nearest(text, names, 3) or names[:3]
        raise RecipeError(
            f"no recipe {printable(text, 100)!r}; near it: {', '.join(closest)}. Give one of the "
            f"shipped names (see "
            "fpp-bench reproduce --list) or a .yaml file"
        )
    return path


def _resolved(path: Path, depth: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Content of a recipe merged over the recipes it extends: that of shipped recipes, and that of
    the user's files."""
    if depth > _LONGEST_CHAIN:
        raise RecipeError(
            f"{path}: more than {_LONGEST_CHAIN} recipes extend one another; does one extend "
            f"itself?"
        )
    content = _read(path)
    parent = content.pop("extends", None)
    is_users_own = not path.resolve().is_relative_to(RECIPES)
    if parent is None:
        return ({}, content) if is_users_own else (content, {})
    if not isinstance(parent, str):
        raise RecipeError(
            f"{path}: extends: expected a recipe's name, like base, got "
            f"{printable(repr(parent), 60)}"
        )
    beside = path.parent / parent
    try:
        extended = (
            beside
            if beside.suffix in (".yaml", ".yml") and is_file(beside)
            else _recipe_path(parent)
        )
    except RecipeError as error:
        raise RecipeError(f"{path}: extends: {error}") from None
    shipped, own = _resolved(extended, depth + 1)
    return (shipped, _merge(own, content)) if is_users_own else (_merge(shipped, content), own)


def _merge(below: dict[str, Any], above: dict[str, Any], pick: bool = False) -> dict[str, Any]:
    """``above`` over ``below``; mappings key by key, but one with a ``name`` of its own, or
    ``options``, as a whole. ``pick``: keys of nested mappings that ``below`` does not have (another
    kind of schedule) are left out."""
    merged = dict(below)
    for key, value in above.items():
        old = below.get(key)
        if (
            isinstance(value, dict)
            and isinstance(old, dict)
            and "name" not in value
            and key != "options"
        ):
            merged[key] = {**old, **{k: v for k, v in value.items() if not pick or k in old}}
        else:
            merged[key] = value
    return merged


@cache
def _preset(name: str) -> dict[str, Any]:
    if name not in PRESETS:
        raise RecipeError(f"expected a preset out of {', '.join(PRESETS)}, got {printable(name)!r}")
    return _read(RECIPES / "presets" / f"{name}.yaml")


def _read(path: Path) -> dict[Any, Any]:
    return read_plain_file(path, "'normalisation: raw'", RecipeError)
