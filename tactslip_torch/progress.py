"""What a person sees while work goes on: one bar per stage, with a rate."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sized
from typing import Any

from lightning.pytorch.callbacks import TQDMProgressBar
from tqdm.auto import tqdm

LEAD = 31


def bar(
    items: Iterable[Any], what: str, unit: str = "step", total: int | None = None
) -> Iterable[Any]:
    """``items`` with a progress bar on standard error that shows rate and time left."""
    if total is None and isinstance(items, Sized):
        total = len(items)
    shown: Iterable[Any] = tqdm(
        items, desc=f"{what:{LEAD}}", total=total, unit=f" {unit}", dynamic_ncols=True
    )
    return shown


class Ticker:
    """A bar that is moved by hand, as of work on several threads.

    Args:
        what: is done.
        unit: of a step.
        total: number of steps, at most.
    """

    def __init__(self, what: str, unit: str, total: int) -> None:
        self._bar = tqdm(
            desc=f"{what:{LEAD}}", total=total, unit=f" {unit}", dynamic_ncols=True, smoothing=0
        )

    def __enter__(self) -> Ticker:
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.close()

    def tick(self) -> None:
        """A step is done."""
        self._bar.update()


class RecordingProgressBar(TQDMProgressBar):
    """Lightning's bar, named after the pass that is running and counting recordings.

    Args:
        verb: what workers do, such as ``"features"``.
    """

    def __init__(self, verb: str = "features") -> None:
        # a terminal is redrawn at every recording, a log file is not filled with bars
        super().__init__(refresh_rate=1 if sys.stderr.isatty() else 50)
        self._verb = verb

    def init_train_tqdm(self) -> Any:
        """The bar of both training passes, on standard error: standard output is for results."""
        return tqdm(unit=" recording", dynamic_ncols=True, disable=self.is_disabled, smoothing=0)

    def init_test_tqdm(self) -> Any:
        """The bar of the test pass."""
        return self.init_train_tqdm()

    def on_train_epoch_start(self, trainer: Any, *args: Any) -> None:
        """Name the pass."""
        super().on_train_epoch_start(trainer, *args)
        what = "survey" if trainer.current_epoch == 0 else "sums"
        self.train_progress_bar.set_description_str(self._stage(what))

    def on_test_batch_start(self, *args: Any, **kwargs: Any) -> None:
        """Name the pass; Lightning numbers its loaders instead."""
        super().on_test_batch_start(*args, **kwargs)
        self.test_progress_bar.set_description_str(self._stage("scores"))

    def _stage(self, what: str) -> str:
        return f"{self._verb + ', ' + what:{LEAD}}"

    def get_metrics(self, trainer: Any, pl_module: Any) -> dict[str, Any]:
        """The rate of each stage of making features, instead of Lightning's version number."""
        return dict(pl_module.rates())

    def on_test_batch_end(self, trainer: Any, pl_module: Any, *args: Any, **kwargs: Any) -> None:
        """Show rates in the test pass as well."""
        super().on_test_batch_end(trainer, pl_module, *args, **kwargs)
        self.test_progress_bar.set_postfix(self.get_metrics(trainer, pl_module), refresh=False)
