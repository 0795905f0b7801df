"""Judging one bin or a few by NumPy, whose calls take a third of the time of PyTorch's.

The same arithmetic as the modules', on views of their tensors, to rounding. A live loop spends
most of its time between calls, not in them.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from tactslip_torch.features.ops import saturating
from tactslip_torch.features.pool import LARGEST_SAMPLE, FeaturePool
from tactslip_torch.model.kernels import Head, QuadraticForm
from tactslip_torch.model.prediction import Prediction
from tactslip_torch.model.scaling import FeatureScaler

Array = np.ndarray[Any, Any]


FEW_BINS = 4
"""Of so few raw bins, calls take longer than the arithmetic in them."""
FEW_FILTERED = 16
"""Of so few filtered bins: a push of a stream brings some ten."""


class Parts(Protocol):
    """What is asked of a detector."""

    pool: FeaturePool
    scaler: FeatureScaler
    head: Head

    def columns(self, features: Tensor, is_missing: Tensor | None = None) -> Tensor:
        """What the scaler takes."""

    @property
    def needed_index(self) -> Tensor:
        """Channels in use, ascending."""


class FewBins:
    """Scaler and head of a detector, and the tests of its channels, on the CPU and for values.

    Args:
        parts: a detector whose scaler and head are such as ``suits``.
    """

    def __init__(self, parts: Parts) -> None:
        assert isinstance(parts.head, QuadraticForm)  # suits
        self._of = _held(parts)
        self._pool, self._scaler, head = parts.pool, parts.scaler, parts.head
        self._columns = parts.columns
        # views: what is changed in place, as by load_state_dict, is seen here
        self._minimum, self._maximum = parts.scaler.minimum.numpy(), parts.scaler.maximum.numpy()
        self._knee = None if parts.scaler.knee is None else parts.scaler.knee.numpy()
        self._quadratic = head.quadratic.numpy()
        self._linear, self._constant = head.linear.numpy(), head.constant.numpy()
        self._needed = parts.needed_index.numpy()
        self._tiny = np.finfo(self._minimum.dtype).tiny

    @staticmethod
    def suits(scaler: FeatureScaler, head: Head) -> bool:
        """Whether these are of the usual kind: a quadratic form, on the CPU and for values."""
        tensors = [*scaler.buffers(), *head.buffers()]
        return (
            type(head) is QuadraticForm
            and type(scaler) is FeatureScaler
            and all(each.device.type == "cpu" and not each.requires_grad for each in tensors)
        )

    def is_of(self, parts: Parts) -> bool:
        """Whether it was made of these, none of their tensors replaced since."""
        now = _held(parts)
        return len(now) == len(self._of) and all(map(operator.is_, now, self._of))

    def score(self, features: Tensor, dtype: torch.dtype) -> Tensor:
        """Scores ``[*]`` of selected features ``[*, K]``."""
        with np.errstate(all="ignore"):
            return self._score(self._scaled(self._columns(features)), dtype)

    def predict(
        self,
        features_of: Callable[[Tensor], Tensor],
        bins: Tensor,
        given: torch.dtype,
        without: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
    ) -> Prediction:
        """Scores of filtered bins ``[*, C, n]``, valid by the dtype they were ``given`` in.

        What to make of missing channels, ``without`` is asked (``MissingScores``).
        """
        with np.errstate(all="ignore"):
            is_alive, is_missing = self._trust(bins, given)
            is_whole = not is_missing.any()
            if not is_whole:
                bins = bins.masked_fill(torch.from_numpy(is_missing)[..., None], 0.0)
            lost = None if is_whole else torch.from_numpy(is_missing)
            scaled = self._scaled(self._columns(features_of(bins), lost))
            score = self._score(scaled, given)
            variance = torch.zeros_like(score)
            if lost is not None:
                score, variance = without(score, torch.from_numpy(np.asarray(scaled)), lost)
            is_trusted = (is_alive & ~is_missing)[..., self._needed].all(-1)
            is_valid = np.asarray(is_trusted & np.isfinite(score.numpy()))
        return Prediction(score, torch.from_numpy(is_valid), torch.from_numpy(is_missing), variance)

    def _scaled(self, features: Tensor) -> Array:
        """As ``FeatureScaler``, in the dtype of the head."""
        x, width = features.numpy(), self._maximum - self._minimum
        if not width.min() > 0:  # a constant feature
            return self._usual(features)
        if self._knee is not None:
            size = np.abs(x)
            ratio = size / self._knee
            if not ratio.max(initial=0.0) < math.inf:
                return self._usual(features)
            bent = np.where(ratio < self._tiny, size, self._knee * np.log1p(ratio))
            x = np.copysign(bent, x)
        scaled: Array = (2 * ((x - self._minimum) / width) - 1).clip(-1, 1)
        return scaled.astype(self._linear.dtype, copy=False)

    def _usual(self, features: Tensor) -> Array:
        usual: Array = self._scaler(features).numpy()
        return usual.astype(self._linear.dtype, copy=False)

    def _score(self, scaled: Array, dtype: torch.dtype) -> Tensor:
        """As ``QuadraticForm``, saturating at the largest number of a dtype."""
        pull = self._linear
        if self._quadratic.size:
            pull = scaled @ self._quadratic + pull
        return saturating(
            torch.from_numpy(np.asarray((pull * scaled).sum(-1) + self._constant)), dtype
        )

    def _trust(self, bins: Tensor, given: torch.dtype) -> tuple[Array, Array]:
        """Which channels are alive as ``given``, and which are missing in ``bins``, ``[*, C]``."""
        high, low = bins.amax(-1), bins.amin(-1)
        largest = min(LARGEST_SAMPLE, torch.finfo(bins.dtype).max)
        is_missing = ~(torch.maximum(high, -low) <= largest)
        high, low = high.to(given), low.to(given)  # rounding keeps the order
        span = (high - low) * self._pool.inverse_span(high)
        return (span > torch.maximum(high, -low)).numpy(), is_missing.numpy()


def _held(parts: Parts) -> tuple[Any, ...]:
    scaler, head = parts.scaler, parts.head
    tensors = (*scaler._buffers.values(), *head._buffers.values())
    return (parts.pool, scaler, head, *tensors)
