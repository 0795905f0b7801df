"""Wavelet branches of a bin (paper section IV-C), through ptwt.

A branch is a component *reconstructed to the bin's length*: all other coefficients are set to
zero and the transform is inverted. Every step is linear in the bin, so ``branch_matrix`` says it
all; features use the matrix, and ``wavelet_branches`` is what the matrix is made of. A wavelet is a
name that PyWavelets knows or, of one without a name, its four filters (``WaveletFilters``).

Amplitude spectra of branches, the authors' and a clean one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import pywt
import torch
from ptwt.conv_transform import wavedec, waverec
from torch import Tensor

_FILTERS = ("dec_lo", "dec_hi", "rec_lo", "rec_hi")
_TOLERANCE = 1e-9  # of reconstruction, and of the sum of a detail's filter


@dataclass(frozen=True)
class WaveletFilters:
    """A wavelet by its filters, in the order and with the delay that PyWavelets has them.

    Args:
        name: for people; it stands where a named wavelet's name would.
        dec_lo: decomposition, low pass.
        dec_hi: decomposition, high pass; sums to zero, so that a constant has no detail.
        rec_lo: reconstruction, low pass.
        rec_hi: reconstruction, high pass.

    Raises:
        ValueError: if the filters are not of one even length, not finite, do not give back what
            they took apart, or a constant has a detail.
    """

    name: str
    dec_lo: tuple[float, ...]
    dec_hi: tuple[float, ...]
    rec_lo: tuple[float, ...]
    rec_hi: tuple[float, ...]

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f"a wavelet's filters need a name, got {self.name!r}")
        for name in _FILTERS:
            object.__setattr__(self, name, _numbers(name, getattr(self, name)))
        lengths = [len(getattr(self, name)) for name in _FILTERS]
        if len(set(lengths)) > 1 or lengths[0] < 2 or lengths[0] % 2:
            raise ValueError(
                f"the filters of {self.name} must have one even length, got "
                f"{', '.join(map(str, lengths))}; fill up with zeros"
            )
        if (error := self._reconstruction_error()) > _TOLERANCE:
            raise ValueError(
                f"the filters of {self.name} do not reconstruct: off by {error:.1e}, at most "
                f"{_TOLERANCE:g} is taken; give rec_lo and rec_hi that invert dec_lo and dec_hi"
            )
        if abs(rest := math.fsum(self.dec_hi)) > _TOLERANCE:
            raise ValueError(
                f"dec_hi of {self.name} sums to {rest:.1e}, at most {_TOLERANCE:g} is taken: a "
                "constant must have no detail"
            )

    def _reconstruction_error(self) -> float:
        """How far a unit impulse comes back from itself, ``L - 1`` later, and how large its alias.

        Strang and Nguyen (1996), Wavelets and Filter Banks, section 4.1.
        """
        sign = (-1.0) ** np.arange(len(self))
        impulse = np.zeros(2 * len(self) - 1)
        impulse[len(self) - 1] = 2
        kept = np.convolve(self.dec_lo, self.rec_lo) + np.convolve(self.dec_hi, self.rec_hi)
        alias = np.convolve(sign * self.dec_lo, self.rec_lo)
        alias += np.convolve(sign * self.dec_hi, self.rec_hi)
        return float(max(np.abs(kept - impulse).max(), np.abs(alias).max()))

    def __len__(self) -> int:
        """Taps of a filter, zeros at its ends among them."""
        return len(self.dec_lo)

    def __str__(self) -> str:
        return self.name

    def to_dict(self) -> dict[str, Any]:
        """JSON-able, for ``as_wavelet``, and exact: a float comes back as it was."""
        return {key: value if key == "name" else list(value) for key, value in asdict(self).items()}


Wavelet: TypeAlias = str | WaveletFilters
"""The name of a discrete wavelet of PyWavelets, or the filters of any."""


def as_wavelet(wavelet: Wavelet | Mapping[str, Any]) -> Wavelet:
    """A wavelet as it stands in a program or, ``to_dict``, in a file.

    Raises:
        ValueError: if it is neither a name nor filters, or as ``WaveletFilters``.
    """
    if isinstance(wavelet, Mapping):
        expected = ("name", *_FILTERS)
        if set(wavelet) != set(expected):
            raise ValueError(
                f"a wavelet's filters have the keys {', '.join(expected)}, got "
                f"{', '.join(map(str, wavelet)) or 'none'}"
            )
        return WaveletFilters(**wavelet)
    if not isinstance(wavelet, (str, WaveletFilters)):
        raise ValueError(f"a wavelet is a name or its filters, got {type(wavelet).__name__}")
    return wavelet


def _numbers(name: str, values: Sequence[float]) -> tuple[float, ...]:
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must hold numbers, got {values!r}") from None
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{name} must be finite, got {numbers}")
    return numbers


def branch_names(level: int) -> tuple[str, ...]:
    """``("A1", "D1", "A2", "D2", ...)``, the order of branches everywhere.

    Example:
        >>> branch_names(2)
        ('A1', 'D1', 'A2', 'D2')
    """
    return tuple(f"{kind}{m}" for m in range(1, level + 1) for kind in "AD")


def _of_pywt(wavelet: Wavelet) -> pywt.Wavelet:
    """The wavelet as PyWavelets and ptwt take it."""
    if isinstance(wavelet, WaveletFilters):
        return pywt.Wavelet(wavelet.name, [getattr(wavelet, name) for name in _FILTERS])
    if wavelet not in pywt.wavelist(kind="discrete"):
        raise ValueError(
            f"unknown wavelet {wavelet!r}; pywt.wavelist(kind='discrete') lists the known ones"
        )
    return pywt.Wavelet(wavelet)


def highest_level(num_samples: int, wavelet: Wavelet = "rbio2.2") -> int:
    """How many levels a bin allows: so many that its ends do not reach all coefficients.

    Raises:
        ValueError: if the wavelet is unknown, or the bin too short for a single level.

    Reference:
        ``pywt.dwt_max_level``.

    Example:
        >>> highest_level(100, "rbio2.2"), highest_level(30, "db3")
        (4, 2)
    """
    length = _of_pywt(wavelet).dec_len
    highest = int(pywt.dwt_max_level(num_samples, length)) if num_samples > 0 else 0
    if highest < 1:
        raise ValueError(
            f"bins of {num_samples} samples are too short for a level of {wavelet}, which needs "
            f"{2 * (length - 1)}; use longer bins or a shorter wavelet, such as haar"
        )
    return highest


def wavelet_branches(x: Tensor, wavelet: Wavelet = "rbio2.2", level: int = 4) -> Tensor:
    """Approximations and details of a signal, each at the signal's own length.

    ``A1 + D1 = x`` and ``A(m) = A(m+1) + D(m+1)``. Gradients flow (the map is linear). The ends are
    extended half-point symmetrically, as in the paper's MATLAB (ptwt's own default is another).

    Args:
        x: filtered bin.
        wavelet: any discrete wavelet PyWavelets knows, or filters; ``rbio2.2`` in the paper.
        level: number of levels; 4 in the paper.

    Shape:
        - x: ``[*, n]``
        - output: ``[*, 2 * level, n]`` in the order of ``branch_names``

    Raises:
        ValueError: if the wavelet is unknown or the signal too short for the level.

    Reference:
        ``pywt.wavedec`` and ``pywt.waverec`` with all but one coefficient array zeroed.
    """
    num_samples = x.shape[-1]
    highest = highest_level(num_samples, wavelet)
    if not 1 <= level <= highest:
        raise ValueError(
            f"level must lie in 1..{highest} for bins of {num_samples} samples and {wavelet}, "
            f"got {level}; use fewer levels or longer bins"
        )
    filters = _of_pywt(wavelet)
    coefficients = wavedec(x.reshape(-1, num_samples), filters, mode="symmetric", level=level)
    alone = []  # each array of coefficients with zeros in place of the others, put together
    for kept in range(level + 1):
        arrays = [c if i == kept else torch.zeros_like(c) for i, c in enumerate(coefficients)]
        alone.append(waverec(arrays, filters)[..., :num_samples])
    approximation, *details = alone  # A(level), D(level), .., D1
    branches: list[Tensor] = []
    for detail in details:  # from the coarsest: A(m-1) = A(m) + D(m)
        branches = [approximation, detail, *branches]
        approximation = approximation + detail
    return torch.stack(branches, dim=-2).reshape(*x.shape[:-1], 2 * level, num_samples)


@lru_cache(maxsize=16)
def branch_matrix(num_samples: int, wavelet: Wavelet = "rbio2.2", level: int = 4) -> Tensor:
    """``wavelet_branches`` as one matrix: ``branches = matrix @ x``. Do not write into it.

    Shape:
        - output: ``[2 * level, n, n]``, float64

    Raises:
        ValueError: as ``wavelet_branches``.
    """
    with torch.inference_mode(False):  # it may be needed for a gradient later
        identity = torch.eye(num_samples, dtype=torch.float64)
        return wavelet_branches(identity, wavelet, level).movedim(0, -1).contiguous()


class _WaveletSteps(NamedTuple):
    """``branch_matrix`` in steps through the coefficients, whose matrices are narrow bands.

    Args:
        low: from a bin, or the approximation's coefficients of one level, to those of the next.
        high: from the same to the detail's coefficients.
        out: from its coefficients to each branch, in the order of ``branch_names``.

    Shape:
        - low, high: ``level`` matrices ``[r, n]``, where ``n`` is the ``r`` of the level before
        - out: ``2 * level`` matrices ``[n, r]``
    """

    low: tuple[Tensor, ...]
    high: tuple[Tensor, ...]
    out: tuple[Tensor, ...]


@lru_cache(maxsize=16)
def wavelet_steps(
    num_samples: int,
    wavelet: Wavelet = "rbio2.2",
    level: int = 4,
) -> _WaveletSteps:
    """The steps from a bin to its branches, float64. Do not write into them.

    Raises:
        ValueError: as ``wavelet_branches``.
    """
    branch_matrix(num_samples, wavelet, level)  # refuses what has no branches
    filters = _of_pywt(wavelet)
    low, high, out = [], [], []
    sizes = [num_samples]  # and of the coefficients of each level, finest first
    for _ in range(level):
        identity = torch.eye(sizes[-1], dtype=torch.float64)
        approximation, detail = wavedec(identity, filters, mode="symmetric", level=1)
        low.append(approximation.T.contiguous())
        high.append(detail.T.contiguous())
        sizes.append(len(low[-1]))
        one = torch.eye(sizes[-1], dtype=torch.float64)
        finer = [one.new_zeros(sizes[-1], size) for size in sizes[-2:0:-1]]
        for kept in ([one, 0 * one], [0 * one, one]):
            branch = waverec([*kept, *finer], filters)[..., :num_samples]
            out.append(branch.T.contiguous())
    return _WaveletSteps(tuple(low), tuple(high), tuple(out))


SpectrumMethod = Literal["reference", "clean"]


def frequency_axis_hz(
    num_samples: int, sample_rate_hz: float, method: SpectrumMethod = "reference"
) -> Tensor:
    """Frequency of each line as the pipeline uses it.

    ``reference`` reproduces the authors' axis, ``k * fs / n``, which is 2.56 times the true one
    of their zero-padded transform for n = 100; descriptors are scaled afterwards, so it is
    harmless. ``clean`` is the true axis, ``k * fs / n``.

    Shape:
        - output: ``[n]`` or ``[n // 2 + 1]``, hertz, float64

    Raises:
        ValueError: if the method is unknown or there are fewer than two samples.
    """
    _, scale = _transform(num_samples, method)
    return torch.arange(len(scale), dtype=torch.float64) * (sample_rate_hz / num_samples)


def spectrum_matrix(num_samples: int, method: SpectrumMethod = "reference") -> Tensor:
    """The one-sided spectrum, no window, mean kept, as a matrix: ``amplitude = abs(matrix @ x)``.

    ``reference`` is what the authors compute: with ``L = 2 (n - 1)``, an FFT over the next power
    of two above ``L`` (256 for n = 100, zero-padded), lines ``0 .. n-1`` of it divided by ``L``,
    all but the first and the last doubled. ``clean`` (ours) is the discrete spectrum of the bin:
    ``rfft`` over its ``n`` samples divided by ``n``, all lines but DC and Nyquist doubled, so
    that a tone on a line has its amplitude there.

    At bin lengths a constant matrix is as fast as an FFT and exports to ONNX without its slow and
    inexact DFT operator. The native engine takes an FFT for bins above 256 samples where that is
    faster.

    Shape:
        - output: ``[n, n]`` (``reference``) or ``[n // 2 + 1, n]`` (``clean``), complex128

    Raises:
        ValueError: if the method is unknown or there are fewer than two samples.
    """
    num_fft, scale = _transform(num_samples, method)
    identity = torch.eye(num_samples, dtype=torch.float64)
    lines: Tensor = torch.fft.rfft(identity, n=num_fft)[:, : len(scale)]
    return (lines * scale).T.contiguous()


def _transform(num_samples: int, method: SpectrumMethod) -> tuple[int, Tensor]:
    """FFT length and the factor of each line that is kept."""
    if num_samples < 2:
        raise ValueError(f"a spectrum needs at least two samples, got {num_samples}")
    if method == "reference":
        length = 2 * (num_samples - 1)
        scale = torch.full((num_samples,), 2.0 / length, dtype=torch.float64)
        scale[[0, -1]] /= 2
        return 1 << (length - 1).bit_length(), scale
    if method == "clean":
        scale = torch.full((num_samples // 2 + 1,), 2.0 / num_samples, dtype=torch.float64)
        scale[0] /= 2
        if num_samples % 2 == 0:
            scale[-1] /= 2
        return num_samples, scale
    raise ValueError(f"spectrum method must be 'reference' or 'clean', got {method!r}")
