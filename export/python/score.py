"""Score the bins of a recording, each by itself, with an exported bin graph.

    python score.py model.onnx recording.npy

``recording.npy`` holds volts ``[T, C]``. Prints a JSON line a bin: slip where its score is at least
0. A bin with too few living channels is not valid and has no score.
"""

from itertools import compress

import numpy as np
from arguments import Parser
from command import json_line, run, say
from files import load_model, load_recording

KEYS = ("score", "probability", "valid", "in_range", "channels_lost")
BATCH = 256  # bins scored at a time


def score_bins(session, facts, recording):
    """Start in seconds and what the graph says of every bin that has its context, as dicts."""
    given = {output.name for output in session.get_outputs()}
    names = [key for key in KEYS if key in given]  # a detector need not be calibrated
    bin_samples, before = facts["bin_samples"], facts["context_before_samples"]
    window = before + bin_samples + facts["context_after_samples"]
    starts = np.arange(0, len(recording) - window + 1, bin_samples)
    for first in range(0, len(starts), BATCH):  # none of a recording shorter than a window
        some = starts[first : first + BATCH]
        bins = np.stack([recording[start : start + window].T for start in some])
        columns = session.run(names, {"samples": bins.astype(facts["precision"])})
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for start, row in zip(some, rows, strict=True):
            start_s = float(start + before) / facts["sample_rate_hz"]
            scored = {"start_s": start_s, **dict(zip(names, row, strict=True))}
            yield scored | {"channels_lost": list(compress(facts["channels"], row[-1]))}


def main(options):
    """Print a line a bin."""
    session, facts = load_model(options.model, "bin")
    recording = load_recording(options.recording, facts)
    for scored in score_bins(session, facts, recording):
        say(json_line(scored))


if __name__ == "__main__":
    parser = Parser()
    parser.add_argument("model", metavar="model.onnx")
    parser.add_argument("recording", metavar="recording.npy")
    run(main, parser.parse_args())
