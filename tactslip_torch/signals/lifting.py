"""A wavelet that can be learned: lifting steps, so that whatever is learned is a wavelet.

Lifting (Sweldens 1996; Daubechies and Sweldens 1998) splits a signal into its even and odd samples
and adds to each a filter of the other, in turn; every step is undone by subtracting the same. So
what is taken apart is put together again for any taps at all. Three steps here: of ``rbio2.2``

    s = e + U o        an update, one tap for each tap of ``dec_lo`` beside its middle
    d = o + P s        a prediction
    s = s + t d        a correction of one tap, zero in the named wavelet

and of ``bior2.2`` the same with ``e`` and ``o``, high pass and low pass in each other's place. With
``V`` the size of the sum of U, of P ``1 / (1 + V)`` and ``t = (1 - V^2) / 2`` in size make both
high passes blind to a constant, as a wavelet must be (Cohen, Daubechies and Feauveau 1992): that is
built in, with V the exponential of a number. What may be learned is that number and how U and P
are spread over their taps; three numbers of ``rbio2.2``, whose filters stay six taps long. A gain
is none of them: branches are reconstructed, so it cancels.

Admissible is not well-conditioned: far from a named wavelet branches of many levels outgrow their
bin, while the guards of features take for rounding what is rounding beside the bin. Parameters of
about a tenth, as under weight decay, keep the branches of four levels about as large as the bin.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from tactslip_torch.signals.filter_bank import Bank, WaveletFilters
from tactslip_torch.signals.wavelet import ExtensionMode, branches_by, named_bank

_ROUNDING = 1e-12


class _Steps(NamedTuple):
    """Lifting steps of a named wavelet; filters are ``[L]``, without their gains.

    Attributes:
        is_low: whether the filter of the first step, the shorter, is the low pass.
        own, other: the middle tap of the shorter and of the longer filter, as a 1 in ``[L]``.
        first: places of the first step's taps, a 1 in each row, ``[u, L]``.
        shifts: of the second step's taps, by how much they shift the shorter filter, ``[p]``.
        taps, next_taps: of both steps, ``[u]`` and ``[p]``.
        gain, other_gain: of the shorter and the longer filter.
    """

    is_low: bool
    own: Tensor
    other: Tensor
    first: Tensor
    shifts: tuple[int, ...]
    taps: Tensor
    next_taps: Tensor
    gain: float
    other_gain: float


class LiftedWavelet(nn.Module):
    """A biorthogonal wavelet with learnable lifting steps, at first exactly a named one.

    It reconstructs, and a constant has no detail, whatever the parameters. They are float64 and 0
    at first; the dtype of everything here.

    Args:
        wavelet: where to start: ``rbio2.2``, ``bior2.2`` or another of the families whose shorter
            filter has one or two taps beside its middle (``haar``, ``bior1.x``, ``bior2.x``,
            ``rbio1.x``, ``rbio2.x``).

    Attributes:
        spread: of the first step over its taps, ``[u]``; its mean is of no effect.
        next_spread: of the second step, ``[p]``, likewise.
        log_sum: log of the sum of the first step, ``[]``.

    Raises:
        ValueError: if the wavelet is unknown, or is not made by such steps.

    Example:
        >>> wavelet = LiftedWavelet("rbio2.2")
        >>> wavelet.branch_matrix(100, 4).shape  # differentiable in its parameters
        torch.Size([8, 100, 100])
    """

    def __init__(self, wavelet: str = "rbio2.2") -> None:
        super().__init__()
        self.wavelet = wavelet
        self._named = _factored(wavelet)
        self.spread = nn.Parameter(torch.zeros_like(self._named.taps))
        self.next_spread = nn.Parameter(torch.zeros_like(self._named.next_taps))
        self.log_sum = nn.Parameter(torch.zeros((), dtype=torch.float64))

    @property
    def filter_bank(self) -> Bank:
        """``dec_lo``, ``dec_hi``, ``rec_lo`` and ``rec_hi``, to which gradients flow.

        Shape:
            - output: four ``[L]``
        """
        steps = _moved(self._named, self.log_sum)
        total = self.log_sum.exp()
        sign = 1.0 if steps.is_low else -1.0
        taps = _spread(steps.taps, self.spread, sign * (total - 1))
        next_taps = _spread(steps.next_taps, self.next_spread, sign * (0.5 - 1 / (1 + total)))
        shorter = steps.own + taps @ steps.first
        shifted = torch.stack([shorter.roll(shift) for shift in steps.shifts])
        longer = steps.other + next_taps @ shifted
        shorter = shorter + sign * (1 - total.square()) / 2 * longer
        shorter = steps.gain * (2 / (1 + total)) * shorter  # as tall as before on a constant
        longer = steps.other_gain * ((1 + total) / 2) * longer
        low, high = (shorter, longer) if steps.is_low else (longer, shorter)
        turns = torch.ones_like(low)
        turns[::2] = -1
        return low, high, turns * high, -turns * low

    def branch_matrix(
        self, num_samples: int, level: int = 4, mode: ExtensionMode = "symmetric"
    ) -> Tensor:
        """The branches of a bin as one matrix, through ptwt, to which gradients flow.

        Shape:
            - output: ``[2 * level, n, n]``, float64; ``branches = matrix @ x``

        Raises:
            ValueError: if the bin is too short for the level.
        """
        identity = torch.eye(num_samples, dtype=torch.float64, device=self.log_sum.device)
        name = f"a learned {self.wavelet}"
        branches = branches_by(identity, self.filter_bank, level, mode, name)
        return branches.movedim(0, -1).contiguous()

    def frozen(self, name: str | None = None) -> WaveletFilters:
        """The filters as they are now, for ``FeaturePool`` and a file.

        Args:
            name: for people; by default that of the start and ``, learned``.

        Raises:
            ValueError: if they are not finite.
        """
        low, high, low_back, high_back = (tuple(taps.tolist()) for taps in self.filter_bank)
        return WaveletFilters(
            f"{self.wavelet}, learned" if name is None else name, low, high, low_back, high_back
        )


def _moved(steps: _Steps, like: Tensor) -> _Steps:
    """The steps where the parameters are."""
    parts: list[Any] = [part.to(like) if isinstance(part, Tensor) else part for part in steps]
    return _Steps(*parts)


def _spread(taps: Tensor, spread: Tensor, more: Tensor) -> Tensor:
    """Taps with another spread, and so much more in sum."""
    return taps + (spread - spread.mean()) + more / len(taps)


def _factored(wavelet: str) -> _Steps:
    """The steps of a named wavelet.

    Raises:
        ValueError: if it is unknown, or not made by such steps.
    """
    low, high, *_ = named_bank(wavelet)
    steps = _divided(low, high, is_low=True) or _divided(high, low, is_low=False)
    if steps is None:
        raise ValueError(
            f"{wavelet} is not made by two lifting steps; start at rbio2.2 or another of haar, "
            "bior1.x, bior2.x, rbio1.x, rbio2.x"
        )
    return steps


def _divided(shorter: Tensor, longer: Tensor, *, is_low: bool) -> _Steps | None:
    """The steps of two filters, if the even or the odd taps of the shorter are only one."""
    places = torch.arange(len(shorter))
    for parity in (0, 1):
        is_own = places % 2 == parity
        own = places[is_own & (shorter != 0)]
        first = places[~is_own & (shorter != 0)]
        reached = places[is_own & (longer != 0)]
        if len(own) != 1 or not len(first) or not len(reached):
            continue
        middle, gain = int(own), float(shorter[own])
        unit = shorter / gain
        shifts = tuple((reached - middle).tolist())
        rest = longer - longer[reached] @ torch.stack([unit.roll(shift) for shift in shifts])
        other = int(rest.abs().argmax())
        other_gain = float(rest[other])
        rest[other] = 0
        if rest.abs().max() > _ROUNDING:
            continue
        identity = torch.eye(len(shorter), dtype=torch.float64)
        return _Steps(
            is_low,
            identity[middle],
            identity[other],
            identity[first],
            shifts,
            unit[first],
            longer[reached] / other_gain,
            gain,
            other_gain,
        )
    return None
