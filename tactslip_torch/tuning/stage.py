"""Tuning as a stage of training: between a first fit, which chooses by a grid, and a second.

What is learned by gradient can fit the training materials too closely, as any choice can. So each
group is held out from a descent of its own, all of which go down in step with the one on all
groups; they stop when the mean loss of held groups no longer falls, and the step at which it was
least is taken. If that is the first, nothing is learned and the best of the grid stays.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import lightning as L
import torch
from lightning.pytorch.callbacks import EarlyStopping

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.feature_maker import FeatureMaker
from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.planning import Plan
from tactslip_torch.progress import Ticker
from tactslip_torch.recipe import Frame, Recipe
from tactslip_torch.signals.filter_bank import WaveletFilters
from tactslip_torch.tuning.bins import TuningBins, tuning_bins
from tactslip_torch.tuning.grid import GridPoint, grid_points, least_loss, most_accurate
from tactslip_torch.tuning.learned import FILTERS, SETTINGS, LearnedSettings
from tactslip_torch.tuning.module import Descent, TuningModule


class Tuned(NamedTuple):
    """What tuning found.

    Attributes:
        frame: features and ranges.
        penalty: C.
        offset: the kernel's c.
        wavelet: the wavelet, if it was learned.
        kernels: smoothing kernels by length of the frame, if they were learned.
        facts: JSON-able: curves, the grid, what was learned, seconds.
    """

    frame: Frame
    penalty: float
    offset: float
    wavelet: WaveletFilters | None
    kernels: Mapping[int, Sequence[float]] | None
    facts: dict[str, Any]

    def recipe(self, recipe: Recipe) -> Recipe:
        """The recipe with nothing left to choose."""
        facts = recipe.facts() | {
            "num_features": len(self.frame.selected),
            "penalties": self.penalty,
            "offsets": self.offset,
        }
        return Recipe(**facts)


@dataclass(frozen=True)
class Tuning:
    """How settings are learned.

    Args:
        learn: which: ``penalty``, ``offset``, ``scales``, ``smoothing``, ``wavelet``.
        bins: of each group and class, at most; a step costs the cube of their number in all.
        steps: at most.
        patience: steps without gain on held groups after which descents stop.
        rate: step length of Adam, for logarithms of C, c and scales.
        filter_rate: the same for filters, in parts of a tap.

    Raises:
        ValueError: if nothing or something unknown is to be learned, or a number is not positive.
    """

    learn: Sequence[str] = SETTINGS
    bins: int = 100
    steps: int = 40
    patience: int = 8
    rate: float = 0.05
    filter_rate: float = 0.02

    def __post_init__(self) -> None:
        unknown = [name for name in self.learn if name not in SETTINGS]
        if unknown or not self.learn:
            raise ValueError(
                f"tuning.learn must be some of {', '.join(SETTINGS)}, got {list(self.learn)}"
            )
        for name in ("bins", "steps", "patience", "rate", "filter_rate"):
            if not getattr(self, name) > 0:
                raise ValueError(f"tuning.{name} must be positive, got {getattr(self, name)}")

    def __call__(
        self,
        plan: Plan,
        recipe: Recipe,
        sample: SampledBins,
        maker: FeatureMaker,
        recordings: Sequence[RecordingId],
    ) -> Tuned:
        """Tune a plan on training bins alone.

        Args:
            plan: of the first fit.
            recipe: that made it.
            sample: bins of the first pass.
            maker: of the features, to read raw bins again where filters are learned.
            recordings: that were trained on.

        Raises:
            ValueError: if the kernel is not of degree 2, there are fewer than three groups, or a
                loss cannot be told.
        """
        if not isinstance(plan.kernel, Polynomial) or plan.kernel.degree != 2:
            raise ValueError(
                f"tuning needs a polynomial kernel of degree 2, the plan has {plan.kernel}"
            )
        if len(sample.group_names) < 3:
            raise ValueError(
                f"tuning needs three groups to hold some out, got {', '.join(sample.group_names)}; "
                "take recipe.group_by=cycle, or more materials"
            )
        started = time.perf_counter()
        reader = maker if any(name in FILTERS for name in self.learn) else None
        bins = tuning_bins(sample, plan.frame.selected, self.bins, reader, recordings)
        start = _Start(plan, recipe, maker, bins)
        rotations = [start.descent(self.learn, held) for held in range(len(bins.names))]
        module = TuningModule(rotations, start.descent(self.learn), self.rate, self.filter_rate)
        self._descend(module)
        losses = module.stop_losses()
        steps = losses.index(min(losses))
        settings = module.final.settings.requires_grad_(False)
        settings.load_state_dict(module.states[steps])
        penalty, offset = float(settings.penalty), float(settings.offset)
        points = start.points()
        facts: dict[str, Any] = {
            "learned": list(self.learn),
            "bins": len(bins.is_slip),
            "steps": steps,
            "penalty": penalty,
            "offset": offset,
            "scales": dict(zip(map(str, settings.names), settings.scales.tolist(), strict=True)),
            "grid": [point._asdict() for point in points],
            "start": least_loss(points)._asdict(),
            "history": module.final.history,
            "held": [_held_facts(module, start, place) for place in range(len(rotations))],
            "seconds": time.perf_counter() - started,
        }
        kernels = None if settings.smoothing is None else settings.smoothing.frozen()
        frame = Frame(plan.frame.selected, settings.scaler())
        return Tuned(frame, penalty, offset, settings.frozen_wavelet(), kernels, facts)

    def _descend(self, module: TuningModule) -> None:
        """All descents, until the held groups no longer gain."""
        stop = EarlyStopping("stop_loss", patience=self.patience, check_on_train_epoch_end=True)
        with Ticker("tune", "step", self.steps) as ticker, warnings.catch_warnings():
            # Lightning's, nothing a user can act on
            warnings.filterwarnings("ignore", message=r".*isinstance\(treespec, LeafSpec\).*")
            warnings.filterwarnings("ignore", message=".*does not have many workers.*")
            trainer = L.Trainer(
                accelerator="cpu",
                max_epochs=self.steps,
                callbacks=[stop, ticker.callback()],
                logger=False,
                enable_checkpointing=False,
                enable_progress_bar=False,
                enable_model_summary=False,
            )
            trainer.fit(module)
        with torch.no_grad():
            module.look()


class _Start:
    """Where descents begin: at the point of a grid that is best on the groups they learn on."""

    def __init__(self, plan: Plan, recipe: Recipe, maker: FeatureMaker, bins: TuningBins) -> None:
        self.bins = bins
        self._penalties = recipe.penalties_ascending
        self._offsets = [own.offset for own in recipe.kernels if isinstance(own, Polynomial)]
        self._scaler = plan.frame.scaler
        names = [maker.pool.names[i] for i in plan.frame.selected]
        self._parts = (self._scaler, names, maker.pool, maker.channel_filter)

    def points(self, held: int | None = None) -> list[GridPoint]:
        """The grid on all groups, or without one."""
        own = self._without(held)
        z = self._scaler(own.features)
        return grid_points(z, own.is_slip, own.group, self._penalties, self._offsets)

    def descent(self, learn: Sequence[str], held: int | None = None) -> Descent:
        """From the point of least loss."""
        return self.at(least_loss(self.points(held)), learn, held)

    def at(self, point: GridPoint, learn: Sequence[str], held: int | None) -> Descent:
        """From a point."""
        settings = LearnedSettings(learn, point.penalty, point.offset, *self._parts)
        of_held = None if held is None else self.bins.of([held])
        return Descent(settings, self._without(held), of_held)

    def _without(self, held: int | None) -> TuningBins:
        return self.bins.of([group for group in range(len(self.bins.names)) if group != held])


def _held_facts(module: TuningModule, start: _Start, place: int) -> dict[str, Any]:
    """Of a held group: what the grid gets on it, and descending as far as the others tell to.

    To stop where its own loss is least would be a choice by what it is judged by.
    """
    history = module.rotations[place].history
    losses = module.stop_losses(without=place)
    steps = losses.index(min(losses))
    with torch.no_grad():
        by_accuracy = start.at(most_accurate(start.points(place)), (), place).judged()[1]
    assert by_accuracy is not None  # a group is held

    def after(steps: int) -> dict[str, float]:
        row = history[steps]
        return {"loss": row["held_loss"], "balanced_accuracy": row["held_accuracy"]}

    return {
        "held": start.bins.names[place],
        "history": history,
        "recipe": {
            "loss": float(by_accuracy.loss),
            "balanced_accuracy": by_accuracy.balanced_accuracy,
        },
        "grid": after(0),
        "tuned": {"steps": steps, **after(steps)},
    }
