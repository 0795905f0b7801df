"""Every name, command, configuration key and file that the contract tests reach.

A renaming edits this file alone; its diff since 0.1.0 is the migration table of the changelog.
Left: the word the tests use. Right: what it is called now.
"""

# ruff: noqa: F401  (the imports are the table)
# Names in Python -------------------------------------------------------------------------------

from collections.abc import Sequence

from tactslip_torch import FeaturePool, HandLayout, Scene, SlipDetector, StreamingDetector, simulate

PACKAGE = "tactslip_torch"
BACKENDS = ("torch", "auto")
"""Of ``FeaturePool``: the definitions, and the fastest there is."""

# Commands --------------------------------------------------------------------------------------

BATCH_FIT = "examples/batch_fit.py"
"""In the place of the command ``stats`` of 0.1.0."""
BAD_INPUT_STATUS = 2

# Configuration ---------------------------------------------------------------------------------

KEYS = {
    "channels": "data.channels",
    "cycles": "data.cycles",
    "dtype": "features.dtype",
    "every_decision": "decisions",
    "experiment": "+exp",
    "folder": "hydra.run.dir",
    "format": "to",
    "held_out": "split.unseen",
    "materials": "data.materials",
    "num_features": "recipe.num_features",
    "penalties": "recipe.penalties",
    "root": "data.root",
    "root_of_data": "root",
    "source_of_stream": "source",
    "seen": "split.seen",
    "train_share": "split.train_fraction",
    "workers": "num_workers",
}
"""By the tests' word the key on the command line, where it is another."""


def settings(**given: object) -> list[str]:
    """Overrides for a command line; keys as in ``KEYS``."""
    return [f"{KEYS.get(word, word)}={_written(value)}" for word, value in given.items()]


def _written(value: object) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k}: {_written(v)}" for k, v in value.items()) + "}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ", ".join(map(_written, value)) + "]"
    return str(value)


# Words in files --------------------------------------------------------------------------------

DETECTOR = "detector.pt"
METRICS = "metrics.json"
BIN_GRAPH = "model.onnx"
STREAM_GRAPH = "stream.onnx"
ONSETS = ("onsets.json", "onsets.csv")
MANIFEST = "manifest.csv"
DECISIONS = "{}_decisions.csv"
RUN_FILES = (DETECTOR, METRICS, "config.yaml", "confusion.png", "selected_features.png")
CONVERT = "convert"
UNSEEN_EXPERIMENT = "unseen4"

# metrics.json: the splits' names, and what the fit alone decides
TRAIN, TEST, HELD_OUT = "train", "test", "unseen"
SPLITS = "splits"
CONFUSION = "confusion"
FIT_FACTS = ("selected", "penalty", "validated", "solve", "validation", "num_bins")
TRAINING_RECORDINGS = "train_recordings"  # in the detector's info

STREAM_OUTPUTS = {
    "score": "score",
    "probability": "probability",
    "statistic": "statistic",
    "valid": "is_valid",
    "alarm": "is_alarm",
    "on": "is_on",
    "time_s": "available_s",
    "onset_s": "onset_s",
}
"""Of the stream's graph and of the hosts, beside the fields of what ``push`` returns."""

HOSTS = {
    "python": "{python} {export}/python/detect.py",
    "c": "{build}/detect",
    "node": "node {export}/node/detect.mjs",
}
BUILD_C_HOST = "make -C {export}/c CC=gcc PYTHON={python} BUILD={build}"
HOST_OPTIONS = {"every": "--decisions", "chunk": "--chunk", "threshold": "--threshold"}
HOST_OPTIONS |= {"rate": "--rate"}

# Recordings in files ---------------------------------------------------------------------------

from tactslip_torch.data.formats import FORMATS, Reading, named_format, open_file  # noqa: E402
