"""The tables of rows to reproduce, the presets and the losses: names only, so that help needs no torch."""

from fpp_ml_bench.errors import RecipeError

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
"""The paper's order; ``pix2pixhd`` is the authors' code, ``hformer`` the conference version's. ``further`` is no table
of the paper: two of its further directions, and the network without them."""
TABLES = tuple(ROWS)
PRESETS = ("cpu", "cpu-long", "paper")
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


def check_loss(name: str, alpha: float | None) -> None:
    """Raise `RecipeError` unless ``name`` is one of `LOSSES` and ``alpha`` is given exactly where it has a meaning."""
    if name not in LOSSES:
        raise RecipeError(f"unknown loss {name!r}; there are {', '.join(LOSSES)}")
    hybrid = name.startswith("hybrid_")
    if not hybrid and alpha is not None:
        raise RecipeError(f"loss {name} takes no alpha, got {alpha!r}; leave it out, or name hybrid_rmse or hybrid_l1")
    if hybrid and (isinstance(alpha, bool) or not isinstance(alpha, int | float) or not 0 <= alpha <= 1):
        raise RecipeError(f"loss {name} needs alpha, the weight of the object's part, from 0 to 1, got {alpha!r}")
