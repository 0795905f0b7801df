"""Score the bins of a recording, each by itself, with an exported bin graph.

    python score.py model.onnx recording.npy

``recording.npy`` holds volts ``[T, C]``. Prints a JSON line a bin: slip where its score is at least
0, a guess where it is not valid, because a channel in use is dead or broken.
"""

import json

import numpy as np
from arguments import Parser
from command import run, say
from files import load_model, load_recording

BATCH = 256  # bins scored at a time


def score_bins(session, facts, recording):
    """Start in seconds and what the graph says of every bin that has its context, as dicts."""
    names = [output.name for output in session.get_outputs()]
    bin_samples, before = facts["bin_samples"], facts["context_before_samples"]
    window = before + bin_samples + facts["context_after_samples"]
    starts = np.arange(0, len(recording) - window + 1, bin_samples)
    for some in np.split(starts, range(BATCH, len(starts), BATCH)):
        bins = np.stack([recording[start : start + window].T for start in some])
        columns = session.run(names, {"samples": bins.astype(facts["precision"])})
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for start, row in zip(some, rows, strict=True):
            start_s = float(start + before) / facts["sample_rate_hz"]
            yield {"start_s": start_s, **dict(zip(names, row, strict=True))}


def main(options):
    """Print a line a bin."""
    session, facts = load_model(options.model, "bin")
    recording = load_recording(options.recording, facts)
    for scored in score_bins(session, facts, recording):
        say(json.dumps(scored))


if __name__ == "__main__":
    parser = Parser()
    parser.add_argument("model", metavar="model.onnx")
    parser.add_argument("recording", metavar="recording.npy")
    run(main, parser.parse_args())
