"""Descents side by side: each step is a closed-form fit of all groups and the gradient of it."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import lightning as L
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.held_out_gradient import held_out_scores
from tactslip_torch.model.kernels import Polynomial
from tactslip_torch.tuning.bins import TuningBins
from tactslip_torch.tuning.learned import LearnedSettings
from tactslip_torch.tuning.objective import GroupedLoss, grouped_loss

WAVELET_ROOM = 0.1
"""How far a lifting parameter may go: within it the norm of a branch stays below 3 (1.3 at first,
``tests/test_lifting.py``)."""


class Descent(nn.Module):
    """Settings that are learned on some groups, while another that no step meets is looked at.

    Args:
        settings: what is learned, in place.
        bins: of the groups to learn on, at least two.
        held: of the group that is only looked at.

    Attributes:
        history: a row for each state, the first before any step: ``loss`` and
            ``balanced_accuracy``, of a held group ``held_loss`` and ``held_accuracy``.
    """

    def __init__(
        self, settings: LearnedSettings, bins: TuningBins, held: TuningBins | None = None
    ) -> None:
        super().__init__()
        self.settings, self.bins, self.held = settings, bins, held
        self.history: list[dict[str, float]] = []

    def forward(self) -> Tensor:
        """The loss as settings are now, ``[]``; written down."""
        found, held = self.judged()
        row = {
            "loss": float(found.loss.detach()),
            "balanced_accuracy": found.balanced_accuracy,
        }
        if held is not None:
            row |= {"held_loss": float(held.loss), "held_accuracy": held.balanced_accuracy}
        self.history.append(row)
        return found.loss

    def judged(self) -> tuple[GroupedLoss, GroupedLoss | None]:
        """How good settings are now: on their own groups left out in turn, and on the held one."""
        settings, bins = self.settings, self.bins
        z = settings.scaled(settings.features(bins))
        scores = held_out_scores(
            z, bins.is_slip, bins.group, settings.penalty, settings.offset, bins.weights
        )
        found = grouped_loss(scores, bins.is_slip, bins.group)
        if self.held is None:
            return found, None
        with torch.no_grad():
            kernel = Polynomial(2, float(settings.offset))
            machine = fit_machine(
                TrainingBins(z.detach(), bins.is_slip, bins.weights),
                float(settings.penalty),
                kernel,
            )
            of_held: Tensor = machine(settings.scaled(settings.features(self.held)))
        held = grouped_loss(of_held, self.held.is_slip, self.held.group, found.calibration)
        return found, held


class TuningModule(L.LightningModule):
    """Takes all descents down together, a step an epoch, each on its own bins at once.

    Logs ``stop_loss``, the mean over held groups, for an ``EarlyStopping`` to watch.

    Args:
        rotations: descents that hold a group each.
        final: the descent on all groups.
        rate: step length of Adam.
        filter_rate: the same for filters, whose parameters are parts of a tap.

    Attributes:
        states: what ``final`` had learned after each number of steps, as state dicts.
    """

    def __init__(
        self, rotations: Sequence[Descent], final: Descent, rate: float, filter_rate: float
    ) -> None:
        super().__init__()
        self.rotations, self.final = list(rotations), final
        self._registered = nn.ModuleList(rotations)
        self.rate, self.filter_rate = rate, filter_rate
        self.states: list[dict[str, Tensor]] = []

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Adam, on what is learned."""
        of_filters, others = list[nn.Parameter](), list[nn.Parameter]()
        for name, parameter in self.named_parameters():
            if parameter.requires_grad:
                is_filter = ".smoothing." in name or ".wavelet." in name
                (of_filters if is_filter else others).append(parameter)
        rates = ((others, self.rate), (of_filters, self.filter_rate))
        return torch.optim.Adam([{"params": own, "lr": rate} for own, rate in rates if own])

    def train_dataloader(self) -> DataLoader[int]:
        """One batch an epoch; the bins are here already."""
        return DataLoader([0], batch_size=None)  # type: ignore[arg-type]  # a list is a dataset

    def training_step(self, batch: int, batch_idx: int) -> Tensor:
        """The losses of all descents, which share no parameter, as a sum."""
        loss = self.look()
        self.log("stop_loss", self.stop_losses()[-1])
        return loss

    def on_train_batch_end(self, *_: object) -> None:
        """Keep wavelets near where they start: much further, branches magnify what they are of."""
        with torch.no_grad():
            for descent in (*self.rotations, self.final):
                if (wavelet := descent.settings.wavelet) is not None:
                    for parameter in wavelet.parameters():
                        parameter.clamp_(-WAVELET_ROOM, WAVELET_ROOM)

    def look(self) -> Tensor:
        """Judge all descents where they are, and write it down."""
        self.states.append(copy.deepcopy(self.final.settings.state_dict()))
        losses = [descent() for descent in (*self.rotations, self.final)]
        return torch.stack(losses).sum()

    def stop_losses(self, without: int | None = None) -> list[float]:
        """Mean loss over held groups, or all but one of them, after each number of steps."""
        rows = [
            [row["held_loss"] for row in rotation.history]
            for place, rotation in enumerate(self.rotations)
            if place != without
        ]
        return [sum(step) / len(step) for step in zip(*rows, strict=True)]
