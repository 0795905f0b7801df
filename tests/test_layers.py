"""Which module may import which (STYLE.md part 2): the table below, held against the sources."""

import ast
import sys
from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = "tactslip_torch"
ROOT = Path(__file__).parents[1] / PACKAGE

# Importer: what of ours it may import. "room.*" is every module of a room and its public names,
# "*" is everything. A module matches exactly one line, so a new room has to be declared here.
ARROWS: dict[str, tuple[str, ...]] = {
    "hand": (),
    "ledger": (),
    "files": ("ledger",),
    "threads": (),
    "plain": (),
    "engines": (),
    "progress": (),
    "workers": ("progress",),
    "data.recording": ("hand",),
    "data.formats.header": ("data.recording", "hand"),
    "data.formats.reading": ("data.formats.header",),
    "data.formats.stored_array": (),
    "data.formats.npz_members": ("data.formats.refusing",),
    "data.formats.npz": (
        "data.formats.npz_members",
        "data.formats.refusing",
        "data.formats.header",
        "data.formats.reading",
        "data.formats.stored_array",
        "data.recording",
        "hand",
        "files",
    ),
    "data.formats.columns": ("data.formats.reading",),
    "data.formats.text_layout": ("data.formats.reading",),
    "data.formats.text_table": ("data.formats.text_layout",),
    "data.formats.text": (
        "data.formats.columns",
        "data.formats.text_layout",
        "data.formats.text_table",
        "data.formats.header",
        "data.formats.reading",
        "data.recording",
        "hand",
        "files",
    ),
    "data.formats.refusing": ("data.formats.header", "data.formats.reading"),
    "data.formats.arrays": ("data.formats.reading",),
    "data.formats.choosing": (
        "data.formats.arrays",
        "data.formats.columns",
        "data.formats.reading",
        "data.formats.refusing",
    ),
    "data.formats.hdf5_heap": (),
    "data.formats.hdf5_tree": (
        "data.formats.arrays",
        "data.formats.hdf5_heap",
        "data.formats.header",
        "data.formats.reading",
        "data.formats.refusing",
    ),
    "data.formats.hdf5": (
        "data.formats.arrays",
        "data.formats.choosing",
        "data.formats.header",
        "data.formats.hdf5_tree",
        "data.formats.reading",
        "data.formats.refusing",
        "data.recording",
        "hand",
        "files",
    ),
    "data.formats.mat5_elements": ("data.formats.arrays", "data.formats.refusing"),
    "data.formats.mat5": (
        "data.formats.arrays",
        "data.formats.mat5_elements",
        "data.formats.reading",
    ),
    "data.formats.mat73": ("data.formats.hdf5_tree", "data.formats.refusing"),
    "data.formats.mat": (
        "data.formats.arrays",
        "data.formats.choosing",
        "data.formats.header",
        "data.formats.mat5",
        "data.formats.mat5_elements",
        "data.formats.mat73",
        "data.formats.reading",
        "data.formats.refusing",
        "data.recording",
        "hand",
        "files",
    ),
    "data.formats.parquet_table": (
        "data.formats.arrays",
        "data.formats.header",
        "data.formats.reading",
        "data.formats.refusing",
    ),
    "data.formats.parquet": (
        "data.formats.arrays",
        "data.formats.choosing",
        "data.formats.header",
        "data.formats.parquet_table",
        "data.formats.reading",
        "data.formats.refusing",
        "data.recording",
        "hand",
        "files",
    ),
    "data.formats.cdr": (),
    "data.formats.definitions": ("data.formats.cdr", "data.formats.reading"),
    "data.formats.decoding": ("data.formats.cdr",),
    "data.formats.packing": ("data.formats.reading",),
    "data.formats.messages": (
        "data.formats.decoding",
        "data.formats.definitions",
        "data.formats.packing",
    ),
    "data.formats.message_samples": (
        "data.formats.columns",
        "data.formats.decoding",
        "data.formats.messages",
        "data.formats.reading",
    ),
    "data.formats.mcap_records": ("data.formats.packing",),
    "data.formats.mcap_bag": (
        "data.formats.header",
        "data.formats.mcap_records",
        "data.formats.messages",
        "data.formats.packing",
    ),
    "data.formats.sqlite_bag": ("data.formats.messages", "data.formats.packing"),
    "data.formats.blocks": (
        "data.formats.cdr",
        "data.formats.header",
        "data.formats.message_samples",
        "data.formats.messages",
        "data.formats.reading",
        "data.recording",
    ),
    "data.formats.bag_metadata": ("data.formats.header", "data.formats.reading"),
    "data.formats.mcap": (
        "data.formats.blocks",
        "data.formats.header",
        "data.formats.mcap_bag",
        "data.formats.message_samples",
        "data.formats.messages",
        "data.formats.reading",
        "data.recording",
        "files",
        "hand",
    ),
    "data.formats.rosbag2": (
        "data.formats.bag_metadata",
        "data.formats.blocks",
        "data.formats.header",
        "data.formats.mcap_bag",
        "data.formats.message_samples",
        "data.formats.messages",
        "data.formats.reading",
        "data.formats.sqlite_bag",
        "data.recording",
        "hand",
    ),
    "data.formats.registry": (
        "data.formats.header",
        "data.formats.reading",
        "data.recording",
        "hand",
    ),
    "data.folder": (
        "data.formats.header",
        "data.formats.reading",
        "data.formats.registry",
        "data.recording",
        "files",
    ),
    "data.clock_step": (),
    "data.clock_ticks": ("data.clock_step",),
    "data.clock": ("data.clock_step", "data.clock_ticks", "data.formats.reading"),
    "data.sets.manifest_lines": (),
    "data.sets.truth": ("data.sets.manifest_lines",),
    "data.sets.manifest": ("data.sets.manifest_lines", "data.sets.truth", "data.recording"),
    "data.sets.timeline": ("data.sets.truth",),
    "data.sets.digest": (),
    "data.sets.stream": (
        "data.clock",
        "data.formats.*",
        "data.recording",
        "data.sets.truth",
        "hand",
    ),
    "data.sets.sampling": (
        "data.clock",
        "data.formats.*",
        "data.sets.stream",
        "data.sets.truth",
        "signals.resampling",
    ),
    "data.sets.agreement": ("data.clock", "data.sets.stream", "hand"),
    "data.sets.look_memory": (
        "data.clock",
        "data.formats.header",
        "data.sets.stream",
        "data.sets.truth",
        "files",
        "hand",
    ),
    "data.sets.survey": ("data.*", "signals.resampling", "workers"),
    "data.sets.datasets": ("data.*", "hand"),
    "data.sets.inspection": ("data.*",),
    "data.sets.conversion": ("data.*", "files"),
    "data.sets.template": ("data.formats.registry", "data.sets.manifest", "files"),
    "data.sets.authors_raw": ("data.*", "hand"),
    "data.sets.named": ("data.*",),
    "data.sets.hand_file": ("data.*", "hand"),
    "data.labels": ("data.recording",),
    "data.splits": ("data.recording",),
    "data.session_split": ("data.recording", "data.splits"),
    "simulation.*": ("hand", "engines", "data.recording", "simulation.*"),
    "signals.savgol": (),
    "signals.kernel_edges": ("signals.savgol",),
    "signals.filtering": ("signals.savgol", "signals.kernel_edges", "plain"),
    "signals.learnable": ("signals.savgol", "signals.kernel_edges", "signals.filtering"),
    "signals.stream": ("signals.savgol", "signals.filtering"),
    "signals.resampling": (),
    "signals.binning": ("plain",),
    "signals.coverage": ("plain",),
    "signals.finite": ("plain",),
    "signals.spectrum": ("plain",),
    "signals.filter_bank": (),
    "signals.wavelet": ("signals.filter_bank",),
    "signals.lifting": ("signals.filter_bank", "signals.wavelet"),
    "features.guards": ("plain",),
    "features.runs": (),
    "features.sample": ("features.guards", "plain"),
    "features.descriptors": ("features.guards", "features.runs", "features.sample"),
    "features.exact_sums": (),
    "features.soft_order": ("features.guards",),
    "features.smooth": (
        "features.descriptors",
        "features.runs",
        "features.sample",
        "features.soft_order",
    ),
    "features.selection": ("features.exact_sums",),
    "features.bin_sample": (),
    "features.survey": (
        "features.selection",
        "features.bin_sample",
        "features.exact_sums",
        "ledger",
        "files",
    ),
    "features.names": ("features.descriptors", "hand"),
    "features.transforms": ("features.guards",),
    "features.pool": (
        "signals.*",
        "features.transforms",
        "features.descriptors",
        "features.names",
        "features.smooth",
        "features.guards",
        "hand",
        "plain",
    ),
    "features.plan": ("features.names", "features.descriptors", "signals.*", "hand"),
    "features.linear_maps": ("features.pool", "features.guards", "signals.*"),
    "features.eager.*": (
        "features.eager.*",
        "features.plan",
        "features.linear_maps",
        "features.pool",
        "features.descriptors",
        "features.guards",
        "features.runs",
    ),
    "features.compiled.*": (
        "features.compiled.*",
        "features.plan",
        "features.linear_maps",
        "features.pool",
        "features.descriptors",
        "features.guards",
        "features.runs",
    ),
    "features.extractor": (
        "features.eager.engine",
        "features.compiled.engine",
        "features.plan",
        "features.linear_maps",
        "features.pool",
        "features.names",
        "features.guards",
        "engines",
        "plain",
        "threads",
    ),
    "features.rounding": ("features.pool", "signals.*", "hand"),
    "features.ranking": ("features.selection", "features.names", "features.plan"),
    "features.groups": ("features.names", "hand"),
    "features.cache": ("files",),
    "features.invariance": ("features.descriptors",),
    "features.pooling": ("features.names", "hand", "plain"),
    "model.scaling": (
        "features.pooling",
        "plain",
    ),
    "model.kernels": (),
    "model.cholesky": ("threads",),
    "model.condition": ("model.cholesky", "threads"),
    "model.truncation": (),
    "model.symmetric_solve": (
        "model.cholesky",
        "model.condition",
        "model.truncation",
        "threads",
    ),
    "model.rounding": ("model.quadratic",),
    "model.quadratic": ("model.kernels",),
    "model.kernel_sum": ("model.kernels",),
    "model.differentiable_solve": (),
    "model.kernel_elm": (
        "model.differentiable_solve",
        "model.kernels",
        "model.cholesky",
        "model.condition",
        "model.symmetric_solve",
        "model.truncation",
    ),
    "model.fourth_moments": ("model.quadratic", "threads"),
    "model.sufficient": (
        "model.fourth_moments",
        "model.cholesky",
        "model.symmetric_solve",
        "model.quadratic",
        "ledger",
        "files",
    ),
    "model.fit": (
        "model.kernels",
        "model.kernel_elm",
        "model.kernel_sum",
        "model.quadratic",
        "model.fourth_moments",
        "model.cholesky",
        "model.symmetric_solve",
        "model.truncation",
    ),
    "model.downdate": (
        "model.kernels",
        "model.quadratic",
        "model.fourth_moments",
        "model.cholesky",
        "threads",
    ),
    "model.differentiable_fit": (
        "model.differentiable_solve",
        "model.downdate",
        "model.fit",
        "model.kernels",
        "model.kernel_elm",
        "model.quadratic",
        "model.cholesky",
    ),
    "model.left_out": ("model.kernel_elm", "model.cholesky", "model.condition", "threads"),
    "model.held_out": (
        "model.downdate",
        "model.left_out",
        "model.fit",
        "model.kernels",
        "model.kernel_elm",
        "model.kernel_sum",
        "model.quadratic",
        "model.cholesky",
        "threads",
    ),
    "model.once": (),
    "model.held_out_gradient": (
        "model.left_out",
        "model.once",
        "model.fit",
        "model.kernels",
        "model.cholesky",
        "threads",
    ),
    "model.threshold": (),
    "model.calibration": (),
    "model.conformal": (),
    "model.abstention": ("model.conformal", "model.detector"),
    "model.judgement": ("signals.finite", "plain", "threads"),
    "model.detector_file": (
        "features.pooling",
        "features.pool",
        "signals.filtering",
        "model.kernels",
        "model.kernel_sum",
        "model.quadratic",
        "model.scaling",
        "model.class_gaussians",
        "hand",
        "files",
    ),
    "model.class_gaussians": (),
    "model.expected_score": ("model.class_gaussians", "model.quadratic", "plain"),
    "model.missing": (
        "features.pool",
        "model.class_gaussians",
        "model.detector_file",
        "model.expected_score",
        "model.quadratic",
        "plain",
    ),
    "model.widening": ("model.calibration",),
    "model.agreement": (
        "features.pooling",
        "features.pool",
        "signals.filtering",
        "model.class_gaussians",
        "model.detector_file",
        "model.scaling",
    ),
    "model.few_bins": (
        "features.pool",
        "model.detector_file",
        "model.judgement",
        "model.quadratic",
        "model.scaling",
    ),
    "model.detector": ("features.*", "signals.*", "model.*", "plain"),
    "onset.sequential": (),
    "onset.latch": (),
    "onset.rate": ("onset.sequential", "onset.latch"),
    "onset.matching": (),
    "onset.resampling": (),
    "onset.events": ("onset.matching", "onset.resampling"),
    "onset.baselines": ("signals.*", "features.guards", "features.pool", "model.judgement"),
    "onset.scoring": ("model.*", "signals.*"),
    "onset.decider": (
        "onset.latch",
        "onset.sequential",
        "onset.settings",
        "model.calibration",
        "model.widening",
    ),
    "onset.answering": ("onset.decider", "model.*"),
    "onset.settings": ("onset.sequential", "model.*"),
    "onset.streaming": ("onset.*", "model.*", "signals.*"),
    "onset.differentiable": ("onset.*", "model.*"),
    "report.*": ("report.*", "files"),
    "alarming.watching": ("onset.*", "data.*", "workers"),
    "alarming.curve": ("alarming.watching", "onset.*"),
    "alarming.methods": ("alarming.watching", "onset.*", "model.calibration"),
    "alarming.outcome": (
        "alarming.methods",
        "alarming.watching",
        "onset.*",
        "model.*",
        "report.reliability",
        "progress",
    ),
    "alarming.debounced": ("onset.*", "model.detector", "data.labels"),
    "alarming.stage": (
        "alarming.*",
        "onset.*",
        "model.detector",
        "model.calibration",
        "features.cache",
        "data.*",
    ),
    "detect": ("*",),
    "feature_maker": ("data.*", "simulation.*", "signals.*", "features.*", "hand"),
    "datamodule": ("feature_maker", "data.*", "features.*"),
    "recipe": ("data.splits", "model.*", "features.*", "data.recording"),
    "validation": ("recipe", "model.*"),
    "model_selection": ("recipe", "threads", "model.*", "features.*"),
    "planning": ("model_selection", "recipe", "validation", "model.*", "features.*"),
    "abstaining": ("planning", "recipe", "model.*", "features.*"),
    "fitting": ("data.splits", "planning", "model.*", "features.*", "ledger"),
    "pace": ("feature_maker",),
    "tuning.objective": ("model.calibration",),
    "tuning.bins": ("feature_maker", "features.bin_sample", "data.recording", "data.splits"),
    "tuning.described": ("features.*", "signals.*"),
    "tuning.learned": ("tuning.*", "features.*", "model.*", "signals.*"),
    "tuning.grid": ("tuning.objective", "model.*"),
    "tuning.module": ("tuning.*", "model.*"),
    "tuning.stage": (
        "tuning.*",
        "planning",
        "recipe",
        "feature_maker",
        "features.*",
        "model.*",
        "signals.filter_bank",
        "signals.lifting",
        "data.splits",
        "progress",
    ),
    "tuning.second_fit": (
        "tuning.*",
        "learning",
        "recipe",
        "feature_maker",
        "features.*",
        "signals.*",
    ),
    "baselines": ("recipe", "model.*", "features.*"),
    "learning": (
        "baselines",
        "pace",
        "datamodule",
        "feature_maker",
        "data.*",
        "signals.*",
        "features.*",
        "model.*",
        "recipe",
        "planning",
        "abstaining",
        "fitting",
        "judging",
        "onset.events",
        "progress",
        "ranks",
    ),
    "folds": ("judging", "report.answers", "report.scores"),
    "judging": (
        "feature_maker",
        "data.*",
        "report.answers",
        "report.scores",
        "onset.events",
        "onset.latch",
        "onset.sequential",
    ),
    "ranks": ("fitting", "ledger"),
    "experiment": ("*",),
    "fold_training": ("*",),
    "train": ("*",),
    "evaluate": ("*",),
    "export": ("*",),
    "stats": ("*",),
    "crossval": ("*",),
    "importance.*": (
        "importance.*",
        "feature_maker",
        "data.*",
        "signals.*",
        "features.*",
        "model.*",
        "hand",
        "threads",
    ),
    "sensors": ("*",),
    "certificate": (
        "feature_maker",
        "data.*",
        "simulation.*",
        "signals.*",
        "features.*",
        "model.*",
    ),
    "certify": ("*",),
    "graph.value": (),
    "graph.writer": ("graph.value",),
    "graph.form": ("model.detector",),
    "graph.maps": ("features.*", "signals.filtering", "signals.savgol"),
    "graph.shared": ("graph.*", "features.descriptors"),
    "graph.rows": ("graph.*", "features.*", "signals.*", "model.detector"),
    "graph.descriptors": ("graph.*", "features.*"),
    "graph.order": ("graph.*", "features.*"),
    "graph.head": ("features.pooling", "graph.*", "model.*"),
    "graph.missing": ("graph.*", "model.*"),
    "graph.bins": ("graph.*", "features.*", "model.*", "onset.settings"),
    "graph.sequence": ("graph.*", "model.calibration", "onset.*"),
    "graph.stream": ("graph.*", "signals.*", "model.detector", "onset.*"),
    "graph.facts": ("graph.*", "model.detector", "model.abstention", "onset.settings"),
    "graph.alone": (),
    "graph.runs": (),
    "graph.structure": (),
    "graph.trials": ("hand", "simulation.*"),
    "graph.bin_check": ("graph.*", "features.extractor", "model.*", "onset.settings"),
    "graph.stream_check": ("graph.*", "model.*", "onset.*"),
    "graph.check": ("graph.*", "model.detector"),
    "deadline.latency": ("signals.filtering",),
    "deadline.timing": ("features.extractor", "features.pool", "model.detector"),
    "deadline.cost": ("deadline.timing", "features.*", "signals.*", "model.*"),
    "deadline.front": ("deadline.latency", "features.names", "recipe", "signals.filtering"),
    "deadline.search": (
        "validation",
        "model_selection",
        "deadline.front",
        "deadline.latency",
        "deadline.cost",
        "recipe",
        "planning",
        "features.*",
        "signals.filtering",
        "model.*",
        "threads",
    ),
    "deadline.workshop": (
        "deadline.search",
        "deadline.front",
        "deadline.latency",
        "deadline.timing",
        "deadline.cost",
        "datamodule",
        "feature_maker",
        "data.*",
        "signals.*",
        "features.*",
        "model.*",
        "recipe",
        "planning",
        "fitting",
        "graph.*",
        "progress",
    ),
    "pareto": ("*",),
    "facts": ("signals.*", "data.*", "hand"),
    "bracket": (),
    "calibrate": ("*",),
    "generate": ("*",),
    "data_tool": ("*",),
    "adapting.bins": ("features.*", "planning"),
    "adapting.statistics": ("adapting.bins", "model.*", "files", "ledger"),
    "adapting.gathering": (
        "adapting.bins",
        "adapting.statistics",
        "features.*",
        "model.*",
        "recipe",
        "planning",
        "fitting",
    ),
    "adapting.held_out": ("adapting.bins", "adapting.statistics", "model.*"),
    "adapting.acceptance": ("adapting.held_out",),
    "adapting.steps": (
        "adapting.bins",
        "adapting.statistics",
        "adapting.held_out",
        "adapting.acceptance",
    ),
    "adapting.renewal": (
        "adapting.bins",
        "adapting.statistics",
        "adapting.held_out",
        "model.*",
        "onset.settings",
        "fitting",
    ),
    "adapting.naming": ("adapting.bins", "adapting.statistics"),
    "adapting.lock": (),
    "adapting.reading": (
        "adapting.bins",
        "feature_maker",
        "data.*",
        "features.*",
        "model.*",
    ),
    "adapt": ("*",),
    "config": ("*",),
}

# What knows the configuration.
ENTRY = (
    "experiment",
    "fold_training",
    "train",
    "evaluate",
    "export",
    "stats",
    "crossval",
    "certify",
    "pareto",
    "calibrate",
    "generate",
    "data_tool",
    "detect",
    "adapt",
    "sensors",
    "sensors",
    "config",
)

# Packages of others that only these modules may import.
ONLY_IN: dict[str, tuple[str, ...]] = {
    "hydra": ENTRY,
    "omegaconf": ENTRY,
    "lightning": (
        "datamodule",
        "learning",
        "experiment",
        "fold_training",
        "train",
        "progress",
        "tuning.module",
        "tuning.stage",
    ),
    "pytorch_lightning": (),
    "ptwt": ("signals.wavelet",),
    "pywt": ("signals.wavelet",),
    "matplotlib": (
        "report.figures",
        "report.crossval",
        "report.validation",
        "report.adaptation",
        "report.certificate",
        "report.confound",
        "report.pareto",
        "report.selected",
        "report.signals",
        "report.calibration",
        "report.events",
        "report.alarm",
        "report.reliability",
        "report.abstaining",
        "report.onset",
        "report.dataset",
        "report.tuning",
        "report.hand_drawing",
        "report.hand_figure",
        "report.hand_drawing",
        "report.hand_figure",
    ),
    "numba": ("features.compiled.*", "simulation.dynamics.compiled"),
}

# These need torch and the standard library alone.
TORCH_ALONE = (
    "threads",
    "plain",
    "ledger",
    "files",
    "features.exact_sums",
    "features.selection",
    "features.bin_sample",
    "features.survey",
    "model.scaling",
    "model.kernels",
    "model.cholesky",
    "model.condition",
    "model.truncation",
    "model.symmetric_solve",
    "model.rounding",
    "model.quadratic",
    "model.kernel_sum",
    "model.differentiable_solve",
    "model.kernel_elm",
    "model.fourth_moments",
    "model.sufficient",
    "model.fit",
    "model.downdate",
    "model.differentiable_fit",
    "model.left_out",
    "model.held_out",
    "model.once",
    "model.held_out_gradient",
    "model.threshold",
    "model.calibration",
    "model.conformal",
    "onset.sequential",
    "onset.latch",
    "onset.rate",
    "onset.matching",
    "onset.resampling",
    "onset.events",
)


def modules_on_disk() -> dict[str, Path]:
    """Every module of the package by its name without ``tactslip_torch.``; the top keeps it."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts) or PACKAGE] = path
    return found


def is_package(path: Path) -> bool:
    return path.name == "__init__.py"


def imports_of(
    source: str, importer: str, modules: Iterable[str], *, package: bool = False
) -> tuple[set[str], set[str]]:
    """Modules of ours and packages of others that a source imports, wherever in it.

    ``from a import b`` is module ``a.b`` if there is one, else ``a``.
    """
    known = set(modules)
    here = [PACKAGE] + ([] if importer == PACKAGE else importer.split("."))
    ours: set[str] = set()
    others: set[str] = set()

    def add(name: str, member: str = "") -> None:
        if name.split(".")[0] != PACKAGE:
            others.add(name.split(".")[0])
            return
        inner = name.removeprefix(PACKAGE).removeprefix(".")
        whole = f"{inner}.{member}".strip(".")
        ours.add(whole if whole in known else inner or PACKAGE)

    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                add(alias.name)
        elif isinstance(node, ast.ImportFrom):
            up = node.level - (1 if package else 0)
            start = here[: len(here) - up] if node.level else []
            for alias in node.names:
                add(".".join([*start, *filter(None, [node.module])]), alias.name)
    return ours, others


def is_allowed(name: str, patterns: Iterable[str]) -> bool:
    return any(fnmatchcase(name, p) or name == p.removesuffix(".*") for p in patterns)


def rules_for(module: str) -> list[str]:
    return [pattern for pattern in ARROWS if fnmatchcase(module, pattern)]


def violations(
    source: str, importer: str, modules: Iterable[str], *, package: bool = False
) -> list[str]:
    """One line per import that the tables forbid; also if the module has not exactly one rule."""
    ours, others = imports_of(source, importer, modules, package=package)
    if package:  # a room's door shows what is inside; the front door shows anything
        allowed: tuple[str, ...] = ("*",) if importer == PACKAGE else (f"{importer}.*",)
    else:
        rules = rules_for(importer)
        if len(rules) != 1:
            return [f"{importer} needs exactly one line in ARROWS, has {rules}"]
        allowed = ARROWS[rules[0]]
    found = [f"{importer} imports {name}" for name in sorted(ours) if not is_allowed(name, allowed)]
    for name in sorted(others):
        elsewhere = name in ONLY_IN and not is_allowed(importer, ONLY_IN[name])
        too_much = importer in TORCH_ALONE and name not in {"torch", *sys.stdlib_module_names}
        if elsewhere or too_much:
            found.append(f"{importer} imports {name}")
    return found


def cycle_in(graph: Mapping[str, Iterable[str]]) -> list[str]:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


# -------------------------------------------------------------------------------- the sources
MODULES = modules_on_disk()


@pytest.mark.parametrize("module", MODULES)
def test_module_imports_only_what_it_may(module: str) -> None:
    path = MODULES[module]
    source = path.read_text(encoding="utf-8")
    assert violations(source, module, MODULES, package=is_package(path)) == []


def test_no_import_cycle() -> None:
    graph = {}
    for module, path in MODULES.items():
        source = path.read_text(encoding="utf-8")
        graph[module] = imports_of(source, module, MODULES, package=is_package(path))[0]
    assert cycle_in(graph) == []


def test_the_package_was_found() -> None:
    assert {PACKAGE, "hand", "report", "report.scores"} <= set(MODULES)


def test_no_room_has_two_rules() -> None:
    # "a.*" and "a.b" would both claim a.b
    assert [name for name in ARROWS if "*" not in name and len(rules_for(name)) != 1] == []


# -------------------------------------------------------------------------------- the checker
HOUSE = [PACKAGE, "hand", "data", "data.recording", "signals", "signals.filtering"]
HOUSE += ["model", "model.fit", "model.detector", "features", "features.pool", "report.scores"]


@pytest.mark.parametrize(
    ("importer", "source", "forbidden"),
    [
        ("signals.filtering", "from tactslip_torch.model.fit import fit", "model.fit"),
        ("signals.filtering", "from tactslip_torch.model import fit", "model.fit"),
        ("signals.filtering", "import tactslip_torch.model.fit as f", "model.fit"),
        ("signals.filtering", "from ..model import fit", "model.fit"),
        ("signals.filtering", "from .. import hand", "hand"),
        ("signals.filtering", "from . import binning", "signals"),
        ("signals.filtering", "def f():\n    from tactslip_torch import hand", "hand"),
        ("hand", "from tactslip_torch import __version__", PACKAGE),
        ("hand", "import tactslip_torch", PACKAGE),
        ("simulation.scene", "from tactslip_torch.data import Recording", "data"),
        (
            "features.pool",
            "from tactslip_torch.model.detector import SlipDetector",
            "model.detector",
        ),
        ("report.tables", "from tactslip_torch.hand import HandLayout", "hand"),
        ("learning", "import tactslip_torch.train", "train"),
        ("learning", "from hydra.utils import instantiate", "hydra"),
        ("model.detector", "import lightning as L", "lightning"),
        ("features.pool", "import ptwt", "ptwt"),
        ("model.fit", "import os, math, torch, numpy.linalg", "numpy"),
    ],
)
def test_checker_finds_a_forbidden_import(importer: str, source: str, forbidden: str) -> None:
    modules = [*HOUSE, "datamodule"]
    assert violations(source, importer, modules) == [f"{importer} imports {forbidden}"]


@pytest.mark.parametrize(
    ("importer", "source"),
    [
        ("signals.filtering", "import math\nimport torch\nfrom torch import nn"),
        ("signals.wavelet", "from ptwt.conv_transform import wavedec"),
        ("simulation.scene", "from tactslip_torch.data.recording import Recording"),
        ("simulation.scene", "from .motion import Motion\nfrom ..hand import HandLayout"),
        ("model.detector", "from tactslip_torch.features import FeaturePool"),
        ("train", "import hydra, lightning, tactslip_torch\nfrom tactslip_torch.model import fit"),
        ("learning", "from tactslip_torch.model.detector import SlipDetector\nimport lightning"),
    ],
)
def test_checker_lets_an_allowed_import_pass(importer: str, source: str) -> None:
    assert violations(source, importer, [*HOUSE, "simulation.motion"]) == []


def test_checker_on_the_doors_of_rooms() -> None:
    source = "from .filtering import ChannelFilter"
    assert violations(source, "signals", HOUSE, package=True) == []
    assert imports_of(source, "signals", HOUSE, package=True)[0] == {"signals.filtering"}
    source = "from tactslip_torch.hand import HandLayout"
    assert violations(source, "signals", HOUSE, package=True) == ["signals imports hand"]
    assert violations(source, PACKAGE, HOUSE, package=True) == []
    assert imports_of("from .model.fit import fit", PACKAGE, HOUSE, package=True)[0] == {
        "model.fit"
    }


def test_checker_wants_new_rooms_declared() -> None:
    assert violations("", "cellar", HOUSE) == ["cellar needs exactly one line in ARROWS, has []"]
    assert violations("", "model.attic", HOUSE) != []


def test_checker_finds_a_cycle() -> None:
    assert cycle_in({"a": ["b"], "b": ["c"], "c": []}) == []
    assert set(cycle_in({"a": ["b"], "b": ["c"], "c": ["a"]})) == {"a", "b", "c"}
