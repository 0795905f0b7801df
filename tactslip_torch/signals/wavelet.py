"""Wavelet branches of a bin (paper section IV-C, REFERENCE.md section 3), through ptwt.

A branch is a component *reconstructed to the bin's length*: all other coefficients are set to
zero and the transform is inverted. Every step is linear in the bin, so ``branch_matrix`` says it
all; features use the matrix, and ``wavelet_branches`` is what the matrix is made of.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any, Literal, cast

import pywt
import torch
from ptwt.conv_transform import wavedec, waverec
from torch import Tensor

from tactslip_torch.signals.filter_bank import Bank, Wavelet

ExtensionMode = Literal["symmetric", "reflect", "zero", "constant", "periodic"]


def branch_names(level: int) -> tuple[str, ...]:
    """``("A1", "D1", "A2", "D2", ...)``, the order of branches everywhere.

    Example:
        >>> branch_names(2)
        ('A1', 'D1', 'A2', 'D2')
    """
    return tuple(f"{kind}{m}" for m in range(1, level + 1) for kind in "AD")


def named_bank(wavelet: str) -> Bank:
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
    length = len(named_bank(wavelet)[0]) if isinstance(wavelet, str) else len(wavelet)
    return _highest_level(num_samples, length, str(wavelet))


def _highest_level(num_samples: int, length: int, wavelet: str) -> int:
    """The same of filters of so many taps."""
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
    bank = named_bank(wavelet) if isinstance(wavelet, str) else wavelet.bank
    return branches_by(x, bank, level, mode, str(wavelet))


def branches_by(
    x: Tensor,
    bank: Bank,
    level: int = 4,
    mode: ExtensionMode = "symmetric",
    name: str = "this wavelet",
) -> Tensor:
    """``wavelet_branches`` by filters given as tensors, to which gradients flow as well.

    Args:
        x: filtered bin.
        bank: the four filters, ``[L]`` each.
        level: number of levels.
        mode: extension at the ends.
        name: of the wavelet, for messages.

    Shape:
        - x: ``[*, n]``
        - output: ``[*, 2 * level, n]``

    Raises:
        ValueError: if the signal is too short for the level.
    """
    num_samples = x.shape[-1]
    highest = _highest_level(num_samples, len(bank[0]), name)
    if not 1 <= level <= highest:
        raise ValueError(
            f"level must lie in 1..{highest} for bins of {num_samples} samples and {name}, "
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
