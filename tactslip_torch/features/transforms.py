"""From a film's bin to its wavelet branches, and from those to spectra, by given matrices.

Both are differentiable in the signal and in the matrix.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tactslip_torch.features.guards import are_positive, is_constant, settle


def branches_by(films: Tensor, matrix: Tensor, is_approximation: Tensor) -> Tensor:
    """Wavelet branches, those that are constant replaced (D by 0, A by their mean).

    Args:
        films: filtered bins.
        matrix: of all branches.
        is_approximation: which of them keep a constant; the others remove it.

    Shape:
        - films: ``[*, n]``; matrix: ``[branches, n, n]``; is_approximation: ``[branches]``
        - output: ``[*, branches, n]``
    """
    is_approximation = is_approximation[:, None]
    first = films[..., None, :1].detach()  # keeps a small vibration on a large offset exact
    shifted = (films[..., None, :] - first).squeeze(-2) @ matrix.flatten(0, 1).T
    shifted = shifted.unflatten(-1, matrix.shape[:2])
    branches = shifted + torch.where(is_approximation, first, 0.0)
    scale = films.detach().abs().amax(-1)[..., None].expand(branches.shape[:-1])
    settled = settle(branches, scale)
    if settled is branches:
        return branches
    constant = is_constant(branches, scale)[..., None]
    return torch.where(constant & ~is_approximation, 0.0, settled)


def amplitudes_by(branches: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Amplitude spectrum of each branch; the gradient of a line that is zero is 0.

    Shape:
        - branches: ``[*, n]``; cosine, sine: ``[lines, n]``
        - output: ``[*, lines]``
    """
    size = branches.detach().abs().amax(-1, keepdim=True)
    if not are_positive(size):
        size = torch.where(size == 0, 1.0, size)
    scaled = branches / size  # squares of 1e30 or 1e-30 stay in range
    real = scaled @ cosine.T
    imaginary = scaled @ sine.T
    square = real * real + imaginary * imaginary
    if are_positive(square):
        return size * square.sqrt()
    is_zero = square.detach() == 0
    return size * torch.where(is_zero, 0.0, torch.where(is_zero, 1.0, square).sqrt())
