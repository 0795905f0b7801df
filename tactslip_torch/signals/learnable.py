"""Smoothing whose weights can be learned: Savitzky-Golay's are only where it starts."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.signals.kernel_edges import Kernels, around
from tactslip_torch.signals.savgol import overlap_matrix


class LearnableSmoothing(nn.Module):
    """One learnable kernel for each length of frame, at first exactly that of a filter.

    A kernel sums to 1 whatever the parameters, so that a constant stays; and it is symmetric, so
    that nothing is delayed, unless the frame is causal, whose own weights are not. Parameters are
    float64 and 0 at first, in parts of the mean weight ``1 / W``. Frames of 1 sample stay so.

    Args:
        channel_filter: where to start.

    Attributes:
        channel_filter: the same.
        steps: by length as text: what is added to the kernel but for its mean, ``[W // 2 + 1]``
            from the middle on, or ``[W]`` if causal.

    Example:
        >>> smoothing = LearnableSmoothing(ChannelFilter([51, 11]))
        >>> smoothing(torch.randn(8, 2, 25 + 100 + 25)).shape  # differentiable in the kernels
        torch.Size([8, 2, 100])
        >>> ChannelFilter([51, 11], kernels=smoothing.frozen()).kernel(1).sum().round(decimals=12)
        tensor(1., dtype=torch.float64)
    """

    def __init__(self, channel_filter: ChannelFilter) -> None:
        super().__init__()
        self.channel_filter = channel_filter
        lengths = channel_filter.window_lengths
        self._start = {
            length: channel_filter.kernel(lengths.index(length))
            for length in dict.fromkeys(lengths)
            if length > 1
        }
        is_causal = channel_filter.align == "causal"
        self.steps = nn.ParameterDict(
            {
                str(length): torch.zeros(length if is_causal else length // 2 + 1).double()
                for length in self._start
            }
        )

    @property
    def kernels(self) -> dict[int, Tensor]:
        """The kernels as they are now, by length of the frame; gradients flow to the parameters.

        Shape:
            - output: ``[W]`` each, float64
        """
        kernels = dict[int, Tensor]()
        for length, start in self._start.items():
            step: Tensor = self.steps[str(length)]
            if len(step) < length:
                step = torch.cat([step[1:].flip(0), step])
            kernels[length] = start.to(step) + (step - step.mean()) / length
        return kernels

    def forward(self, samples: Tensor) -> Tensor:
        """``filter_bins`` with the kernels as they are now."""
        return filter_bins(samples, self.channel_filter, self.kernels)

    def frozen(self) -> dict[int, tuple[float, ...]]:
        """The kernels as they are now as plain numbers, for ``ChannelFilter(kernels=...)``."""
        return {length: tuple(kernel.tolist()) for length, kernel in self.kernels.items()}


def filter_bins(samples: Tensor, channel_filter: ChannelFilter, kernels: Kernels) -> Tensor:
    """``ChannelFilter.valid`` by kernels given as tensors, to which gradients flow as well.

    Args:
        samples: raw bins with their context; ``extended`` gives those at the ends theirs.
        channel_filter: whose frames.
        kernels: weights by length of the frame, in place of its own.

    Shape:
        - samples: ``[*, C, context_before + n + context_after]``
        - kernels: ``[W]`` each
        - output: ``[*, C, n]``

    Raises:
        ValueError: if the number of channels is another, or nothing is left.
    """
    channel_filter.check(samples)
    before, after = channel_filter.context_before, channel_filter.context_after
    num_samples = samples.shape[-1] - before - after
    if num_samples < 1:
        raise ValueError(
            f"expected bins with {before} samples of context before and {after} behind, got "
            f"{samples.shape[-1]} samples in all"
        )
    lengths = channel_filter.window_lengths
    parts, order = [], list[int]()
    for length in dict.fromkeys(lengths):
        own = [channel for channel, other in enumerate(lengths) if other == length]
        start = before - channel_filter.reaches[own[0]][0]
        kept = samples[..., own, start : start + num_samples + length - 1]
        kernel = kernels.get(length, channel_filter.kernel(own[0])).to(samples)
        parts.append(kept @ overlap_matrix(kernel, num_samples))
        order += own
    return torch.cat(parts, dim=-2)[..., sorted(range(len(order)), key=order.__getitem__), :]


def extended(samples: Tensor, channel_filter: ChannelFilter) -> Tensor:
    """A whole recording with what was before it and comes behind it, as ``kernel_edges`` has it.

    Bins cut from it have their context wherever they lie, and ``filter_bins`` makes of them what
    ``ChannelFilter(...)`` makes of the whole. Further out than a channel's frame reaches, its first
    and last sample go on; nothing is made of them.

    Shape:
        - samples: ``[*, C, T]``
        - output: ``[*, C, context_before + T + context_after]``

    Raises:
        ValueError: if the number of channels is another, or ``T`` is shorter than a frame.
    """
    channel_filter.check(samples)
    longest = max(channel_filter.window_lengths)
    if samples.shape[-1] < longest:
        raise ValueError(
            f"a signal of {samples.shape[-1]} samples is shorter than window_length {longest}"
        )
    first, last = samples[..., :1], samples[..., -1:]
    before = first.repeat_interleave(channel_filter.context_before, -1)
    after = last.repeat_interleave(channel_filter.context_after, -1)
    whole = torch.cat([before, samples, after], dim=-1)
    for channel, length in enumerate(channel_filter.window_lengths):
        past, future = (
            part.to(samples)
            for part in around(length, channel_filter.polyorder, channel_filter.align)
        )
        x, start = samples[..., channel, :], channel_filter.context_before
        of_past = x[..., :1] + (x[..., :length] - x[..., :1]) @ past.T
        of_future = x[..., -1:] + (x[..., -length:] - x[..., -1:]) @ future.T
        stop = start + samples.shape[-1]
        whole[..., channel, start - len(past) : start] = of_past
        whole[..., channel, stop : stop + len(future)] = of_future
    return whole
