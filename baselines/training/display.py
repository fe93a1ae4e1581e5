"""The progress bar of a training: epochs, losses, the score in mm, the rate and the time left."""

from types import TracebackType
from typing import Any

from fpp_ml_bench.baselines.training.history import Record
from fpp_ml_bench.baselines.training.recipe import Linear, Recipe


class Display:
    """A rich progress bar on standard error; silent when ``show`` is False.

    The time left counts to ``max_epochs`` (to the schedule's end for a linear one): a plateau may end it sooner.
    """

    def __init__(self, recipe: Recipe, steps: int, show: bool) -> None:
        self.recipe, self.steps = recipe, max(1, steps)
        self.progress: Any = None
        if not show:
            return
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        self.progress = Progress(
            TextColumn("{task.description}"), BarColumn(bar_width=20), TextColumn("{task.fields[state]}"),
            TimeElapsedColumn(), TextColumn("left at most"), TimeRemainingColumn(), console=Console(stderr=True),
        )  # fmt: skip

    @property
    def epochs(self) -> int:
        schedule = self.recipe.schedule
        longest = schedule.constant + schedule.decay if isinstance(schedule, Linear) else self.recipe.max_epochs
        return min(longest, self.recipe.max_epochs)

    def __enter__(self) -> "Display":
        if self.progress is not None:
            self.progress.start()
            self.task = self.progress.add_task(self.recipe.name, total=self.epochs * self.steps, state="")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.progress is not None:
            self.progress.stop()

    def step(self) -> None:
        """One batch is done."""
        if self.progress is not None:
            self.progress.advance(self.task)

    def epoch_done(self, record: Record) -> None:
        """One epoch is done, now or by an earlier call."""
        if self.progress is not None:
            score = record["object_mae_mm"]
            state = (
                f"epoch {record['epoch']}/{self.epochs}  loss {record['training_loss']:.4g} / "
                f"{record['validation_loss']:.4g}  object {'-' if score is None else f'{score:.1f} mm'}  rate "
                f"{record['learning_rate']:.1e}"
            )
            self.progress.update(self.task, completed=record["epoch"] * self.steps, state=state)
