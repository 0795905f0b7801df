"""A detector to be timed: the main job's selection, a head fitted to some simulated bins.

Time does not depend on what a head has learned; its size does, and that is the main job's. All
heads that are compared are fitted to the same bins with the same kernel and penalty.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.bins import WINDOW_LENGTHS, labelled_bins
from benchmarks.engines import DTYPES, ENGINES, FLOAT64, pool_of, selected_extractor
from benchmarks.selection import kept_selection, selection_of
from tactslip_torch.features.extractor import EngineName
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.fit import TrainingBins, fit_machine
from tactslip_torch.model.kernels import KernelSum, Polynomial, QuadraticForm, kernel_from_dict
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.signals.filtering import ChannelFilter


@dataclass(frozen=True, eq=False)
class Timed:
    """What detectors are made of.

    Args:
        selection: names of the features and where they come from.
        selected: their pool indices.
        scaler: of these.
        head: the quadratic form.
        z: scaled features of the bins it was fitted to, ``[N, K]``.
        is_slip: of these bins, ``[N]``.
        kernel: of the head.
        penalty: likewise.
    """

    selection: Mapping[str, Any]
    selected: tuple[int, ...]
    scaler: FeatureScaler = field(repr=False)
    head: QuadraticForm | KernelSum = field(repr=False)
    z: Tensor = field(repr=False)
    is_slip: Tensor = field(repr=False)
    kernel: Polynomial
    penalty: float

    @property
    def targets(self) -> Tensor:
        """+-1, ``[N]``."""
        return torch.where(self.is_slip, 1.0, -1.0).double()

    def detector(self, engine: EngineName, dtype: str) -> SlipDetector:
        """A detector of its own by this engine, in a dtype of ``DTYPES``."""
        parts = copy.deepcopy((self.scaler, self.head))
        made = SlipDetector(
            pool_of(dtype), ChannelFilter(WINDOW_LENGTHS), self.selected, *parts, engine=engine
        )
        return made.to(DTYPES[dtype].dtype).eval()

    def kernel_sum(self) -> KernelSum:
        """The same machine as a sum over the bins it was fitted to."""
        beta = self.penalty * (self.targets - self.head(self.z))
        return KernelSum(self.z, beta, self.kernel)


@torch.no_grad()
def timed_detector(num_recordings: int, model: Path | None = None) -> Timed:
    """Fit a head of the main job's size.

    Args:
        num_recordings: simulated, of whose bins it is fitted.
        model: a trained detector whose selection and ranges are taken; default: the selection
            that is kept, with ranges of these bins.

    Raises:
        FileNotFoundError: if there is no such detector.
        ValueError: if it is damaged, or is not of the paper's hand and bins.
    """
    trained = None if model is None else SlipDetector.load(model)
    selection = kept_selection() if trained is None else selection_of(trained)
    pool = pool_of(FLOAT64)
    if trained is not None and trained.pool.names != pool.names:
        raise ValueError(
            f"{model} is of another hand than the paper's, with {len(trained.pool.names)} "
            f"features in its pool instead of {len(pool.names)}; train with the default hand"
        )
    place = {str(name): index for index, name in enumerate(pool.names)}
    selected = tuple(place[name] for name in selection["names"])
    bins, is_slip = labelled_bins(num_recordings)
    features = selected_extractor(ENGINES[-1], FLOAT64, selected)(bins)
    scaler = FeatureScaler.fit(features, compress=True) if trained is None else trained.scaler
    z = scaler(features)
    kernel = kernel_from_dict(selection["trained"]["kernel"])
    if not isinstance(kernel, Polynomial):
        raise ValueError(f"{model} has a {kernel}, expected a polynomial of degree 2")
    penalty = float(selection["trained"]["penalty"])
    head = fit_machine(TrainingBins(z, is_slip), penalty, kernel)
    return Timed(selection, selected, scaler, head, z, is_slip, kernel, penalty)
