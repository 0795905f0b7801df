"""What is kept of the decisions on a stream while it passes: alarms with their ends, and counts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactslip_torch.report.envelope import Array


class Tally:
    """Adds up decisions; grows with the alarms alone.

    Args:
        onsets_s: true onsets, as far as they are known.

    Attributes:
        num_decisions: so far.
        num_invalid: of them, those that cannot be relied on.
        first_positive_s: of each onset, the first decision from it on that speaks for slip; NaN.
    """

    def __init__(self, onsets_s: Sequence[float] = ()) -> None:
        self.num_decisions = self.num_invalid = 0
        self.first_positive_s = [math.nan] * len(onsets_s)
        self._onsets_s = tuple(onsets_s)
        self._alarms: list[dict[str, Any]] = []
        self._ends_s: list[float] = []
        self._was_on = False

    def add(
        self,
        available_s: Array,
        llr: NDArray[np.floating],
        is_valid: NDArray[np.bool_],
        is_on: NDArray[np.bool_],
        alarms: Sequence[Mapping[str, Any]],
    ) -> None:
        """Take the next decisions, each ``[m]``, and the alarms that they raised."""
        self.num_decisions += len(available_s)
        self.num_invalid += int((~is_valid).sum())
        self._alarms += map(dict, alarms)
        status = np.concatenate([[self._was_on], is_on])
        self._ends_s += available_s[status[:-1] & ~status[1:]].tolist()
        self._was_on = bool(status[-1])
        positive_s = available_s[llr > 0]
        for place, onset in enumerate(self._onsets_s):
            if math.isnan(self.first_positive_s[place]):
                behind = positive_s[np.searchsorted(positive_s, onset) :]
                self.first_positive_s[place] = float(behind[0]) if len(behind) else math.nan

    @property
    def alarms(self) -> list[dict[str, Any]]:
        """Those so far, each with its ``end_s``; ``None`` while it stands."""
        ends = [*self._ends_s, *[None] * (len(self._alarms) - len(self._ends_s))]
        return [alarm | {"end_s": end} for alarm, end in zip(self._alarms, ends, strict=True)]
