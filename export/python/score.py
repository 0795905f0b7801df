"""Score a recording with an exported detector: onnxruntime and numpy, no torch.

    python score.py model.onnx recording.npy

``recording.npy`` holds volts, [channels, samples], in the order that the model names. Prints
one line per bin: start in seconds, score, slip where the score is at least 0, and a warning where
a channel in use is dead or held a NaN or Inf: such a score is a guess without that channel.
"""

import sys

import numpy as np
import onnxruntime


def score_recording(
    model_path: str, samples: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start in seconds, score and validity of all bins that have their context, ``[N]`` each."""
    session = onnxruntime.InferenceSession(model_path, providers=["CPUExecutionProvider"])
    facts = session.get_modelmeta().custom_metadata_map
    num_channels = len(facts["channels"].split(","))
    length, before = int(facts["bin_samples"]), int(facts["context_before_samples"])
    window = before + length + int(facts["context_after_samples"])
    if samples.ndim != 2 or samples.shape[0] != num_channels:
        raise ValueError(f"expected [{num_channels}, samples], got {samples.shape}")
    if samples.shape[1] < window:
        raise ValueError(f"a bin needs {window} samples, got {samples.shape[1]}")
    windows = np.lib.stride_tricks.sliding_window_view(samples, window, axis=1)
    bins = np.ascontiguousarray(windows[:, ::length].swapaxes(0, 1), dtype=np.float32)
    scores, valid = session.run(["score", "valid"], {"samples": bins})
    starts = before + length * np.arange(len(bins))
    return starts / float(facts["sample_rate_hz"]), scores, valid


def main(model_path: str, recording_path: str) -> None:
    """Print the table."""
    recording = np.load(recording_path, allow_pickle=False)
    for start, score, valid in zip(*score_recording(model_path, recording), strict=True):
        verdict = "slip" if score >= 0 else ""
        warning = "" if valid else "not valid: a sensor is dead or broken"
        print(f"{start:9.4f} s  {score:+9.4f}  {verdict:4}  {warning}".rstrip())


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except (TypeError, ValueError, OSError) as error:
        sys.exit(f"error: {error}")
