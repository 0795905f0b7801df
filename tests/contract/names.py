"""Every name, command, configuration key and file that the contract tests reach.

A renaming edits this file alone; its diff since 0.1.0 is the migration table of the changelog.
Left: the word the tests use. Right: what it is called now.
"""

# ruff: noqa: F401  (the imports are the table)
# Names in Python -------------------------------------------------------------------------------

from collections.abc import Sequence

from tactslip_torch import (
    AlarmSettings,
    FeaturePool,
    HandLayout,
    Scene,
    SlipDetector,
    StreamingDetector,
    SufficientStats,
    simulate,
)
from tactslip_torch.model.fit import fit_quadratic, held_out_scores

PACKAGE = "tactslip_torch"
REPLACED_NEXT = ("features/", "deploy/")
"""Of the package, what the issue behind this one replaces; not counted in ``modules.py``."""
ENGINES = ("torch", "auto")
"""Of ``FeaturePool``: the definitions, and the fastest there is."""


def FeatureExtractor(pool, selected=None, *, engine="auto"):
    return pool.select(range(len(pool.names)) if selected is None else selected, backend=engine)


def predict_raw(detector, samples, **options):
    """Scores and validity of raw bins that come with their context."""
    return detector.predict_raw(samples, **options)


def score_raw(detector, samples):
    return detector.score_raw(samples)


def stream_with_masked_channels(detector, channels, **options):
    return StreamingDetector(detector, masked_channels=channels, **options)


def solve_moments(stats, penalty):
    return stats.solve(penalty=penalty)


# Commands: the arguments of ``python`` -----------------------------------------------------------

COMMANDS = {
    "train": f"-m {PACKAGE}.train",
    "evaluate": f"-m {PACKAGE} evaluate",
    "detect": f"-m {PACKAGE} detect",
    "stream": f"-m {PACKAGE} stream",
    "generate": f"-m {PACKAGE} generate",
    "data": f"-m {PACKAGE} data",
    "export": f"-m {PACKAGE} export",
    "adapt": f"-m {PACKAGE} adapt",
    "importance": f"-m {PACKAGE} importance",
    "crossval": f"-m {PACKAGE} crossval",
    "pareto": f"-m {PACKAGE} pareto",
    "certify": f"-m {PACKAGE} certify",
    "calibrate": f"-m {PACKAGE} calibrate-simulator",
}
BATCH_FIT = "examples/batch_fit.py"
"""In the place of the command ``stats`` of 0.1.0."""
BAD_INPUT_STATUS = 2
TRACEBACK_VARIABLE = "TACTSLIP_TRACEBACK"

# Configuration ---------------------------------------------------------------------------------

KEYS = {
    "action": "action",
    "baselines": "baselines",
    "bin_ms": "labels.bin_ms",
    "bins": "bins",
    "bins_of_fit": "train_bins",
    "bins_to_explain": "gradient_bins",
    "bins_to_score": "scored_bins",
    "cache": "cache",
    "calibration_points": "most_points",
    "calibration_seeds": "seeds",
    "channels": "data.channels",
    "coverage": "coverage",
    "cycles": "data.cycles",
    "data": "data",
    "deadline_ms": "deadline_ms",
    "draws": "draws",
    "dtype": "features.dtype",
    "engine": "features.backend",
    "every_decision": "decisions",
    "experiment": "+exp",
    "export": "export",
    "extremes": "extremes",
    "fact_cycles": "check_cycles",
    "figure": "figure",
    "folder": "hydra.run.dir",
    "force": "force",
    "format": "to",
    "frames": "features.frames",
    "generated_cycles": "cycles",
    "graph": "graph",
    "held_out": "split.unseen",
    "input": "input",
    "inputs": "inputs",
    "label": "labels",
    "layout": "labels.layout",
    "masked_channels": "masked_channels",
    "material": "material",
    "materials": "data.materials",
    "generated_materials": "materials",
    "materials_of_crossval": "materials",
    "model": "model",
    "most_correlation": "recipe.most_correlation",
    "most_channels": "most_channels",
    "most_compute_us": "compute_us",
    "num_features": "recipe.num_features",
    "num_held_out": "num_unseen",
    "onset": "onset",
    "out": "out",
    "output": "output",
    "pattern": "pattern",
    "penalties": "recipe.penalties",
    "plan": "plan",
    "precision": "precision",
    "recipe": "recipe",
    "recordings": "recordings",
    "resume": "ckpt_path",
    "retime_calls": "retime_calls",
    "root": "data.root",
    "root_of_data": "root",
    "scene_setting": "+scene",
    "search": "search",
    "source_of_stream": "source",
    "speed": "speed",
    "repeat": "repeat",
    "search_calls": "search.calls",
    "search_precisions": "search.arithmetics",
    "search_sizes": "search.sizes",
    "search_timed": "search.most_timed",
    "seed": "seed",
    "seen": "split.seen",
    "shard": "shard",
    "slip_free": "slip_free",
    "split": "split",
    "statistics": "statistics",
    "tolerance": "tolerance",
    "train_share": "split.train_fraction",
    "train_share_of_crossval": "train_fraction",
    "workers": "num_workers",
}
"""By the tests' word the key on the command line."""


def settings(**given: object) -> list[str]:
    """Overrides for a command line; keys as in ``KEYS``."""
    return [f"{KEYS[word]}={_written(value)}" for word, value in given.items()]


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
CHECKPOINT = "last.ckpt"
BIN_GRAPH = "model.onnx"
STREAM_GRAPH = "stream.onnx"
SIDECAR = "{}.json"
ONSETS = ("onsets.json", "onsets.csv")
CERTIFICATE = "certificate.json"
MANIFEST = "manifest.csv"
IMPORTANCE = "sensors.json"
CROSSVAL = "crossval.json"
PARETO = "pareto.json"
DECISIONS = "{}_decisions.csv"
RUN_FILES = (DETECTOR, METRICS, CHECKPOINT, "config.yaml", "confusion.png", "selected_features.png")
CHECK, SUMMARY, CONVERT, TEMPLATE = "check", "summary", "convert", "label_template"
UNSEEN_EXPERIMENT, REAL_EXPERIMENT = "unseen4", "biotacsp_dos"
ADD, UNDO, LIST, FORGET = "add", "undo", "list", "forget"

# metrics.json: the splits' names, and what the fit alone decides
TRAIN, TEST, HELD_OUT = "train", "test", "unseen"
SPLITS = "splits"
CONFUSION = "confusion"
FIT_FACTS = ("selected", "penalty", "kernel", "solve", "validation", "num_bins")
ALARM_INFO = "alarm"  # in the detector's info
TRAINING_RECORDINGS = "train_recordings"  # in the detector's info

# Graphs: inputs and outputs
BIN_INPUT, BIN_OUTPUTS = "samples", ("score", "probability", "valid")
STREAM_INPUTS = ("samples", "tail", "state", "threshold")
STREAM_HANDED_ON = {"tail": "next_tail", "state": "next_state"}
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
    "web": "node {export}/web/shot.mjs",
}
BUILD_C_HOST = "make -C {export}/c CC=gcc PYTHON={python} BUILD={build}"
INSTALL_HOST = "npm ci"  # in the folder of the host, of node and web
HOST_OPTIONS = {"every": "--decisions", "chunk": "--chunk", "threshold": "--threshold"}
HOST_OPTIONS |= {"rate": "--rate"}
"""Beside model and recording, which the web host takes as options of these names."""
WEB_OPTIONS = ("--model", "--recording", "--output")

# Recordings in files ---------------------------------------------------------------------------

from tactslip_torch.data.clock import even_clock  # noqa: E402
from tactslip_torch.data.formats import (  # noqa: E402
    FORMATS,
    Reading,
    endings,
    find_format,
    format_of,
    named_format,
    open_file,
    pieces,
)

INSTALL_FORMATS = 'pip install "tactslip-torch[formats]"'
"""What brings the library of a format that is not installed."""
ISOLATED = {"isolate": True}
MOST_MEMORY, MOST_TIME = "isolate_gib", "isolate_s"
"""Of ``Reading``: in a process of its own, with so much memory and time."""


def rate_in_set(path):
    """The rate at which a set of files takes a recording."""
    from tactslip_torch.data.file_recordings import Stream, look

    return look(path, Stream()).clock.sample_rate_hz
