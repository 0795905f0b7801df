"""The ends of a signal under a kernel that is none of Savitzky-Golay's, in such a filter's frame.

Samples whose frame would leave the signal need more of it. In front it is the made-up past of
``past_matrix``, under which the Savitzky-Golay filter is one thing from end to end; behind, where a
centred frame looks ahead, its mirror image. The kernel goes over that as over anything else, so it
gives what the Savitzky-Golay filter gives if it has its weights, and a detector in a graph, which
begins with the same past, what the whole recording gives. The past is linear in the first frame;
for causal and trailing frames of order 2 and more its weights are large, and the first samples of a
signal are as loud.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from tactslip_torch.signals.savgol import Align, Edges, overlap_matrix, past_matrix, reach

Kernels = Mapping[int, Tensor]
"""Weights ``[W]`` by length of the frame."""
_TOLERANCE = 1e-9


def around(window_length: int, polyorder: int, align: Align) -> tuple[Tensor, Tensor]:
    """What was before a signal, of its first frame, and what comes behind it, of its last.

    Shape:
        - past: ``[before, window_length]``, float64, with ``before, after`` of ``reach``
        - future: ``[after, window_length]``

    Raises:
        ValueError: as ``edge_matrices``.
    """
    past = past_matrix(window_length, polyorder, align)
    _, after = reach(window_length, align)
    future = past.flip(0, 1) if after else past[:0]
    return past, future


def edges_by(kernel: Tensor, polyorder: int, align: Align) -> Edges:
    """``edge_matrices`` of any kernel of a frame, to which gradients flow.

    Shape:
        - kernel: ``[W]``
        - output: head ``[before, W]``, the kernel, tail ``[after, W]``, in the kernel's dtype

    Raises:
        ValueError: as ``edge_matrices``.
    """
    length = len(kernel)
    past, future = (part.to(kernel) for part in around(length, polyorder, align))
    whole = torch.eye(length, dtype=kernel.dtype, device=kernel.device)
    nothing = kernel.new_zeros(0, length)
    head = (
        overlap_matrix(kernel, len(past)).T @ torch.cat([past, whole[:-1]])
        if len(past)
        else nothing
    )
    tail = (
        overlap_matrix(kernel, len(future)).T @ torch.cat([whole[1:], future])
        if len(future)
        else nothing
    )
    return head, kernel, tail


def checked_kernels(
    kernels: Mapping[int, Sequence[float]], window_lengths: Sequence[int]
) -> dict[int, tuple[float, ...]]:
    """Kernels by length of the frame, as a program or a JSON file has them.

    Raises:
        ValueError: if a kernel is of no frame, of another length, not finite, or does not sum to 1.
    """
    checked = dict[int, tuple[float, ...]]()
    for key, weights in kernels.items():
        length, kernel = int(key), tuple(float(weight) for weight in weights)
        if length == 1 or length not in window_lengths:
            frames = sorted({own for own in window_lengths if own > 1})
            raise ValueError(f"a kernel of {length} samples fits none of the frames {frames}")
        if len(kernel) != length:
            raise ValueError(
                f"a frame of {length} samples needs as many weights, got {len(kernel)}"
            )
        total = torch.tensor(kernel, dtype=torch.float64).sum()
        if not abs(total - 1) <= _TOLERANCE:
            raise ValueError(
                f"the kernel of {length} samples must be finite and sum to 1, got {float(total)}; "
                "divide it by its sum"
            )
        checked[length] = kernel
    return checked
