"""The Savitzky-Golay filter of one frame, the first step (paper IV-B, REFERENCE.md section 2).

Order 1 is a moving average: -3 dB at 81 Hz for the 11-sample frame of the films and at 17 Hz for
the 51-sample frame of the gauges. Where in its frame a sample lies is a choice of noise and delay.
Centred, it looks half a frame ahead: 2.5 ms and 12.5 ms. Causal (ours), the polynomial of the frame
behind a sample is evaluated at that sample, the frame's last: no look-ahead, but at order 1 nearly
four times the variance of white noise comes through, some tones below the corner are raised by a
third, and the corners move to 200 Hz and 44 Hz. Trailing (ours), a sample gets what the sample half
a frame before it gets if centred: no look-ahead and no more noise, but half a frame late.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

Align = Literal["centred", "causal", "trailing"]
"""Which part of its frame's polynomial a sample takes, and where the frame lies.

``"centred"``: the middle of the frame around it; ``"causal"``: the end of the frame behind it;
``"trailing"``: the middle of the frame behind it.
"""
Edges = tuple[Tensor, Tensor, Tensor]
"""Head, kernel and tail of a filter: see ``edge_matrices``."""


def fit_matrix(window_length: int, polyorder: int) -> Tensor:
    """Least-squares polynomial fit of one frame, as a matrix.

    Shape:
        - output: ``[window_length, window_length]``, float64; row ``i`` times the frame is the
          fitted polynomial at sample ``i``. The middle row is the Savitzky-Golay kernel. A frame
          of one sample is that sample, whatever the order: nothing is smoothed.

    Raises:
        ValueError: if the frame is even or, of more than one sample, does not exceed the order.
    """
    if window_length < 1 or window_length % 2 == 0:
        raise ValueError(f"window_length must be odd and positive, got {window_length}")
    if window_length == 1 and polyorder >= 0:
        return torch.ones(1, 1, dtype=torch.float64)
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


def edge_matrices(window_length: int, polyorder: int, align: Align) -> Edges:
    """What makes the first samples, one in between, and the last ones, from a frame each.

    Returns:
        ``head``, of the first frame the samples before the first whole one; ``kernel``, of its own
        frame any sample; ``tail``, of the last frame the samples behind the last whole one.

    Shape:
        - head: ``[before, window_length]``, float64, with ``before, after`` of ``reach``
        - kernel: ``[window_length]``
        - tail: ``[after, window_length]``

    Raises:
        ValueError: if the frame is even or does not exceed the order, or the alignment is unknown.
    """
    fit = fit_matrix(window_length, polyorder)
    before, after = reach(window_length, align)
    late = window_length // 2 if align == "trailing" else 0
    place = (torch.arange(before + 1) - late).clamp(min=0)  # of a sample in the polynomial
    return fit[place[:before]], fit[place[before]], fit[window_length - after :]


def past_matrix(window_length: int, polyorder: int, align: Align) -> Tensor:
    """Samples before a signal that make its filter one thing from end to end.

    The first samples of a signal take the polynomial of its first frame. The plain filter makes
    the same of them if it is given these in front: ``x[0] + past @ (x[:window_length] - x[0])``,
    the last one next to ``x[0]``. A NaN or Inf in the first frame leaves none of them finite.

    Shape:
        - output: ``[before, window_length]``, float64, with ``before, after`` of ``reach``; its
          rows sum to 1

    Raises:
        ValueError: as ``edge_matrices``.

    Example:
        >>> x = torch.tensor([0.0, 2.0, 4.0], dtype=torch.float64)
        >>> past = x[0] + past_matrix(3, 1, "centred") @ (x - x[0])  # a line goes on
        >>> past.round(decimals=9)
        tensor([-2.], dtype=torch.float64)
    """
    head, kernel, _ = edge_matrices(window_length, polyorder, align)
    before = len(head)
    if polyorder >= window_length - 1:  # goes through all samples: nothing is smoothed
        return torch.eye(window_length, dtype=torch.float64)[:1].repeat(before, 1)
    rows = torch.zeros(before, before + window_length, dtype=torch.float64)
    for i, row in enumerate(rows):
        row[i : i + window_length] = kernel
    past, known = rows[:, :before], rows[:, before:]
    solution: Tensor = torch.linalg.lstsq(past, head - known, driver="gelsd").solution
    return solution


def savgol_filter(
    x: Tensor, window_length: int, polyorder: int = 1, align: Align = "centred"
) -> Tensor:
    """Savitzky-Golay filter along the last axis, ``scipy.signal.savgol_filter(mode="interp")``.

    Samples whose frame would leave the signal take the polynomial fitted to the first or last
    frame: half a frame at either end, or all but one sample of the first frame if causal or
    trailing; trailing half a frame earlier, and the first half of them its first value.
    Linear, so gradients flow everywhere; a NaN reaches as far as a frame does and no further.

    Args:
        x: signal in any unit.
        window_length: frame in samples, odd; 11 for PVDF and 51 for SG in the paper; 1 leaves the
            signal as it is.
        polyorder: order of the fitted polynomial, 1 in the paper.
        align: ``"centred"``; or ``"causal"``: the frame ends with the sample, as
            ``scipy.signal.savgol_coeffs(pos=window_length - 1)``; or ``"trailing"``: it ends with
            the sample and its middle is taken, the centred filter half a frame late.

    Shape:
        - x, output: ``[*, T]`` with ``T >= window_length``

    Raises:
        ValueError: if the frame is even, not above the order, or longer than the signal, or the
            alignment is unknown.

    Example:
        >>> savgol_filter(torch.tensor([0.0, 0.0, 3.0, 0.0, 0.0]), 3)
        tensor([-0.5000,  1.0000,  1.0000,  1.0000, -0.5000])
        >>> savgol_filter(torch.tensor([0.0, 0.0, 3.0, 0.0, 0.0]), 3, align="causal")
        tensor([-0.5000,  1.0000,  2.5000,  1.0000, -0.5000])
        >>> savgol_filter(torch.tensor([0.0, 0.0, 3.0, 0.0, 0.0]), 3, align="trailing")
        tensor([-0.5000, -0.5000,  1.0000,  1.0000,  1.0000])
    """
    return filter_by(x, edge_matrices(window_length, polyorder, align))


def filter_by(x: Tensor, edges: Edges) -> Tensor:
    """Filter along the last axis by head, kernel and tail.

    Shape:
        - x, output: ``[*, T]``, with ``T`` at least the kernel's length

    Raises:
        ValueError: if the signal is shorter than the kernel.
    """
    head, kernel, tail = (part.to(x) for part in edges)
    window_length = len(kernel)
    if x.shape[-1] < window_length:
        raise ValueError(
            f"a signal of {x.shape[-1]} samples is shorter than window_length {window_length}"
        )
    if window_length == 1:
        return x.clone()
    first, last = x[..., :window_length] @ head.T, x[..., -window_length:] @ tail.T
    return torch.cat([first, convolve_valid(x, kernel), last], dim=-1)


def reach(window_length: int, align: Align) -> tuple[int, int]:
    """Samples before and after its own that a filtered sample is made of.

    Raises:
        ValueError: if the alignment is unknown.

    Example:
        >>> reach(51, "centred"), reach(51, "causal"), reach(51, "trailing")
        ((25, 25), (50, 0), (50, 0))
    """
    if align not in get_args(Align):
        raise ValueError(f"align must be one of {', '.join(get_args(Align))}, got {align!r}")
    half = window_length // 2
    return (half, half) if align == "centred" else (2 * half, 0)


def convolve_valid(x: Tensor, kernel: Tensor) -> Tensor:
    """Correlate ``[*, T]`` with ``[W]``, keeping the ``T - W + 1`` full overlaps.

    A sum of shifted copies: in float64 over ten times faster than ``conv1d``, which unfolds, and
    the bits of a sample are the same in whatever piece of a signal it lies.
    """
    num_kept = x.shape[-1] - len(kernel) + 1
    first, *rest = kernel.tolist()
    total: Tensor = x.narrow(-1, 0, num_kept) * first
    for shift, weight in enumerate(rest, 1):
        total.add_(x.narrow(-1, shift, num_kept), alpha=weight)
    return total


def overlap_matrix(kernel: Tensor, num_kept: int) -> Tensor:
    """``convolve_valid`` as a matrix, for short signals: ``convolve_valid(x) = x @ matrix``.

    Gradients flow to the kernel.

    Shape:
        - kernel: ``[W]``
        - output: ``[num_kept + W - 1, num_kept]``
    """
    margin = kernel.new_zeros(num_kept - 1)
    padded = torch.cat([margin, kernel, margin])
    return padded.unfold(0, num_kept + len(kernel) - 1, 1).flip(0).T
