"""The Savitzky-Golay filter of a hand, the first step (paper section IV-B).

Order 1 is a moving average: -3 dB at 81 Hz for the 11-sample frame of the PVDF channels and at
17 Hz for the 51-sample frame of the SG channels. Where in its frame a sample lies is a choice of
noise and delay. Centred, it looks half a frame ahead: 2.5 ms and 12.5 ms. Causal (ours), the
polynomial of the frame behind a sample is evaluated at that sample, the frame's last: no
look-ahead, but at order 1 nearly four times the variance of white noise comes through, some tones
below the corner are raised by a third, and the corners move to 200 Hz and 44 Hz. Trailing (ours), a
sample gets what the sample half a frame before it gets if centred: no look-ahead and no more noise,
but half a frame late.

``ChannelFilter`` has a frame of its own for every channel, of whole recordings and of bins, with
Savitzky-Golay's weights or others.

Cutting recordings into bins, the paper's 50 ms analysis unit.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import lru_cache
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor, nn

from tactslip_torch.hand import HandLayout
from tactslip_torch.runtime import check_choice

Align = Literal["centred", "causal", "trailing"]
"""Which part of its frame's polynomial a sample takes, and where the frame lies.

``"centred"``: the middle of the frame around it; ``"causal"``: the end of the frame behind it;
``"trailing"``: the middle of the frame behind it.
"""


class Edges(NamedTuple):
    """What makes the first samples of a signal, those in between and its last ones; float64.

    Args:
        head: of the first frame, the samples before the first whole one, ``[before, W]``.
        kernel: of its own frame, any sample, ``[W]``.
        tail: of the last frame, the samples behind the last whole one, ``[after, W]``.
    """

    head: Tensor
    kernel: Tensor
    tail: Tensor

    def filtered(self, x: Tensor) -> Tensor:
        """A whole signal ``[*, T]`` filtered.

        Raises:
            ValueError: if the signal is shorter than the kernel.
        """
        head, kernel, tail = (matrix.to(x) for matrix in self)
        _check_length(x, len(kernel))
        if len(kernel) == 1:
            return x.clone()
        first, last = x[..., : len(kernel)] @ head.T, x[..., -len(kernel) :] @ tail.T
        return torch.cat([first, _convolve_valid(x, kernel), last], dim=-1)


def _check_length(x: Tensor, window_length: int) -> None:
    if x.shape[-1] < window_length:
        raise ValueError(
            f"a signal of {x.shape[-1]} samples is shorter than window_length {window_length}"
        )


def reach(window_length: int, align: Align) -> tuple[int, int]:
    """Samples before and after its own that a filtered sample is made of.

    Raises:
        ValueError: if the alignment is unknown.

    Example:
        >>> reach(51, "centred"), reach(51, "causal"), reach(51, "trailing")
        ((25, 25), (50, 0), (50, 0))
    """
    check_choice("align", align, get_args(Align))
    half = window_length // 2
    return (half, half) if align == "centred" else (2 * half, 0)


def _fit_matrix(window_length: int, polyorder: int) -> Tensor:
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


def _savgol_edges(window_length: int, polyorder: int, align: Align) -> Edges:
    """The polynomial of the first frame, of a frame of its own, and of the last frame.

    Raises:
        ValueError: if the frame is even or does not exceed the order, or the alignment is unknown.
    """
    fit = _fit_matrix(window_length, polyorder)
    before, after = reach(window_length, align)
    late = window_length // 2 if align == "trailing" else 0
    place = (torch.arange(before + 1) - late).clamp(min=0)  # of a sample in the polynomial
    return Edges(fit[place[:before]], fit[place[before]], fit[window_length - after :])


@lru_cache(maxsize=256)  # each channel and each recording asks again
def past_matrix(window_length: int, polyorder: int, align: Align) -> Tensor:
    """Samples before a signal that make its filter one thing from end to end.

    The first samples of a signal take the polynomial of its first frame. The plain filter makes
    the same of them if it is given these in front: ``x[0] + past @ (x[:window_length] - x[0])``,
    the last one next to ``x[0]``. A NaN or Inf in the first frame leaves none of them finite.

    Shape:
        - output: ``[before, window_length]``, float64, with ``before, after`` of ``reach``; its
          rows sum to 1

    Raises:
        ValueError: if the frame is even or does not exceed the order, or the alignment is unknown.

    Example:
        >>> x = torch.tensor([0.0, 2.0, 4.0], dtype=torch.float64)
        >>> past = x[0] + past_matrix(3, 1, "centred") @ (x - x[0])  # a line goes on
        >>> past.round(decimals=9)
        tensor([-2.], dtype=torch.float64)
    """
    head, kernel, _ = _savgol_edges(window_length, polyorder, align)
    before = len(head)
    if polyorder >= window_length - 1:  # goes through all samples: nothing is smoothed
        return torch.eye(window_length, dtype=torch.float64)[:1].repeat(before, 1)
    rows = torch.zeros(before, before + window_length, dtype=torch.float64)
    for i, row in enumerate(rows):
        row[i : i + window_length] = kernel
    past, known = rows[:, :before], rows[:, before:]
    solution: Tensor = torch.linalg.lstsq(past, head - known, driver="gelsd").solution
    return solution


def _edges_of_kernel(weights: Sequence[float], polyorder: int, align: Align) -> Edges:
    """Edges of any kernel, none of Savitzky-Golay's, in such a filter's frame.

    Samples whose frame would leave the signal need more of it. In front it is the made-up past of
    ``past_matrix``, under which the Savitzky-Golay filter is one thing from end to end; behind,
    where a centred frame looks ahead, its mirror image. The kernel goes over that as over anything
    else, so it gives what the Savitzky-Golay filter gives if it has its weights, and a detector in
    a graph, which begins with the same past, what the whole recording gives. For causal and
    trailing frames of order 2 and more the weights of the past are large, and the first samples of
    a signal are as loud.
    """
    kernel = torch.tensor(weights, dtype=torch.float64)
    frame = torch.eye(len(kernel), dtype=torch.float64)
    past = past_matrix(len(kernel), polyorder, align)
    future = past.flip(0, 1) if align == "centred" else past[:0]
    before, after = torch.cat([past, frame[:-1]]), torch.cat([frame[1:], future])
    return Edges(_convolve_valid(before.T, kernel).T, kernel, _convolve_valid(after.T, kernel).T)


def _convolve_valid(x: Tensor, kernel: Tensor) -> Tensor:
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
    """``_convolve_valid`` as a matrix, for short signals: ``_convolve_valid(x) = x @ matrix``.

    Gradients flow to the kernel.

    Shape:
        - kernel: ``[W]``
        - output: ``[num_kept + W - 1, num_kept]``
    """
    margin = kernel.new_zeros(num_kept - 1)
    padded = torch.cat([margin, kernel, margin])
    return padded.unfold(0, num_kept + len(kernel) - 1, 1).flip(0).T


def _checked_kernels(
    kernels: Mapping[int, Sequence[float]], window_lengths: Sequence[int]
) -> dict[int, tuple[float, ...]]:
    """Kernels by length of the frame, as a program or a JSON file has them.

    Raises:
        ValueError: if a kernel is of no frame, of another length, not finite, or does not sum to 1.
    """
    checked = {int(key): tuple(map(float, weights)) for key, weights in kernels.items()}
    frames = sorted({length for length in window_lengths if length > 1})
    for length, kernel in checked.items():
        if length not in frames:
            raise ValueError(f"a kernel of {length} samples fits none of the frames {frames}")
        if len(kernel) != length:
            raise ValueError(
                f"a frame of {length} samples needs as many weights, got {len(kernel)}"
            )
        if not abs(sum(kernel) - 1) <= _TOLERANCE:
            raise ValueError(
                f"the kernel of {length} samples must be finite and sum to 1, got {sum(kernel)}; "
                "divide it by its sum"
            )
    return checked


_TOLERANCE = 1e-9  # of the sum of a kernel


@lru_cache(maxsize=16)
def _matrix_of(
    kernel: tuple[float, ...], num_kept: int, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """``overlap_matrix`` of a kernel, kept: making it takes longer than using it."""
    with torch.inference_mode(False):  # it may be needed for a gradient later
        weights = torch.tensor(kernel, dtype=torch.float64, device="cpu").to(device, dtype)
        return overlap_matrix(weights, num_kept)


class _Group(NamedTuple):
    """Channels that share a frame: its length, their positions, whether they are to be filtered."""

    length: int
    channels: slice | list[int]  # a slice of neighbours: looked up without a copy
    is_wanted: bool


def frame_lengths(hand: HandLayout, frames: Mapping[str, int | None]) -> list[int]:
    """The frame of each channel, from ``features.frames``.

    Args:
        hand: the channels.
        frames: an odd number of samples by kind of channel; 1 or ``None`` leaves the kind as it is.

    Raises:
        ValueError: if a kind has no frame, or one that is even or no number.
    """
    if missing := [kind for kind in hand.kinds if kind not in frames]:
        raise ValueError(
            f"features.frames has no frame for {', '.join(missing)} channels; give an odd number "
            f"of samples, as +features.frames.{missing[0]}=11, or null to leave them unfiltered"
        )
    lengths = {kind: 1 if frames[kind] is None else frames[kind] for kind in hand.kinds}
    for kind, length in lengths.items():
        if not isinstance(length, int) or length < 1 or length % 2 == 0:
            raise ValueError(
                f"features.frames.{kind} must be an odd number of samples, or null to leave such "
                f"channels unfiltered, got {length!r}"
            )
    return [int(lengths[channel.kind] or 1) for channel in hand.channels]


class ChannelFilter(nn.Module):
    """The Savitzky-Golay filter with a frame of its own for every channel.

    That of a whole signal is ``scipy.signal.savgol_filter(mode="interp")``: samples whose frame
    would leave the signal take the polynomial fitted to the first or last frame. These are half a
    frame at either end, or all but one sample of the first frame if causal or trailing; trailing,
    half a frame earlier, and the first half of them its first value. Linear, so gradients flow
    everywhere; a NaN reaches as far as a frame does and no further.

    A bin is filtered exactly with ``context_before`` samples before it and ``context_after``
    behind: as many on each side if centred, else all of them before, ``2 * context`` in all.

    Args:
        window_lengths: one odd frame per channel, in samples; 1 leaves a channel as it is.
        polyorder: order of the fitted polynomial, 1 in the paper.
        align: where in its frame a sample lies. ``"causal"`` is
            ``scipy.signal.savgol_coeffs(pos=window_length - 1)``.
        kernels: other weights than Savitzky-Golay's, by length of the frame; each sums to 1. The
            ends of a signal are then filtered between a made-up past and future.

    Attributes:
        context: half the longest frame; a bin comes with twice as many samples around it.
        context_before: samples needed before a bin to filter it exactly.
        context_after: and behind it; 0 unless centred.
        reaches: samples before and after its own that each channel's frame takes in.

    Raises:
        ValueError: if a frame is even or does not exceed the order, the alignment is unknown, or a
            kernel fits no frame or does not sum to 1.

    Example:
        >>> x = torch.tensor([[0.0, 0.0, 3.0, 0.0, 0.0]])
        >>> ChannelFilter([3])(x)
        tensor([[-0.5000,  1.0000,  1.0000,  1.0000, -0.5000]])
        >>> ChannelFilter([3], align="causal")(x)
        tensor([[-0.5000,  1.0000,  2.5000,  1.0000, -0.5000]])
        >>> ChannelFilter([3], align="trailing")(x)
        tensor([[-0.5000, -0.5000,  1.0000,  1.0000,  1.0000]])
    """

    def __init__(
        self,
        window_lengths: Sequence[int],
        polyorder: int = 1,
        align: Align = "centred",
        kernels: Mapping[int, Sequence[float]] | None = None,
    ) -> None:
        super().__init__()
        self.window_lengths = tuple(int(length) for length in window_lengths)
        self.polyorder = polyorder
        self.align: Align = align
        self.kernels = _checked_kernels(kernels or {}, self.window_lengths)
        # float64 and outside the state: cast on use, so they never lose digits
        self._edges = {
            length: _edges_of_kernel(self.kernels[length], polyorder, align)
            if length in self.kernels
            else _savgol_edges(length, polyorder, align)
            for length in self.window_lengths
        }
        self.reaches = tuple(reach(length, align) for length in self.window_lengths)
        self.context = max(self.window_lengths) // 2
        self.context_before, self.context_after = reach(max(self.window_lengths), align)
        self._wanted: dict[tuple[int, ...] | None, list[_Group]] = {}

    def config(self) -> dict[str, Any]:
        """All arguments as JSON-able values; ``ChannelFilter(**config)``. Kernels only if given."""
        config: dict[str, Any] = {
            "window_lengths": list(self.window_lengths),
            "polyorder": self.polyorder,
            "align": self.align,
        }
        if self.kernels:
            config["kernels"] = {str(length): list(taps) for length, taps in self.kernels.items()}
        return config

    def forward(self, samples: Tensor, channels: Collection[int] | None = None) -> Tensor:
        """Filter whole recordings.

        Args:
            samples: whole recordings.
            channels: which are wanted, by default all; the others come back as they are.

        Shape:
            - samples, output: ``[*, C, T]``

        Raises:
            ValueError: if the number of channels is another, or ``T`` is shorter than a frame.
        """
        self.check(samples)
        filtered = samples.clone()
        for length, chosen, is_wanted in self._groups_for(channels):
            if is_wanted:
                raw = samples[..., chosen, :]
                filtered[..., chosen, :] = self._edges[length].filtered(raw)
        return filtered

    def valid(self, samples: Tensor, channels: Collection[int] | None = None) -> Tensor:
        """Filter bins that come with their context, keeping only the bins.

        One matrix product, so a NaN anywhere in a bin's frame makes the channel's whole bin NaN.

        Args:
            samples: raw bins.
            channels: which are wanted, by default all; the others are not filtered but come back
                as a constant, the largest magnitude in their frame, which shows a NaN or Inf.

        Shape:
            - samples: ``[*, C, n + 2 * context]``, the bin behind ``context_before`` of them
            - output: ``[*, C, n]``, equal to the filter over the whole recording

        Raises:
            ValueError: if the number of channels is another, or nothing is left.
        """
        self.check(samples)
        num_samples = samples.shape[-1] - 2 * self.context
        if num_samples < 1:
            raise ValueError(
                f"expected bins with {self.context_before} samples of context before and "
                f"{self.context_after} behind, got {samples.shape[-1]} samples in all"
            )
        filtered = samples.narrow(-1, 0, num_samples).clone()
        for length, chosen, is_wanted in self._groups_for(channels):
            start = self.context_before - reach(length, self.align)[0]  # of the bin's first frame
            kept = samples[..., chosen, start : start + num_samples + length - 1]
            if is_wanted:
                filtered[..., chosen, :] = kept.contiguous() @ self._matrix(
                    length, num_samples, samples
                )
            else:
                filtered[..., chosen, :] = torch.maximum(kept.amax(-1), -kept.amin(-1))[..., None]
        return filtered

    def raw_magnitude(self, samples: Tensor, channels: Collection[int] | None = None) -> Tensor:
        """Largest size of the raw samples that each filtered bin of ``valid`` is made of.

        NaN where one of them is; no gradient.

        Shape:
            - samples: as ``valid``
            - output: ``[*, C]``, float64
        """
        num_samples = samples.shape[-1] - 2 * self.context
        samples = samples.detach()
        found = samples[..., 0].to(torch.float64, copy=True)  # of its kind under vmap too
        for length, chosen, _ in self._groups_for(channels):
            start = self.context_before - reach(length, self.align)[0]
            kept = samples[..., chosen, start : start + num_samples + length - 1]
            found[..., chosen] = torch.maximum(kept.amax(-1), -kept.amin(-1)).double()
        return found

    def _groups_for(self, channels: Collection[int] | None) -> list[_Group]:
        """The channels by their frames, those that are wanted apart from the others."""
        key = None if channels is None else tuple(channels)
        if (groups := self._wanted.get(key)) is None:
            everything = range(len(self.window_lengths))
            wanted = set(everything if key is None else key)
            by_frame: dict[tuple[int, bool], list[int]] = {}
            for channel in everything:
                frame = (self.window_lengths[channel], channel in wanted)
                by_frame.setdefault(frame, []).append(channel)
            groups = []
            for (length, is_wanted), own in by_frame.items():
                span = slice(own[0], own[-1] + 1)
                is_span = len(own) == own[-1] + 1 - own[0]
                groups.append(_Group(length, span if is_span else own, is_wanted))
            self._wanted = {key: groups}  # the last one asked for, whole: other threads may look
        return groups

    def kernel(self, channel: int) -> Tensor:
        """Weights of the frame that a channel is filtered by, ``[W]``, float64."""
        return self._edges[self.window_lengths[channel]].kernel

    def check(self, samples: Tensor) -> None:
        """Refuse what are no samples of this hand.

        Raises:
            ValueError: if there are no axes of channels and time, or other channels.
        """
        _check_tensor(samples)
        if samples.ndim < 2 or samples.shape[-2] != len(self.window_lengths):
            raise ValueError(
                f"expected samples [*, {len(self.window_lengths)}, T] (channels, time), "
                f"got {tuple(samples.shape)}"
            )

    def _matrix(self, length: int, num_kept: int, like: Tensor) -> Tensor:
        """The filter of short signals as a matrix, made anew in a trace, which it must not outlive.

        Shape:
            - output: ``[num_kept + length - 1, num_kept]``
        """
        kernel = self._edges[length].kernel
        if torch.compiler.is_compiling():
            return overlap_matrix(kernel.to(like), num_kept)
        return _matrix_of(tuple(kernel.tolist()), num_kept, like.dtype, like.device)


def extended(
    samples: Tensor, channel_filter: ChannelFilter, channels: Sequence[int] | None = None
) -> Tensor:
    """A whole recording between what its filter takes to lie before and behind it.

    Bins cut from it have their context wherever they lie, and ``ChannelFilter.valid`` makes of
    them what ``ChannelFilter(...)`` makes of the whole. Further out than a channel's frame reaches,
    its first and last sample go on; nothing is made of them.

    Args:
        samples: the recording.
        channel_filter: that bins are going to be filtered by.
        channels: which matter, by default all; the others go on as they begin and end.

    Shape:
        - samples: ``[*, C, T]``
        - output: ``[*, C, context_before + T + context_after]``

    Raises:
        ValueError: if the number of channels is another, or ``T`` is shorter than a frame.
    """
    channel_filter.check(samples)
    lengths = channel_filter.window_lengths
    _check_length(samples, max(lengths if channels is None else (lengths[c] for c in channels)))
    future = past_of(samples.flip(-1), channel_filter, channels).flip(-1)  # the mirror image
    past = past_of(samples, channel_filter, channels)
    return torch.cat([past, samples, future[..., : channel_filter.context_after]], dim=-1)


def past_of(
    samples: Tensor, channel_filter: ChannelFilter, channels: Sequence[int] | None = None
) -> Tensor:
    """What a filter takes to lie before a recording (``past_matrix``).

    Args:
        samples: its first ones, as many as the longest frame or more.
        channel_filter: that it is going to be filtered by.
        channels: which matter, by default all; the others begin with their first sample.

    Shape:
        - samples: ``[*, C, T]``
        - output: ``[*, C, context_before]``
    """
    num = channel_filter.context_before
    past = samples[..., :1].repeat_interleave(num, -1)
    for channel in range(samples.shape[-2]) if channels is None else channels:
        length = channel_filter.window_lengths[channel]
        matrix = past_matrix(length, channel_filter.polyorder, channel_filter.align).to(samples)
        x = samples[..., channel, :length]
        past[..., channel, num - len(matrix) :] = x[..., :1] + (x - x[..., :1]) @ matrix.T
    return past


def _check_tensor(x: Any) -> None:
    """Refuse what is no tensor, such as a NumPy array.

    Raises:
        TypeError: if it is none.
    """
    if not isinstance(x, Tensor):
        kind = f"{type(x).__module__}.{type(x).__name__}".removeprefix("builtins.")
        raise TypeError(f"expected a torch.Tensor, got {kind}; use torch.as_tensor(samples)")


def check_samples(x: Tensor, what: str = "samples") -> None:
    """Refuse what is no tensor, and one of whole numbers or of half precision.

    Raises:
        TypeError: if it is no tensor.
        ValueError: for another dtype.
    """
    _check_tensor(x)
    if x.dtype not in (torch.float32, torch.float64):
        raise ValueError(
            f"expected float32 or float64 {what} in volts, got {x.dtype}; "
            "convert with .float() or .double()"
        )


def bins_at(x: Tensor, starts: Tensor, bin_samples: int) -> Tensor:
    """The bins that begin at given samples.

    Shape:
        - x: ``[C, T]``
        - starts: ``[N]``, integers
        - output: ``[N, C, bin_samples]``

    Raises:
        ValueError: if a bin reaches outside the recording, named with its start.
    """
    num_samples = x.shape[-1]
    outside = (starts < 0) | (starts + bin_samples > num_samples)
    if bool(outside.any()):
        raise ValueError(
            f"a bin of {bin_samples} samples at sample {int(starts[outside][0])} reaches outside "
            f"the recording's {num_samples} samples"
        )
    index = starts[:, None] + torch.arange(bin_samples, device=starts.device)  # [N, n]
    return x[:, index].movedim(0, 1)


def largest_in_frames(
    x: Tensor, starts: Tensor, bin_samples: int, reaches: Sequence[tuple[int, int]]
) -> Tensor:
    """The largest value of each channel that the filtered bins are made of.

    Args:
        x: of every raw sample.
        starts: of bins.
        bin_samples: their length.
        reaches: of each channel, as ``ChannelFilter`` has them.

    Shape:
        - x: ``[C, T]``
        - starts: ``[N]``, integers
        - output: ``[N, C]``
    """
    values = np.concatenate([x.numpy(), x[:, -1:].numpy()], 1)  # a frame may end with the last one
    found = np.empty((len(x), len(starts)), values.dtype)
    for before, after in dict.fromkeys(reaches) if len(starts) else ():
        own = [channel for channel, of in enumerate(reaches) if of == (before, after)]
        first = (starts - before).clamp(min=0)
        stop = (starts + bin_samples + after).clamp(max=x.shape[-1])
        places = torch.stack([first, stop], 1).flatten().numpy()
        found[own] = np.maximum.reduceat(values[own], places, axis=-1)[:, ::2]
    return torch.from_numpy(found.T)
