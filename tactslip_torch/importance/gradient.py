"""How far a channel moves the score to first order, by the gradient with respect to its volts."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from tactslip_torch.model.detector import SlipDetector

_CHUNK = 32  # bins whose graphs are held at once


class FirstOrder(NamedTuple):
    """In standard deviations of the score, ``[C]`` each: at non-slip bins and at slip bins."""

    non_slip: Tensor
    slip: Tensor


def score_gradients(
    detector: SlipDetector,
    samples: Tensor,
    progress: Callable[[Iterable[Any], str], Iterable[Any]],
) -> tuple[Tensor, Tensor]:
    """Scores of raw bins and their derivatives with respect to every volt, in float64.

    Through filter, branches, spectra, descriptors, scaling and the quadratic form. What is clipped
    by the scaling, and what steps (entropy, mode), has derivative 0.

    Args:
        detector: as loaded.
        samples: in volts, with the context that ``score_raw`` needs.
        progress: wraps the chunks.

    Shape:
        - samples: ``[N, C, T]``
        - output: ``[N]`` and ``[N, C, T]``, float64
    """
    scores, gradients = [], []
    for part in progress(samples.double().split(_CHUNK), "gradients"):
        volts = part.clone().requires_grad_()
        score = detector.score_raw(volts)
        (gradient,) = torch.autograd.grad(score.sum(), volts)
        scores.append(score.detach())
        gradients.append(gradient)
    return torch.cat(scores), torch.cat(gradients)


def first_order(scores: Tensor, gradients: Tensor, samples: Tensor, is_slip: Tensor) -> FirstOrder:
    """Root mean square over bins of the gradient times the channel's own spread.

    The spread is the covariance ``S_c`` of the channel's samples over all bins given, so level and
    vibration count as they occur: a bin's part is ``sqrt(g_c' S_c g_c)``, by which the score would
    vary if this channel alone went through what it goes through in these bins, linearised at the
    bin. In units of the standard deviation of the scores.

    Args:
        scores: of the bins.
        gradients: of those with respect to ``samples``.
        samples: raw bins, in volts.
        is_slip: their classes.

    Shape:
        - scores, is_slip: ``[N]``
        - gradients, samples: ``[N, C, T]``

    Raises:
        ValueError: if shapes disagree, a class is absent, or the scores are all the same.
    """
    if gradients.shape != samples.shape or not len(samples) == len(scores) == len(is_slip):
        raise ValueError(
            f"expected scores and is_slip [N], gradients and samples [N, C, T], got "
            f"{tuple(scores.shape)}, {tuple(is_slip.shape)}, {tuple(gradients.shape)} and "
            f"{tuple(samples.shape)}"
        )
    if not bool(is_slip.any()) or bool(is_slip.all()):
        raise ValueError("gradients are told by class: give bins of slip and of non-slip")
    spread = scores.std()
    if not bool(spread > 0):
        raise ValueError(f"all {len(scores)} scores are {float(scores[0]):g}; nothing moves them")
    deviations = (samples.double() - samples.double().mean(0)) / (len(samples) - 1) ** 0.5
    moved = torch.einsum("nct,mct->cnm", gradients, deviations).square().sum(-1)  # [C, N]
    non_slip, slip = (
        moved[:, is_slip == value].mean(-1).sqrt() / spread for value in (False, True)
    )
    return FirstOrder(non_slip, slip)
