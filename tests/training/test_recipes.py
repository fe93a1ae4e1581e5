"""Recipes: one a row, each a difference; nothing unknown passes."""

import pytest

from fpp_ml_bench.baselines.training.recipe import (
    PRESETS,
    RECIPES,
    TABLES,
    Linear,
    Plateau,
    further_seeds,
    load_recipe,
    recipe_from_dict,
    table_rows,
)
from fpp_ml_bench.errors import RecipeError
from fpp_ml_bench.leaderboard.tables import paper_tables

NAMES = [f"{table}/{row}" for table in TABLES for row in table_rows(table)]


def test_further_directions_differ_from_the_plain_unet_in_one_thing():
    plain = load_recipe("normalization/global").to_dict()
    assert load_recipe("further/plain").to_dict() == plain
    for name, changed in (("further/guided", "options"), ("further/physics", "loss")):
        other = load_recipe(name).to_dict()
        assert {key for key in other if other[key] != plain[key]} == {changed}
    assert load_recipe("further/guided").name == "unet-global-rmse-guided"
    options = {"guided": 1, "standardised": 1}
    both = recipe_from_dict({**plain, "options": options})
    assert (both.name, both.title.split(", ")[3:]) == (
        "unet-global-rmse-standardised-guided",
        ["input standardised", "guided by phase"],
    )
    assert load_recipe("further/physics").name == "unet-global-rmse_physics_0.05"
    with pytest.raises(RecipeError, match="physics needs depth in mm or m"):
        recipe_from_dict(
            {**load_recipe("further/physics").to_dict(), "normalisation": "individual"}
        )
    with pytest.raises(RecipeError, match="gan takes no physics"):
        recipe_from_dict(
            {
                **load_recipe("architecture/pix2pix").to_dict(),
                "loss": {"name": "gan", "physics": 1.0},
            }
        )


def test_every_row_of_the_paper_has_a_recipe():
    assert {table: len(table_rows(table)) for table in TABLES} == {
        "normalization": 3,
        "background_removed": 3,
        "multi_frame": 5,
        "loss": 10,
        "architecture": 6,
        "further": 3,
    }
    assert set(TABLES) - set(paper_tables()) == {"further"}
    for name, table in paper_tables().items():
        assert [row.row for row in table.rows] == [
            row for row in table_rows(name) if row not in ("hformer", "pix2pixhd")
        ]
    shipped = sorted(
        str(path.relative_to(RECIPES).with_suffix("")) for path in RECIPES.glob("*/*.yaml")
    )
    assert shipped == sorted([*NAMES, *(f"presets/{preset}" for preset in PRESETS)])


def test_the_papers_recipe():
    """Section 5.3: RMSprop 0.99, 1e-4, 1e-5; batch 4; plateau 0.5, 10, 1e-6; seed 42."""
    recipe = load_recipe("normalization/individual", "paper")
    rule = recipe.optimizer
    assert (rule.alpha, rule.learning_rate, rule.weight_decay) == (0.99, 1e-4, 1e-5)
    assert recipe.schedule == Plateau(name="plateau", factor=0.5, patience=10, minimum=1e-6)
    assert (recipe.batch, recipe.seed, recipe.size, recipe.width) == (4, 42, 960, 64)
    assert recipe.pairs_per_epoch is None and recipe.validation_pairs is None


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("table", TABLES)
def test_rows_of_a_table_differ_in_what_the_table_is_about(table, preset):
    about = {
        "normalization": {"normalisation"},
        "background_removed": {"normalisation"},
        "multi_frame": {"frames"},
        "loss": {"loss"},
        "architecture": {"network", "width", "options", "loss", "schedule"},
        "further": {"options", "loss"},
    }[table]
    if table in (
        "normalization",
        "background_removed",
    ):  # raw targets need a higher rate in the small presets
        about |= {"small": {"optimizer"}, "paper": set()}[preset]
    recipes = [load_recipe(f"{table}/{row}", preset) for row in table_rows(table)]
    rows = [recipe.to_dict() for recipe in recipes]
    differing = {key for row in rows for key in row if row[key] != rows[0][key]}
    assert differing <= about
    assert len({recipe.digest for recipe in recipes}) == len(rows)


def test_all_rows_of_the_small_preset_have_one_schedule():
    schedules = {load_recipe(name, "small").schedule for name in NAMES}
    assert schedules == {Linear(name="linear", constant=24, decay=24)}
    assert {load_recipe(name, "small").epochs for name in NAMES} == {48}
    assert load_recipe("loss/l1", "paper").epochs == 1000


def test_seeds_and_folds_have_names_of_their_own():
    recipe = load_recipe("normalization/raw")
    assert further_seeds(recipe) == [1, 2] and further_seeds(load_recipe("loss/l1")) == []
    assert further_seeds(load_recipe("normalization/raw", "paper")) == []
    other = recipe_from_dict({**recipe.to_dict(), "seed": 1, "fold": [2, 5]})
    assert other.name == "unet-raw-rmse-seed_1-fold_2_of_5" and other.title.endswith(
        "seed 1, fold 2 of 5"
    )
    with pytest.raises(RecipeError, match="expected a part from 0 to 4, got 5"):
        recipe_from_dict({**recipe.to_dict(), "fold": [5, 5]})


def test_background_is_removed_in_its_table_alone():
    removed = [name for name in NAMES if load_recipe(name).background_removed]
    assert removed == [f"background_removed/{row}" for row in table_rows("background_removed")]


def test_the_gan_has_its_own_schedule():
    for name in ("pix2pix", "pix2pixhd"):
        recipe = load_recipe(f"architecture/{name}", "paper")
        assert recipe.schedule == Linear(name="linear", constant=100, decay=100)
    assert (recipe.network, recipe.loss.label) == ("pix2pix", "gan")
    assert (
        load_recipe("architecture/pix2pix", "small").loss.label == "gan_0.7"
    )  # the table's caption: hybrid L1
    assert load_recipe("architecture/pix2pix", "small").options == {"levels": 5}


def test_a_recipe_of_yours(tmp_path):
    (tmp_path / "parent.yaml").write_text("extends: loss/l1\noptimizer: {learning_rate: 1e-3}\n")
    own_recipe = tmp_path / "mine.yaml"
    own_recipe.write_text("extends: parent.yaml\nseed: 7\nschedule: {patience: 3}\n")
    recipe = load_recipe(own_recipe, "paper")
    assert load_recipe(tmp_path / "parent.yaml", "small").optimizer.learning_rate == 1e-3
    assert load_recipe(tmp_path / "parent.yaml", "small").width == 8
    assert (recipe.seed, recipe.loss.name, recipe.optimizer.learning_rate) == (7, "l1", 1e-3)
    assert recipe.optimizer.weight_decay == 1e-5
    assert recipe.schedule == Plateau(name="plateau", factor=0.5, patience=3, minimum=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("learning_rat: 1e-3", "learning_rat: is not a key"),
        ("optimizer: {momentum: 0.9}", "optimizer.momentum: is not a key"),
        ("batch: 0", "batch: .*greater than or equal to 1"),
        ("batch: '4'", "batch: .*valid integer"),
        ("frames: diagonal", "frames: expected one of single_shot"),
        ("network: vgg", "network: expected one of unet"),
        ("normalisation: log", "normalisation: "),
        ("loss: {name: hybrid_l1}", "hybrid_l1 needs alpha"),
        ("loss: {name: gan}", "belong together"),
        ("network: pix2pix\nloss: {name: gan}\nnormalisation: raw", r"answers in \[0, 1\]"),
        ("schedule: {name: cosine}", "schedule: "),
        ("optimizer: {learning_rate: .nan}", "learning_rate: "),
        ("precision: fp8", "precision: "),
        ("seed: -1", "seed: "),
        ("normalisation: [raw]", "normalisation: "),
        ("options: {width: 3}", "options: width and network are keys of their own"),
        ("extends: mine.yaml", "does one extend itself"),
        ("extends: 3", "expected a recipe's name"),
        ("extends: loss/l2", "no recipe 'loss/l2'; near it: loss/l1"),
        ("- a\n- list", "expected keys and values like 'normalisation: raw'"),
        ("batch: 4\nbatch: 5", "is given twice"),
    ],
)
def test_refused(tmp_path, text, message):
    own_recipe = tmp_path / "mine.yaml"
    own_recipe.write_text(
        text if "extends" in text or text.startswith("-") else f"extends: base\n{text}"
    )
    with pytest.raises(RecipeError, match=message):
        load_recipe(own_recipe)


def test_unknown_names():
    with pytest.raises(RecipeError, match="expected a table out of normalization"):
        table_rows("normalisation")
    with pytest.raises(RecipeError, match="near it: normalization/raw"):
        load_recipe("normalisation/raw")
    with pytest.raises(RecipeError, match="expected a preset out of small, paper"):
        load_recipe("base", "gpu")
    with pytest.raises(RecipeError, match="there is no such recipe file"):
        load_recipe("nowhere.yaml")
    with pytest.raises(RecipeError, match="no recipe"):
        load_recipe("../recipes/base")


def test_a_recipe_survives_its_dictionary():
    for name in NAMES:
        recipe = load_recipe(name)
        assert recipe_from_dict(recipe.to_dict()).digest == recipe.digest
