"""Amplitude spectra of branches (REFERENCE.md section 3), the authors' and a clean one."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

SpectrumMethod = Literal["reference", "clean"]


def amplitude_spectrum(x: Tensor, method: SpectrumMethod = "reference") -> Tensor:
    """One-sided amplitude spectrum, no window, mean kept.

    ``reference`` is what the authors compute: with ``L = 2 (n - 1)``, an FFT over the next power
    of two above ``L`` (256 for n = 100, zero-padded), lines ``0 .. n-1`` of it divided by ``L``,
    all but the first and the last doubled. ``clean`` (ours) is the discrete spectrum of the bin:
    ``rfft`` over its ``n`` samples divided by ``n``, all lines but DC and Nyquist doubled, so
    that a tone on a line has its amplitude there.

    The gradient of a line that is exactly zero is taken as zero.

    Shape:
        - x: ``[*, n]`` with ``n >= 2``
        - output: ``[*, n]`` (``reference``) or ``[*, n // 2 + 1]`` (``clean``), unit of ``x``

    Raises:
        ValueError: if the method is unknown or the signal shorter than two samples.
    """
    num_samples = x.shape[-1]
    num_fft, scale = _transform(num_samples, method)
    if not x.numel():  # the FFT refuses an empty batch
        return x.new_zeros(*x.shape[:-1], len(scale))
    lines: Tensor = torch.fft.rfft(x, n=num_fft)[..., : len(scale)]
    return lines.abs() * scale.to(x)


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
    """The spectrum before its modulus, as a matrix: ``amplitude = abs(matrix @ x)``.

    At bin lengths a constant matrix is as fast as an FFT and exports to ONNX without its slow and
    inexact DFT operator.

    Shape:
        - output: ``[lines, n]``, complex128

    Raises:
        ValueError: as ``amplitude_spectrum``.
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
