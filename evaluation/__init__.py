"""Evaluation: scores of depth maps, checked predictions in, `result.json` out. The rules are in
PROTOCOL.md. ``DepthScores`` is the torch metric of a training loop."""


def __getattr__(name: str) -> object:
    if name != "DepthScores":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from fpp_ml_bench.evaluation.score.torch_metric import DepthScores  # needs torch

    return DepthScores
