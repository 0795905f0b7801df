"""Cutting recordings into bins, the paper's 50 ms analysis unit (REFERENCE.md section 2)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


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


def refuse_nonfinite(samples: Tensor, names: Sequence[str], advice: str) -> None:
    """Raise if a sample is NaN or Inf.

    Args:
        samples: in any unit.
        names: of the channels, for the message.
        advice: what to do about it, the end of the message.

    Shape:
        - samples: ``[*, C, n]``

    Raises:
        ValueError: naming bin, channel and sample of the first one.
    """
    is_bad = ~samples.isfinite()
    if not bool(is_bad.any()):
        return
    *bins, channel, sample = is_bad.nonzero()[0].tolist()
    value = float(samples[(*bins, channel, sample)])
    place = f"bin {', '.join(map(str, bins))}, " if bins else ""
    raise ValueError(f"{place}channel {names[channel]}, sample {sample} is {value}; {advice}")
