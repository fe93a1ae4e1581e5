"""The log of a training: a JSON line for each epoch, and the curve as a picture."""

import json
from pathlib import Path
from typing import Any

from fpp_ml_bench.files import write_atomically

LOG_FILE, CURVE_FILE = "log.jsonl", "curve.png"
Record = dict[str, Any]


def write_log(folder: Path, history: list[Record]) -> None:
    """``log.jsonl``: epoch (from 1), learning_rate, losses, the evaluator's scores in mm, seconds."""
    lines = "".join(json.dumps(record, allow_nan=False) + "\n" for record in history)
    write_atomically(folder / LOG_FILE, lines.encode("utf-8"))


def draw_curve(folder: Path, history: list[Record], title: str) -> None:
    """``curve.png``: losses, the validation object MAE and the learning rate over the epochs; the best epoch marked."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    if not history:
        return
    epochs = [record["epoch"] for record in history]
    best = min(history, key=lambda record: record["validation_loss"])
    figure = Figure(figsize=(10, 3.2), layout="constrained", dpi=110)
    losses, scores, rate = figure.subplots(1, 3)
    losses.plot(epochs, [record["training_loss"] for record in history], label="training")
    losses.plot(epochs, [record["validation_loss"] for record in history], label="validation")
    losses.plot(best["epoch"], best["validation_loss"], "o", color="black", label=f"kept: epoch {best['epoch']}")
    losses.set(title="loss", xlabel="epoch", yscale="log")
    losses.legend(frameon=False)
    measured = [(record["epoch"], record["object_mae_mm"]) for record in history if record["object_mae_mm"] is not None]
    scores.plot(*zip(*measured, strict=True) if measured else ([], []), color="tab:green")
    scores.set(title="validation object MAE, mm", xlabel="epoch")
    rate.step(epochs, [record["learning_rate"] for record in history], where="mid", color="tab:red")
    rate.set(title="learning rate", xlabel="epoch", yscale="log")
    for axes in (losses, scores, rate):
        axes.grid(alpha=0.3)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.suptitle(title, fontsize=10)
    temporary = folder / f".{CURVE_FILE}.tmp.png"
    FigureCanvasAgg(figure).print_png(temporary)
    temporary.replace(folder / CURVE_FILE)
