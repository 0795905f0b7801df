"""Savitzky-Golay smoothing of a hand: a frame of its own for every channel, whole or bin by bin."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from tactslip_torch.plain import is_plain
from tactslip_torch.signals.kernel_edges import checked_kernels, edges_by
from tactslip_torch.signals.savgol import Align as Align
from tactslip_torch.signals.savgol import Edges, edge_matrices, filter_by, overlap_matrix, reach

_MOST_MATRICES = 16
_FEW_BINS = 4
_Group = tuple[int, int, list[int], bool]


class ChannelFilter(nn.Module):
    """``savgol_filter`` with a frame of its own for every channel.

    A bin is filtered exactly with ``context_before`` samples before it and ``context_after``
    behind: as many on each side if centred, else all of them before, ``2 * context`` in all.

    Args:
        window_lengths: one odd frame per channel, in samples; 1 leaves a channel as it is.
        polyorder: order of the fitted polynomial.
        align: where in its frame a sample lies.
        kernels: other weights than Savitzky-Golay's, by length of the frame, as
            ``LearnableSmoothing.frozen`` gives them; each sums to 1. The ends of a signal get what
            ``kernel_edges`` says.

    Attributes:
        context: half the longest frame; a bin comes with twice as many samples around it.
        context_before: samples needed before a bin to filter it exactly.
        context_after: and behind it; 0 unless centred.
        reaches: samples before and after its own that each channel's frame takes in.

    Raises:
        ValueError: if a frame is even or does not exceed the order, the alignment is unknown, or a
            kernel fits no frame or does not sum to 1.
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
        self.kernels = checked_kernels(kernels or {}, self.window_lengths)
        # float64 and outside the state: cast on use, so they never lose digits
        self._edges = {length: self._edges_of(length) for length in self.window_lengths}
        self.reaches = tuple(reach(length, align) for length in self.window_lengths)
        self.context = max(self.window_lengths) // 2
        self.context_before, self.context_after = reach(max(self.window_lengths), align)
        self._matrices: dict[tuple[int, int, torch.dtype, torch.device], Tensor] = {}
        self._wanted: dict[tuple[int, ...] | None, list[_Group]] = {}
        self._groups = [  # frames and their channels, the frame of the first channel first
            (length, [i for i, own in enumerate(self.window_lengths) if own == length])
            for length in dict.fromkeys(self.window_lengths)
        ]

    def facts(self) -> dict[str, Any]:
        """All arguments as JSON-able values; ``ChannelFilter(**facts)``. Kernels only if given."""
        facts: dict[str, Any] = {
            "window_lengths": list(self.window_lengths),
            "polyorder": self.polyorder,
            "align": self.align,
        }
        if self.kernels:
            facts["kernels"] = {str(length): list(own) for length, own in self.kernels.items()}
        return facts

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
        parts, order = [], list[int]()
        for length, _, chosen, is_wanted in self._groups_for(channels):
            order += chosen
            part = _channels(samples, chosen)
            if is_wanted:
                part = filter_by(part, self._edges[length])
            parts.append(part)
        return _in_order(parts, order)

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
        if is_plain(samples) and samples.shape[:-2].numel() <= _FEW_BINS:
            return self._valid_of_few(samples, num_samples, channels)
        parts, order = [], list[int]()
        for length, start, chosen, is_wanted in self._groups_for(channels):
            order += chosen
            kept = _channels(samples, chosen).narrow(-1, start, num_samples + length - 1)
            if is_wanted:
                parts.append(kept.contiguous() @ self._matrix(length, num_samples, samples))
            else:
                largest = torch.maximum(kept.amax(-1), -kept.amin(-1))[..., None]
                parts.append(largest.expand(*kept.shape[:-1], num_samples))
        return _in_order(parts, order)

    def _valid_of_few(
        self, samples: Tensor, num_samples: int, channels: Collection[int] | None
    ) -> Tensor:
        """The same of few bins and no more than values: NumPy's calls take a third of the time."""
        x = samples.detach().numpy()
        filtered = np.empty((*x.shape[:-1], num_samples), x.dtype)
        with np.errstate(all="ignore"):  # 0 times Inf is a NaN, as it should be
            for length, start, chosen, is_wanted in self._groups_for(channels):
                kept = x[..., chosen, start : start + num_samples + length - 1]
                if is_wanted:
                    matrix = self._matrix(length, num_samples, samples).numpy()
                    filtered[..., chosen, :] = kept @ matrix
                else:
                    filtered[..., chosen, :] = np.abs(kept).max(-1, keepdims=True)
        return torch.from_numpy(filtered)

    def _groups_for(self, channels: Collection[int] | None) -> list[_Group]:
        """Frames, where theirs starts, channels of theirs, and whether these are wanted."""
        key = None if channels is None else tuple(channels)
        if (groups := self._wanted.get(key)) is None:
            wanted = range(len(self.window_lengths)) if key is None else frozenset(key)
            groups = []
            for length, own in self._groups:
                start = self.context_before - reach(length, self.align)[0]
                for is_wanted in (True, False):
                    if chosen := [c for c in own if (c in wanted) == is_wanted]:
                        groups.append((length, start, chosen, is_wanted))
            self._wanted = {key: groups}  # the last one asked for, whole: other threads may look
        return groups

    def kernel(self, channel: int) -> Tensor:
        """Weights of the frame that a channel is filtered by, ``[W]``, float64."""
        return self.edges(channel)[1]

    def edges(self, channel: int) -> Edges:
        """What makes a channel's first samples, those in between and its last; float64.

        Shape:
            - output: as ``edge_matrices`` has them
        """
        return self._edges[self.window_lengths[channel]]

    def _edges_of(self, length: int) -> Edges:
        if length not in self.kernels:
            return edge_matrices(length, self.polyorder, self.align)
        kernel = torch.tensor(self.kernels[length], dtype=torch.float64)
        return edges_by(kernel, self.polyorder, self.align)

    def check(self, samples: Tensor) -> None:
        """Refuse what are no samples of this hand.

        Raises:
            ValueError: if there are no axes of channels and time, or other channels.
        """
        if samples.ndim < 2 or samples.shape[-2] != len(self.window_lengths):
            raise ValueError(
                f"expected samples [*, {len(self.window_lengths)}, T] (channels, time), "
                f"got {tuple(samples.shape)}"
            )

    def _matrix(self, length: int, num_kept: int, like: Tensor) -> Tensor:
        """The filter of short signals as a matrix; kept, as making it takes longer than using it.

        A trace makes its own: what is made in one must not outlive it.
        """
        if torch.compiler.is_compiling():
            return overlap_matrix(self._edges[length][1].to(like), num_kept)
        key = (length, num_kept, like.dtype, like.device)
        matrix = self._matrices.get(key)
        if matrix is None:
            if len(self._matrices) >= _MOST_MATRICES:
                self._matrices.clear()
            with torch.inference_mode(False):  # it may be needed for a gradient later
                matrix = overlap_matrix(self._edges[length][1].to(like), num_kept)
            self._matrices[key] = matrix
        return matrix


def _in_order(parts: Sequence[Tensor], order: Sequence[int]) -> Tensor:
    """The parts' channels, which are those of ``order``, in the order of the hand."""
    filtered = torch.cat(list(parts), dim=-2)
    if list(order) == sorted(order):
        return filtered
    return filtered[..., sorted(range(len(order)), key=order.__getitem__), :]


def _channels(samples: Tensor, chosen: Sequence[int]) -> Tensor:
    """The chosen channels of ``[*, C, T]``; neighbours without a copy."""
    if chosen[-1] - chosen[0] + 1 == len(chosen):
        return samples.narrow(-2, chosen[0], len(chosen))
    return samples[..., list(chosen), :]
