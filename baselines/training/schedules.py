"""The learning rate over the epochs, and the end of a training by it. The rules themselves are torch's."""

import math
from typing import Any

import torch
from torch.optim import SGD
from torch.optim.lr_scheduler import LambdaLR, ReduceLROnPlateau

from fpp_ml_bench.baselines.training.recipe import Linear, Plateau

_RELATIVE = 1e-9
"""1e-4 x 0.1 x 0.1 is 1.0000000000000002e-06: a rate this near to its minimum has reached it."""


class Schedule:
    """``rate`` of the coming epoch; `step` after each epoch with its validation loss; ``finished`` when it says so.

    All optimisers of a training share this rate: it is that of an optimiser without parameters.
    """

    def __init__(self, rule: Plateau | Linear, rate: float) -> None:
        self.rule, self.epochs = rule, 0
        self._holder = SGD([torch.zeros(1)], lr=rate)
        self._scheduler: Any
        if isinstance(rule, Plateau):
            # eps: below 1e-8, its default, no step would be taken any more and the minimum never reached.
            self._scheduler = ReduceLROnPlateau(
                self._holder, factor=rule.factor, patience=rule.patience, min_lr=rule.minimum, eps=0.0
            )
        else:
            length = rule.constant + rule.decay
            self._scheduler = LambdaLR(self._holder, lambda epoch: min(1.0, max(0, length - epoch) / rule.decay))

    @property
    def rate(self) -> float:
        return float(self._holder.param_groups[0]["lr"])

    @property
    def finished(self) -> bool:
        """The rate is at its minimum (plateau), or all epochs are over (linear)."""
        if isinstance(self.rule, Linear):
            return self.epochs >= self.rule.constant + self.rule.decay
        return self.rate <= self.rule.minimum * (1 + _RELATIVE)

    def step(self, validation_loss: float) -> None:
        """Update the rate with the validation loss of the epoch that ended."""
        self.epochs += 1
        self._holder.step()  # no effect; torch warns unless it runs before the scheduler
        if isinstance(self.rule, Linear):
            self._scheduler.step()
        else:
            self._scheduler.step(validation_loss)

    def state(self) -> dict[str, Any]:
        """Plain numbers for `restore`."""
        if isinstance(self.rule, Linear):
            return {"epochs": self.epochs}
        best = self._scheduler.best
        return {
            "epochs": self.epochs, "rate": self.rate, "bad": self._scheduler.num_bad_epochs,
            "best": best if math.isfinite(best) else None,
        }  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from the numbers of `state`."""
        if isinstance(self.rule, Linear):
            for _ in range(state["epochs"]):
                self.step(0.0)
            return
        self.epochs = state["epochs"]
        self._holder.param_groups[0]["lr"] = state["rate"]
        self._scheduler.num_bad_epochs, self._scheduler.last_epoch = state["bad"], state["epochs"]
        self._scheduler.best = math.inf if state["best"] is None else state["best"]
