"""Tuning as a stage of training: between a first fit, which chooses by a grid, and a second.

What is learned by gradient can fit the training materials too closely, as any choice can. So each
group is held out from a descent of its own, all of which go down in step with the one on all
groups; they stop when the mean loss of held groups no longer falls, and the step at which it was
least is taken. If that is none, the point of the grid stays from which they start: that of least
loss, which need not be the most accurate one that a recipe takes.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import lightning as L
import torch
from lightning.pytorch.callbacks import EarlyStopping
from torch import Tensor

from tactslip_torch.data.splits import Split
from tactslip_torch.feature_maker import FeatureMaker
from tactslip_torch.features.bin_sample import SampledBins
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.planning import Plan
from tactslip_torch.progress import Ticker
from tactslip_torch.recipe import Frame, Recipe
from tactslip_torch.signals.filter_bank import WaveletFilters
from tactslip_torch.signals.lifting import LiftedWavelet
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
        is_list = isinstance(self.learn, Sequence) and not isinstance(self.learn, str)
        if not is_list or not self.learn or any(name not in SETTINGS for name in self.learn):
            raise ValueError(
                f"tuning.learn must be a list of some of {', '.join(SETTINGS)}, got {self.learn!r}"
            )
        for name in ("bins", "steps", "patience"):
            if type(value := getattr(self, name)) is not int or value < 1:
                raise ValueError(f"tuning.{name} must be a positive whole number, got {value!r}")
        for name in ("rate", "filter_rate"):
            value = getattr(self, name)
            if type(value) not in (int, float) or not 0 < value < math.inf:
                raise ValueError(f"tuning.{name} must be a positive number, got {value!r}")

    def check(self, recipe: Recipe, pool: FeaturePool, split: Split) -> None:
        """Refuse before any work what could not be tuned behind it.

        Raises:
            ValueError: if the recipe is nested or not of degree 2, there are fewer than three
                groups to hold some out, or something to be learned has no place to start from.
        """
        if recipe.validation == "nested":
            raise ValueError(
                "tuning needs a machine of degree 2 on features of channels, which "
                f"recipe={recipe.name} does not always make; take recipe=robust or recipe=paper"
            )
        for kernel in recipe.kernels:
            if not isinstance(kernel, Polynomial) or kernel.degree != 2:
                raise ValueError(f"tuning needs a polynomial kernel of degree 2, got {kernel}")
            if "offset" in self.learn and not kernel.offset > 0:
                raise ValueError("tuning learns log c, which needs recipe.offsets above 0")
        if not math.isfinite(recipe.penalties_ascending[-1]):
            raise ValueError("tuning needs finite recipe.penalties to start from")
        groups = sorted({recipe.group(recording) for recording in split.having("train")})
        if len(groups) < 3:
            raise ValueError(
                f"tuning needs three groups to hold some out, got {', '.join(groups)}; take "
                "recipe.group_by=cycle, or more materials"
            )
        if "wavelet" in self.learn:
            if not isinstance(pool.wavelet, str):
                raise ValueError("tuning learns a wavelet from a named one, this was learned")
            LiftedWavelet(pool.wavelet)

    def __call__(
        self,
        plan: Plan,
        recipe: Recipe,
        sample: SampledBins,
        weights: Tensor,
        maker: FeatureMaker,
        split: Split,
    ) -> Tuned:
        """Tune a plan on training bins alone.

        Args:
            plan: of the first fit.
            recipe: that made it.
            sample: bins of the first pass.
            weights: with which they stand for all that are trained on, ``[n]``.
            maker: of the features, to read raw bins again where filters are learned.
            split: that they were trained on.

        Raises:
            ValueError: as ``check``, or if scores of groups left out tell slip backwards.
        """
        self.check(recipe, maker.pool, split)
        started = time.perf_counter()
        reader = maker if any(name in FILTERS for name in self.learn) else None
        bins = tuning_bins(sample, plan.frame.selected, weights, self.bins, reader, split)
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
            "grid": [p._asdict() | {"loss": _number(p.loss)} for p in points],
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
            try:
                trainer.fit(module)
                with torch.no_grad():
                    module.look()
            except ValueError as error:
                raise ValueError(
                    f"tuning: {error}, after {len(module.states) - 1} steps; take smaller "
                    "tuning.rate, more tuning.bins, or tuning=none"
                ) from error


class _Start:
    """Where descents begin: at the point of a grid that is best on the groups they learn on."""

    def __init__(self, plan: Plan, recipe: Recipe, maker: FeatureMaker, bins: TuningBins) -> None:
        self.bins = bins
        self._penalties = recipe.penalties_ascending
        self._offsets = [own.offset for own in recipe.kernels if isinstance(own, Polynomial)]
        self._scaler = plan.frame.scaler
        names = [maker.pool.names[i] for i in plan.frame.selected]
        self._parts = (self._scaler, names, maker.pool, maker.channel_filter)
        self._points: dict[int | None, list[GridPoint]] = {}

    def points(self, held: int | None = None) -> list[GridPoint]:
        """The grid on all groups, or without one."""
        if held not in self._points:
            own = self._without(held)
            parts = (self._scaler(own.features), own.is_slip, own.group, own.weights)
            points = grid_points(*parts, self._penalties, self._offsets)
            if math.isinf(least_loss(points).loss):
                raise ValueError(
                    "tuning has no place to start: at every C and c of the recipe held-out scores "
                    "tell slip backwards or cannot be told; look at the labels, or take tuning=none"
                )
            self._points[held] = points
        return self._points[held]

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

    To stop where its own loss is least would be a choice by what it is judged by. The descents of
    the others have met it, though, and K was chosen with it: what is held out is C, c, scales and
    filters.
    """
    history = module.rotations[place].history
    losses = module.stop_losses(without=place)
    steps = losses.index(min(losses))
    with torch.no_grad():
        _, by_accuracy = start.at(most_accurate(start.points(place)), (), place).judged()
    if by_accuracy is None:
        raise AssertionError("a descent that holds a group judges it")

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


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None  # JSON has no infinity
