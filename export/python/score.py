"""Score a recording with an exported detector: onnxruntime and numpy, no torch.

    python score.py model.onnx recording.npy

``recording.npy`` holds volts, [channels, samples], in the order that the model names. Prints
one line per bin: start in seconds, score, and slip where the score is at least 0.
"""

import sys

import numpy as np
import onnxruntime


def score_recording(model_path: str, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bin starts in seconds, and the scores of all bins that have their context, ``[N]`` each."""
    session = onnxruntime.InferenceSession(model_path, providers=["CPUExecutionProvider"])
    facts = session.get_modelmeta().custom_metadata_map
    num_channels = len(facts["channels"].split(","))
    length, context = int(facts["bin_samples"]), int(facts["context_samples"])
    if samples.ndim != 2 or samples.shape[0] != num_channels:
        raise ValueError(f"expected [{num_channels}, samples], got {samples.shape}")
    if samples.shape[1] < length + 2 * context:
        raise ValueError(f"a bin needs {length + 2 * context} samples, got {samples.shape[1]}")
    windows = np.lib.stride_tricks.sliding_window_view(samples, length + 2 * context, axis=1)
    bins = np.ascontiguousarray(windows[:, ::length].swapaxes(0, 1), dtype=np.float32)
    scores = session.run(["score"], {"samples": bins})[0]
    starts = context + length * np.arange(len(bins))
    return starts / float(facts["sample_rate_hz"]), scores


def main(model_path: str, recording_path: str) -> None:
    """Print the table."""
    starts, scores = score_recording(model_path, np.load(recording_path, allow_pickle=False))
    for start, score in zip(starts, scores, strict=True):
        print(f"{start:9.4f} s  {score:+9.4f}  {'slip' if score >= 0 else ''}".rstrip())


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except (TypeError, ValueError, OSError) as error:
        sys.exit(f"error: {error}")
