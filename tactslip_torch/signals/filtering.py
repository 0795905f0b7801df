"""Savitzky-Golay smoothing, the first step (paper section IV-B, REFERENCE.md section 2).

Order 1 is a moving average: -3 dB at 81 Hz for the 11-sample frame of the films and at 17 Hz for
the 51-sample frame of the gauges. Centred, so it looks half a frame ahead: 2.5 ms and 12.5 ms.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


def fit_matrix(window_length: int, polyorder: int) -> Tensor:
    """Least-squares polynomial fit of one frame, as a matrix.

    Shape:
        - output: ``[window_length, window_length]``, float64; row ``i`` times the frame is the
          fitted polynomial at sample ``i``. The middle row is the Savitzky-Golay kernel.

    Raises:
        ValueError: if the frame is even or does not exceed the order.
    """
    if window_length < 1 or window_length % 2 == 0:
        raise ValueError(f"window_length must be odd and positive, got {window_length}")
    if not 0 <= polyorder < window_length:
        raise ValueError(
            f"polyorder must lie in 0..{window_length - 1} for window_length {window_length}, "
            f"got {polyorder}"
        )
    half = window_length // 2
    position = torch.arange(-half, half + 1, dtype=torch.float64) / max(half, 1)
    powers = position[:, None] ** torch.arange(polyorder + 1)
    basis: Tensor = torch.linalg.qr(powers).Q
    return basis @ basis.T


def savgol_filter(x: Tensor, window_length: int, polyorder: int = 1) -> Tensor:
    """Savitzky-Golay filter along the last axis, ``scipy.signal.savgol_filter(mode="interp")``.

    The first and last half frame take the polynomial fitted to the first and last frame.
    Linear, so gradients flow everywhere; a NaN reaches half a frame to each side and no further.

    Args:
        x: signal in any unit.
        window_length: frame in samples, odd; 11 for PVDF and 51 for SG in the paper.
        polyorder: order of the fitted polynomial, 1 in the paper.

    Shape:
        - x, output: ``[*, T]`` with ``T >= window_length``

    Raises:
        ValueError: if the frame is even, not above the order, or longer than the signal.

    Example:
        >>> savgol_filter(torch.tensor([0.0, 0.0, 3.0, 0.0, 0.0]), 3)
        tensor([-0.5000,  1.0000,  1.0000,  1.0000, -0.5000])
    """
    fit = fit_matrix(window_length, polyorder).to(x)
    if x.shape[-1] < window_length:
        raise ValueError(
            f"a signal of {x.shape[-1]} samples is shorter than window_length {window_length}"
        )
    half = window_length // 2
    if half == 0:
        return x.clone()
    head = x[..., :window_length] @ fit[:half].T
    tail = x[..., -window_length:] @ fit[-half:].T
    return torch.cat([head, _convolve_valid(x, fit[half]), tail], dim=-1)


def _convolve_valid(x: Tensor, kernel: Tensor) -> Tensor:
    """Correlate ``[*, T]`` with ``[W]``, keeping the ``T - W + 1`` full overlaps.

    A sum of shifted copies: in float64 over ten times faster than ``conv1d``, which unfolds.
    """
    num_kept = x.shape[-1] - len(kernel) + 1
    total = x[..., :num_kept] * kernel[0]
    for shift in range(1, len(kernel)):
        total = torch.addcmul(total, x[..., shift : shift + num_kept], kernel[shift])
    return total


def _overlap_matrix(kernel: Tensor, num_kept: int) -> Tensor:
    """``_convolve_valid`` as a matrix ``[num_kept + W - 1, num_kept]``, for short signals."""
    margin = kernel.new_zeros(num_kept - 1)
    padded = torch.cat([margin, kernel, margin])
    return padded.unfold(0, num_kept + len(kernel) - 1, 1).flip(0).T


class ChannelFilter(nn.Module):
    """``savgol_filter`` with a frame of its own for every channel.

    Args:
        window_lengths: one odd frame per channel, in samples.
        polyorder: order of the fitted polynomial.

    Raises:
        ValueError: if a frame is even or does not exceed the order.
    """

    def __init__(self, window_lengths: Sequence[int], polyorder: int = 1) -> None:
        super().__init__()
        self.window_lengths = tuple(int(length) for length in window_lengths)
        self.polyorder = polyorder
        # float64 and outside the state: cast on use, so they never lose digits
        self._kernels = {
            length: fit_matrix(length, polyorder)[length // 2] for length in self.window_lengths
        }

    @property
    def context(self) -> int:
        """Samples needed on each side of a bin to filter it exactly: half the longest frame."""
        return max(self.window_lengths) // 2

    def forward(self, samples: Tensor) -> Tensor:
        """Filter whole recordings.

        Shape:
            - samples, output: ``[*, C, T]``

        Raises:
            ValueError: if the number of channels is another, or ``T`` is shorter than a frame.
        """
        self._check(samples)
        parts = [
            savgol_filter(samples[..., chosen, :], length, self.polyorder)
            for length, chosen in self._groups()
        ]
        return torch.cat(parts, dim=-2)[..., self._inverse(), :]

    def valid(self, samples: Tensor) -> Tensor:
        """Filter bins that come with their context, keeping only the bins.

        One matrix product, so a NaN anywhere in a bin's frame makes the channel's whole bin NaN.

        Shape:
            - samples: ``[*, C, n + 2 * context]``
            - output: ``[*, C, n]``, equal to the filter over the whole recording

        Raises:
            ValueError: if the number of channels is another, or nothing is left.
        """
        self._check(samples)
        num_samples = samples.shape[-1] - 2 * self.context
        if num_samples < 1:
            raise ValueError(
                f"expected bins with {self.context} samples of context on each side, "
                f"got {samples.shape[-1]} samples in all"
            )
        parts = []
        for length, chosen in self._groups():
            spare = self.context - length // 2
            kept = samples[..., chosen, spare : samples.shape[-1] - spare]
            num_kept = samples.shape[-1] - 2 * self.context
            parts.append(kept @ _overlap_matrix(self._kernels[length].to(samples), num_kept))
        return torch.cat(parts, dim=-2)[..., self._inverse(), :]

    def _check(self, samples: Tensor) -> None:
        if samples.ndim < 2 or samples.shape[-2] != len(self.window_lengths):
            raise ValueError(
                f"expected samples [*, {len(self.window_lengths)}, T] (channels, time), "
                f"got {tuple(samples.shape)}"
            )

    def _groups(self) -> list[tuple[int, list[int]]]:
        return [
            (length, [i for i, own in enumerate(self.window_lengths) if own == length])
            for length in sorted(set(self.window_lengths))
        ]

    def _inverse(self) -> list[int]:
        order = [i for _, chosen in self._groups() for i in chosen]
        return sorted(range(len(order)), key=order.__getitem__)
