"""NaN and Inf among samples: where they are, and the error that says so."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor


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
