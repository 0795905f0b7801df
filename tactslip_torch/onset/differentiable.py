"""From raw volts to the statistic that raises alarms, with gradients all the way.

What ``score_stream`` and a ``Decider`` make of a recording, to rounding, as tensors that remember
where they came from: which volts an alarm rests on, or what would have raised it earlier.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from tactslip_torch.model.calibration import probability
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.widening import widened_llr
from tactslip_torch.onset.decider import is_usable
from tactslip_torch.onset.sequential import NEUTRAL
from tactslip_torch.onset.settings import AlarmSettings


class StreamStatistic(NamedTuple):
    """One entry per decision, in order, ``[*, m]`` each, dtype of the samples.

    Attributes:
        score: at least 0 is slip.
        llr: log likelihood ratio; ``NEUTRAL``, without gradient, where the score tells nothing.
        probability: of slip, by the bin alone.
        statistic: of the rule; an alarm is raised where it reaches ``settings.threshold``.
    """

    score: Tensor
    llr: Tensor
    probability: Tensor
    statistic: Tensor


def stream_statistic(
    detector: SlipDetector, settings: AlarmSettings, samples: Tensor
) -> StreamStatistic:
    """Every decision on whole recordings, differentiable in the raw samples.

    Gradients are those of the values: 0 through a feature that is clipped, through a channel that
    counts as missing and, unless the pool is smooth, through entropy; one-sided at ties. All
    features of the pool are made on the way: a few seconds of stream at once, not hours.

    Args:
        detector: fitted on this hand.
        settings: hop, calibration and rule; ``AlarmSettings.of(detector)`` are those in its file.
        samples: recordings in volts; a channel with a NaN or Inf in a bin's reach is left out
            of that bin.

    Shape:
        - samples: ``[*, C, T]``, float32 or float64, ``T`` at least a bin and the longest frame
        - output: ``[*, m]`` each, ``m = (T - n) // hop + 1``

    Raises:
        ValueError: if samples are not of this hand or too short for a decision.

    Example:
        The gradient of the highest statistic, volt by volt, summed up for each channel:

        >>> detector = SlipDetector.load("onset.pt")  # doctest: +SKIP
        >>> samples = recording.samples.clone().requires_grad_()  # doctest: +SKIP
        >>> found = stream_statistic(detector, AlarmSettings.of(detector), samples)
        ... # doctest: +SKIP
        >>> (pull,) = torch.autograd.grad(found.statistic.max(), samples)  # doctest: +SKIP
        >>> pull.abs().sum(-1)  # doctest: +SKIP
    """
    detector.channel_filter.check(samples)
    used = detector.needed_index.tolist()
    length = detector.pool.bin_samples
    shortest = max(length, *(detector.channel_filter.window_lengths[i] for i in used))
    if samples.shape[-1] < shortest:
        raise ValueError(
            f"expected at least {shortest} samples, a bin and the longest frame in use, "
            f"got {samples.shape[-1]}; give a longer recording"
        )
    filtered = detector.channel_filter(detector.pool.widen(samples), used)
    bins = filtered.unfold(-1, length, settings.hop_samples).movedim(-3, -2)  # [*, m, C, n]
    is_used = torch.zeros(len(detector.pool.hand), 1, dtype=torch.bool, device=bins.device)
    is_used[used] = True
    bins = torch.where(is_used | bins.isfinite(), bins, 0.0)  # or 0 times NaN comes back
    score, _, is_missing, variance = detector.judge(bins, given=samples.dtype)
    llr = widened_llr(settings.calibration, score, variance)
    tells = is_usable(score, is_missing, detector.needed_index) & llr.isfinite()
    llr = torch.where(tells, llr, NEUTRAL)
    statistic, _ = settings.rule.scan(llr, settings.rule.start(llr[..., 0]))
    return StreamStatistic(score, llr, probability(llr, settings.slip_share), statistic)
