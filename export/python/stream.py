"""An exported stream graph as an object: volts in, decisions out. onnxruntime and numpy alone."""

import math
from itertools import compress

import numpy as np
from files import load_model

KEYS = ("time_s", "onset_s", "score", "probability", "valid", "in_range", "channels_lost")
KEYS += ("statistic", "alarm", "on")
ONSET_KEYS = ("onset_score", "hint", "by_onset")  # of a model with an onset classifier
NO_EVIDENCE = -1e30  # onset score of the graph


class Stream:
    """The graph, and what it remembers between two pushes.

    Args:
        path: of the model; its sidecar lies beside it.
        threshold: at which the statistic, or the onset score of a model with an onset classifier,
            raises an alarm, instead of the model's own.
    """

    def __init__(self, path, threshold=None):
        self.session, self.facts = load_model(path, "stream")
        self.has_onset = "onset_hop_samples" in self.facts
        self.threshold = np.array([] if threshold is None else [threshold], np.float64)
        self.reset()

    def reset(self):
        """Forget everything: another recording begins, or this one anew behind a gap."""
        self.tail = np.empty((0, len(self.facts["channels"])), self.facts["precision"])
        self.state = np.empty(0, np.float64)

    def push(self, samples):
        """The decisions that volts ``[n, C]`` make possible, as dicts; NaN is a missing sample.

        Of a decision that is not ``valid``, because too few channels are alive, score, probability
        and statistic are NaN, and it raises no alarm. ``channels_lost`` are the names of channels
        that are silent or missing, ``in_range`` says whether the others move about as much as in
        training.

        With an onset classifier an alarm's ``raised_by`` is ``"onset"``, its score, or
        ``"status"``, the statistic of bins; of other decisions it is None. Without evidence
        ``onset_score`` is NaN. ``hint`` says whether it reaches a threshold below that of alarms.

        Memory grows with the decisions of a push, so push some 2000 samples at most.
        """
        feeds = {"samples": np.ascontiguousarray(samples, self.tail.dtype), "tail": self.tail}
        feeds |= {"state": self.state, "threshold": self.threshold}
        keys = KEYS + ONSET_KEYS if self.has_onset else KEYS
        self.tail, self.state, *columns = self.session.run(
            ("next_tail", "next_state", *keys), feeds
        )
        rows = zip(*(column.tolist() for column in columns), strict=True)
        decisions = [dict(zip(keys, row, strict=True)) for row in rows]
        for decision in decisions:
            lost = compress(self.facts["channels"], decision["channels_lost"])
            decision["channels_lost"] = list(lost)
            if not self.has_onset:
                continue
            if decision["onset_score"] <= NO_EVIDENCE:
                decision["onset_score"] = math.nan
            by = "onset" if decision.pop("by_onset") else "status"
            decision["raised_by"] = by if decision["alarm"] else None
        return decisions
