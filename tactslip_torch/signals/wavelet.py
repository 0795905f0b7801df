"""Wavelet branches of a bin (paper section IV-C, REFERENCE.md section 3), through ptwt.

A branch is a component *reconstructed to the bin's length*: all other coefficients are set to
zero and the transform is inverted. Every step is linear in the bin, so ``branch_matrix`` says it
all; features use the matrix, and ``wavelet_branches`` is what the matrix is made of. A wavelet is a
name that PyWavelets knows or, of one without a name, its four filters (``WaveletFilters``).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, Literal, TypeAlias, cast

import numpy as np
import pywt
import torch
from ptwt.conv_transform import wavedec, waverec
from torch import Tensor

Bank = tuple[Tensor, Tensor, Tensor, Tensor]
"""``dec_lo``, ``dec_hi``, ``rec_lo``, ``rec_hi``."""
_FILTERS = ("dec_lo", "dec_hi", "rec_lo", "rec_hi")
_TOLERANCE = 1e-9


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
        if (error := _reconstruction_error(*self._arrays())) > _TOLERANCE:
            raise ValueError(
                f"the filters of {self.name} do not reconstruct: off by {error:.1e}, at most "
                f"{_TOLERANCE:g} is taken; give rec_lo and rec_hi that invert dec_lo and dec_hi"
            )
        if abs(rest := math.fsum(self.dec_hi)) > _TOLERANCE:
            raise ValueError(
                f"dec_hi of {self.name} sums to {rest:.1e}, at most {_TOLERANCE:g} is taken: a "
                "constant must have no detail"
            )

    def __len__(self) -> int:
        """Taps of a filter, zeros at its ends among them."""
        return len(self.dec_lo)

    def __str__(self) -> str:
        return self.name

    @property
    def bank(self) -> Bank:
        """The filters as float64 tensors, ``[L]`` each."""
        low, high, low_back, high_back = (torch.from_numpy(array) for array in self._arrays())
        return low, high, low_back, high_back

    def to_dict(self) -> dict[str, Any]:
        """JSON-able, and exact: a float comes back as it was."""
        return {key: value if key == "name" else list(value) for key, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, facts: Mapping[str, Any]) -> WaveletFilters:
        """What ``to_dict`` gave.

        Raises:
            ValueError: if a key is missing or unknown, or as the constructor.
        """
        expected = ("name", *_FILTERS)
        if set(facts) != set(expected):
            raise ValueError(
                f"a wavelet's filters have the keys {', '.join(expected)}, got "
                f"{', '.join(map(str, facts)) or 'none'}"
            )
        return cls(**facts)

    def _arrays(self) -> list[np.ndarray[Any, np.dtype[np.float64]]]:
        return [np.array(getattr(self, name), np.float64) for name in _FILTERS]


Wavelet: TypeAlias = str | WaveletFilters
"""The name of a discrete wavelet of PyWavelets, or the filters of any."""


def as_wavelet(wavelet: Wavelet | Mapping[str, Any]) -> Wavelet:
    """A wavelet as it stands in a program or, ``to_dict``, in a file.

    Raises:
        ValueError: if it is neither a name nor filters, or as ``WaveletFilters``.
    """
    if isinstance(wavelet, (str, WaveletFilters)):
        return wavelet
    if isinstance(wavelet, Mapping):
        return WaveletFilters.from_dict(wavelet)
    raise ValueError(f"a wavelet is a name or its filters, got {type(wavelet).__name__}")


def wavelet_fact(wavelet: Wavelet) -> str | dict[str, Any]:
    """The same as a JSON-able value, for ``as_wavelet``."""
    return wavelet if isinstance(wavelet, str) else wavelet.to_dict()


def _numbers(name: str, values: Sequence[float]) -> tuple[float, ...]:
    try:
        numbers = tuple(float(value) for value in values)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must hold numbers, got {values!r}") from None
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{name} must be finite, got {numbers}")
    return numbers


def _reconstruction_error(
    dec_lo: np.ndarray[Any, Any],
    dec_hi: np.ndarray[Any, Any],
    rec_lo: np.ndarray[Any, Any],
    rec_hi: np.ndarray[Any, Any],
) -> float:
    """How far a unit impulse comes back from itself, ``L - 1`` later, and how large its alias is.

    Strang and Nguyen (1996), Wavelets and Filter Banks, section 4.1.
    """
    sign = (-1.0) ** np.arange(len(dec_lo))
    impulse = np.zeros(2 * len(dec_lo) - 1)
    impulse[len(dec_lo) - 1] = 2
    kept = np.convolve(dec_lo, rec_lo) + np.convolve(dec_hi, rec_hi) - impulse
    alias = np.convolve(sign * dec_lo, rec_lo) + np.convolve(sign * dec_hi, rec_hi)
    return float(max(np.abs(kept).max(), np.abs(alias).max()))


ExtensionMode = Literal["symmetric", "reflect", "zero", "constant", "periodic"]


def branch_names(level: int) -> tuple[str, ...]:
    """``("A1", "D1", "A2", "D2", ...)``, the order of branches everywhere.

    Example:
        >>> branch_names(2)
        ('A1', 'D1', 'A2', 'D2')
    """
    return tuple(f"{kind}{m}" for m in range(1, level + 1) for kind in "AD")


def _named_bank(wavelet: str) -> Bank:
    """The filters of a discrete wavelet of PyWavelets, float64.

    Shape:
        - output: four ``[L]``

    Raises:
        ValueError: if it is unknown.
    """
    if wavelet not in pywt.wavelist(kind="discrete"):
        raise ValueError(
            f"unknown wavelet {wavelet!r}; pywt.wavelist(kind='discrete') lists the known ones"
        )
    low, high, low_back, high_back = (
        torch.tensor(taps, dtype=torch.float64) for taps in pywt.Wavelet(wavelet).filter_bank
    )
    return low, high, low_back, high_back


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
    length = len(_named_bank(wavelet)[0]) if isinstance(wavelet, str) else len(wavelet)
    highest = int(pywt.dwt_max_level(num_samples, length)) if num_samples > 0 else 0
    if highest < 1:
        raise ValueError(
            f"bins of {num_samples} samples are too short for a level of {wavelet}, which needs "
            f"{2 * (length - 1)}; use longer bins or a shorter wavelet, such as haar"
        )
    return highest


def wavelet_branches(
    x: Tensor, wavelet: Wavelet = "rbio2.2", level: int = 4, mode: ExtensionMode = "symmetric"
) -> Tensor:
    """Approximations and details of a signal, each at the signal's own length.

    ``A1 + D1 = x`` and ``A(m) = A(m+1) + D(m+1)``. Gradients flow (the map is linear).

    Args:
        x: filtered bin.
        wavelet: any discrete wavelet PyWavelets knows, or filters; ``rbio2.2`` in the paper.
        level: number of levels; 4 in the paper.
        mode: extension at the ends; half-point ``symmetric`` in the paper's MATLAB
            (ptwt's own default, ``reflect``, is another).

    Shape:
        - x: ``[*, n]``
        - output: ``[*, 2 * level, n]`` in the order of ``branch_names``

    Raises:
        ValueError: if the wavelet is unknown or the signal too short for the level.

    Reference:
        ``pywt.wavedec`` and ``pywt.waverec`` with all but one coefficient array zeroed.
    """
    bank = _named_bank(wavelet) if isinstance(wavelet, str) else wavelet.bank
    num_samples = x.shape[-1]
    highest = highest_level(num_samples, wavelet)
    if not 1 <= level <= highest:
        raise ValueError(
            f"level must lie in 1..{highest} for bins of {num_samples} samples and {wavelet}, "
            f"got {level}; use fewer levels or longer bins"
        )
    flat = x.reshape(-1, num_samples)
    taps = cast(Any, bank)  # ptwt takes tensors too, though its types do not say so
    coefficients = wavedec(flat, taps, mode=mode, level=level)  # cA, cD(level), .., cD1
    details = list(_details(coefficients[1:], bank, num_samples))  # D(level), .., D1
    approximation = _rebuild([coefficients[0]], coefficients[1:], bank, num_samples)
    branches: list[Tensor] = []
    for detail in details:  # from the coarsest: A(m-1) = A(m) + D(m)
        branches = [approximation, detail, *branches]
        approximation = approximation + detail
    return torch.stack(branches, dim=-2).reshape(*x.shape[:-1], 2 * level, num_samples)


def _details(details: list[Tensor], bank: Bank, num_samples: int) -> Iterator[Tensor]:
    """Each detail alone, coarsest first."""
    for kept in range(len(details)):
        leading = [torch.zeros_like(details[0])]
        leading += [torch.zeros_like(d) for d in details[:kept]]
        yield _rebuild([*leading, details[kept]], details[kept + 1 :], bank, num_samples)


def _rebuild(kept: list[Tensor], zeroed: list[Tensor], bank: Bank, num_samples: int) -> Tensor:
    """Inverse transform of ``kept``, followed by zeros in the shapes of ``zeroed``."""
    coefficients, taps = [*kept, *(torch.zeros_like(d) for d in zeroed)], cast(Any, bank)
    return waverec(coefficients, taps)[..., :num_samples]


@lru_cache(maxsize=16)
def branch_matrix(
    num_samples: int,
    wavelet: Wavelet = "rbio2.2",
    level: int = 4,
    mode: ExtensionMode = "symmetric",
) -> Tensor:
    """``wavelet_branches`` as one matrix: ``branches = matrix @ x``. Do not write into it.

    Shape:
        - output: ``[2 * level, n, n]``, float64

    Raises:
        ValueError: as ``wavelet_branches``.
    """
    identity = torch.eye(num_samples, dtype=torch.float64)
    return wavelet_branches(identity, wavelet, level, mode).movedim(0, -1).contiguous()
