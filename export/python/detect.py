"""Watch a recording with an exported stream graph.

    python detect.py stream.onnx recording.npy [--rate HZ] [--chunk N] [--threshold T] [--decisions]

``recording.npy`` holds volts ``[T, C]``, the channels in the model's order. Prints JSON lines: one
an alarm, or with ``--decisions`` one a decision, and a summary.
"""

import sys

from arguments import Parser, chunk, number
from command import json_line, run, say
from files import load_recording
from stream import Stream

OF_EVERY = ("statistic", "alarm", "on", "onset_score", "hint")  # not printed of alarms alone


def main(options):
    """Push the recording chunk by chunk and print what comes."""
    stream = Stream(options.model, options.threshold)
    recording = load_recording(options.recording, stream.facts, options.rate)
    num_decisions, num_alarms, not_valid_s = 0, 0, []
    first_bin = max(stream.facts["first_samples"], stream.facts["frame_samples"])
    first_bin_s = first_bin / stream.facts["sample_rate_hz"]  # nothing is known before
    for start in range(0, len(recording), options.chunk):
        decisions = stream.push(recording[start : start + options.chunk])
        alarms = [decision for decision in decisions if decision["alarm"]]
        num_decisions, num_alarms = num_decisions + len(decisions), num_alarms + len(alarms)
        known = [decision for decision in decisions if decision["time_s"] >= first_bin_s]
        not_valid_s += [decision["time_s"] for decision in known if not decision["valid"]]
        for decision in decisions if options.decisions else alarms:
            left_out = () if options.decisions else OF_EVERY
            say(json_line({key: decision[key] for key in decision if key not in left_out}))
    seconds = len(recording) / stream.facts["sample_rate_hz"]
    sums = {"decisions": num_decisions, "alarms": num_alarms, "seconds": seconds}
    say(json_line(sums), flush=True)
    if not_valid_s:
        print(
            f"warning: {len(not_valid_s)} of {num_decisions} decisions are not valid, the first at "
            f"{not_valid_s[0]:.3f} s: too few channels are alive",
            file=sys.stderr,
        )


if __name__ == "__main__":
    parser = Parser()
    parser.add_argument("model", metavar="stream.onnx")
    parser.add_argument("recording", metavar="recording.npy")
    parser.add_argument("--rate", type=number, metavar="HZ")
    parser.add_argument("--chunk", type=chunk, default=200, metavar="N")
    parser.add_argument("--threshold", type=number, metavar="T")
    parser.add_argument("--decisions", action="store_true")
    run(main, parser.parse_args())
