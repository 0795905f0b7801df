"""An exported stream graph as an object: volts in, decisions out. onnxruntime and numpy alone."""

import numpy as np
from files import load_model

KEYS = ("time_s", "onset_s", "score", "probability", "valid", "statistic", "alarm", "on")


class Stream:
    """The graph, and what it remembers between two pushes.

    Args:
        path: of the model; its sidecar lies beside it.
        threshold: at which the statistic raises an alarm, instead of the model's own.
    """

    def __init__(self, path, threshold=None):
        self.session, self.facts = load_model(path, "stream")
        self.threshold = np.array([] if threshold is None else [threshold], np.float64)
        self.reset()

    def reset(self):
        """Forget everything: another recording begins, or this one anew behind a gap."""
        self.tail = np.empty((0, len(self.facts["channels"])), self.facts["precision"])
        self.state = np.empty(0, np.float64)

    def push(self, samples):
        """The decisions that volts ``[n, C]`` make possible, as dicts; NaN is a missing sample.

        Memory grows with the decisions of a push, so push some 2000 samples at most.
        """
        feeds = {"samples": np.ascontiguousarray(samples, self.tail.dtype), "tail": self.tail}
        feeds |= {"state": self.state, "threshold": self.threshold}
        names = ("next_tail", "next_state", *KEYS)
        self.tail, self.state, *columns = self.session.run(names, feeds)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        return [dict(zip(KEYS, row, strict=True)) for row in rows]
