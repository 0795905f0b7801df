"""What a person sees while work goes on: one bar per stage, with a rate."""

from __future__ import annotations

from collections.abc import Iterable, Sized
from typing import Any

from lightning.pytorch.callbacks import TQDMProgressBar
from tqdm.auto import tqdm

LEAD = 30


def bar(items: Iterable[Any], what: str, unit: str = "step") -> Iterable[Any]:
    """``items`` with a progress bar on standard error that shows rate and time left."""
    total = len(items) if isinstance(items, Sized) else None
    shown: Iterable[Any] = tqdm(
        items, desc=f"{what:{LEAD}}", total=total, unit=f" {unit}", dynamic_ncols=True
    )
    return shown


class RecordingProgressBar(TQDMProgressBar):
    """Lightning's bar, named after the pass that is running and counting recordings.

    Args:
        verb: what making features includes, such as ``"simulate, features"``.
    """

    def __init__(self, verb: str = "features") -> None:
        super().__init__(refresh_rate=1)
        self._verb = verb

    def init_train_tqdm(self) -> Any:
        """The bar of both training passes."""
        return self._named(super().init_train_tqdm())

    def init_test_tqdm(self) -> Any:
        """The bar of the test pass."""
        progress = self._named(super().init_test_tqdm())
        progress.set_description_str(f"{self._verb + ', scores':{LEAD}}")
        return progress

    def on_train_epoch_start(self, trainer: Any, *args: Any) -> None:
        """Name the pass."""
        super().on_train_epoch_start(trainer, *args)
        what = "moments" if trainer.current_epoch == 0 else "selected features"
        self.train_progress_bar.set_description_str(f"{self._verb + ', ' + what:{LEAD}}")

    def get_metrics(self, *args: Any) -> dict[str, Any]:
        """Lightning's metrics without its version number."""
        metrics = super().get_metrics(*args)
        metrics.pop("v_num", None)
        return dict(metrics)

    @staticmethod
    def _named(progress: Any) -> Any:
        progress.unit = " recording"
        return progress
