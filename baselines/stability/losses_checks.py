"""Checks of losses and training metrics: values and gradients in ill-conditioned and extreme cases."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from fpp_ml_bench.baselines.stability.case import Outcome, refusal, worst
from fpp_ml_bench.baselines.stability.roundoff import U32, U64, gamma
from fpp_ml_bench.baselines.training import EPSILON, loss_function, sample_losses
from fpp_ml_bench.errors import PredictionError
from fpp_ml_bench.evaluation.score import DepthScores

_SHAPE = (2, 1, 24, 32)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread, which is faster for images of 64 px."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _alpha(name: str) -> float | None:
    return 0.7 if name.startswith("hybrid") else None


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _scene(scale: float, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    target = torch.rand(_SHAPE, generator=seeded(1), dtype=torch.float64) + 0.5
    target[..., :9, :] = 0
    prediction = target + 0.1 * torch.randn(_SHAPE, generator=seeded(2), dtype=torch.float64)
    return (scale * prediction).to(dtype), (scale * target).to(dtype)


def _exact_loss(name: str, prediction: Tensor, target: Tensor) -> float:
    """The loss by exactly rounded sums in float64."""
    errors = (prediction.double() - target.double()).flatten().tolist()
    inside = [error for error, depth in zip(errors, target.flatten().tolist(), strict=True) if depth > 0]

    def part(values: list[float]) -> float:
        if not values:
            return 0.0
        if name.endswith("rmse"):
            return math.sqrt(math.fsum(value * value for value in values) / len(values) + EPSILON)
        return math.fsum(map(abs, values)) / len(values)

    alpha = _alpha(name)
    if alpha is not None:
        return alpha * part(inside) + (1 - alpha) * part(errors)
    return part(inside) if name.startswith("masked") else part(errors)


def zero_residual(name: str) -> Outcome:
    """Value and gradient where the prediction is perfect: 0/0 for a bare square root."""
    _, target = _scene(1.0)
    prediction = target.clone().requires_grad_()
    loss = loss_function(name, _alpha(name))(prediction, target)
    loss.backward()
    gradient = prediction.grad
    if gradient is None or not bool(torch.isfinite(gradient).all()):
        return Outcome(math.inf, 0.0, note="a gradient that is not finite")
    exact = math.sqrt(EPSILON) if name.endswith("rmse") else 0.0
    return worst([float(loss.detach()) - exact, float(gradient.abs().max())], [4 * U32 * exact, 0.0])


def empty_mask(name: str) -> Outcome:
    """No object pixels: a masked mean would be 0/0."""
    prediction, _ = _scene(1.0)
    target = torch.zeros(_SHAPE)
    prediction = prediction.clone().requires_grad_()
    loss = loss_function(name, _alpha(name))(prediction, target)
    loss.backward()
    per_sample = sample_losses(name, _alpha(name), prediction.detach(), target)
    if prediction.grad is None or not bool(torch.isfinite(prediction.grad).all() and torch.isfinite(per_sample).all()):
        return Outcome(math.inf, 0.0, note="a loss or gradient that is not finite")
    exact = _exact_loss(name, prediction.detach(), target)
    return worst([float(loss.detach()) - exact], [gamma(32, U32) * exact])


def loss_magnitude(name: str, scale: float) -> Outcome:
    prediction, target = _scene(scale)
    value = float(loss_function(name, _alpha(name))(prediction, target))
    exact = _exact_loss(name, prediction, target)
    if math.isinf(value):
        return Outcome(None, flagged=1.0, note="an infinite loss, on which training stops")
    # Torch sums in vectors and pairs: log2(n) + 16 roundings, doubled by the square.
    return worst([value - exact], [gamma(2 * (math.log2(prediction.numel()) + 16), U32) * exact])


def loss_half(name: str, dtype: str, scale: float) -> Outcome:
    """Half-precision input of this size: 2,100 mm squared is beyond float16."""
    prediction, target = _scene(scale, getattr(torch, dtype))
    value = float(loss_function(name, _alpha(name))(prediction, target))
    if not math.isfinite(float(prediction.float().abs().max())):
        if math.isfinite(value):
            return Outcome(value, 0.0)
        return Outcome(None, flagged=1.0, note="infinite input gives an infinite loss")
    exact = _exact_loss(name, prediction, target)
    return worst([value - exact], [gamma(2 * (math.log2(prediction.numel()) + 16), U32) * exact])


def directional(function: Callable[[Tensor], Tensor], x: Tensor, smooth: bool) -> Outcome:
    """Autograd's derivative along a random direction against Richardson's extrapolated difference quotient."""
    step = 1e-3 if smooth else 1e-7
    seed = torch.randn(x.shape, generator=seeded(8), dtype=x.dtype)
    seed = seed / seed.norm()
    inner = x.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(inner), inner)
    slope = float((gradient * seed).sum())

    def quotient(h: float) -> float:
        with torch.no_grad():
            return float(function(x + h * seed) - function(x - h * seed)) / (2 * h)

    at_step, at_double, at_quadruple = quotient(step), quotient(2 * step), quotient(4 * step)
    with torch.no_grad():
        value = abs(float(function(x)))
    first, second = (4 * at_step - at_double) / 3, (4 * at_double - at_quadruple) / 3
    rounding = 64 * U64 * max(value, 1e-300) * math.sqrt(x.numel()) / step
    return worst([slope - first], [abs(first - second) + abs(at_step - at_double) * 1e-3 + rounding])


def loss_gradient(name: str) -> Outcome:
    prediction, target = _scene(1.0, torch.float64)
    prediction = target + torch.sign(prediction - target) * (0.05 + (prediction - target).abs())  # away from |.|'s kink
    loss = loss_function(name, _alpha(name))
    return directional(lambda x: loss(x, target), prediction, smooth=True)


def metric_scale(scale: float) -> Outcome:
    """The evaluator's scores as a training metric, over many updates."""
    metric = DepthScores()
    target = torch.zeros((1, 20, 20), dtype=torch.float64)
    target[:, 5:15, 5:15] = 4096 * scale
    errors = scale * torch.randint(1, 999, (50, 20, 20), generator=seeded(14)).double()
    try:
        for error in errors:
            metric.update(target + error[None], target)
    except PredictionError as error:
        return Outcome(None, flagged=1.0, note=str(error))
    rmse_mm = float(metric.compute()["overall_rmse_mm"])
    exact = (target + errors) - target
    roots = [
        scale
        * math.sqrt(
            math.fsum((value / scale) ** 2 for value in sample_errors.flatten().tolist()) / sample_errors.numel()
        )
        for sample_errors in exact
    ]
    exact_rmse_mm = math.fsum(roots) / len(roots)
    return worst([rmse_mm / exact_rmse_mm - 1], [gamma(460) + 2 * 2.0**-1074 / max(exact_rmse_mm, 2.0**-1074)])


def metric_refuses(value: float) -> Outcome:
    target = torch.full((1, 8, 8), 1800.0, dtype=torch.float64)
    prediction = target.clone()
    prediction[0, 1, 2] = value
    return refusal(lambda: DepthScores().update(prediction, target), PredictionError)
