"""The four filters of a wavelet as plain numbers: of one that was learned and has no name to go by.

They are what ``FeaturePool`` takes beside a name, what a file keeps and what a cache is keyed by.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

import numpy as np
import torch
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
