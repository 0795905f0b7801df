"""What contract tests share: one runner of commands, one set, two detectors trained on it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from .modules import of_training
from .names import BIN_GRAPH, DETECTOR, METRICS, STREAM_GRAPH, SlipDetector, settings
from .recordings import of_set, split_of_set, write_set
from .running import Runner

RECIPES = {
    "general": settings(recipe="general"),
    "selected": settings(recipe="robust", num_features=12, penalties=[0.001, 0.1]),
}
"""The default, of statistics over channels; and one of few features."""


class Trained(NamedTuple):
    """A detector, the folder of its run, its metrics and how the command was called."""

    detector: SlipDetector
    folder: Path
    metrics: dict[str, Any]
    overrides: list[str]

    @property
    def file(self) -> Path:
        return self.folder / DETECTOR

    def again(self, **words: object) -> list[str]:
        """The overrides of the run with others behind them, which win."""
        return [*self.overrides, *settings(**words)]


@pytest.fixture(scope="session")
def command() -> Runner:
    return Runner()


@pytest.fixture(scope="session")
def recordings(tmp_path_factory) -> Path:
    return write_set(tmp_path_factory.mktemp("recordings"))


@pytest.fixture(scope="session")
def cache(tmp_path_factory) -> Path:
    """Features of the shared set, made once."""
    return tmp_path_factory.mktemp("cache")


def train(command: Runner, folder: Path, overrides: list[str], **words: object) -> Trained:
    """Run the training in a folder, and read what it left."""
    given = [*overrides, *settings(**words)]
    command.well(folder, "train", *given, *settings(folder="run"))
    run = folder / "run"
    metrics = json.loads((run / METRICS).read_text())
    return Trained(SlipDetector.load(run / DETECTOR), run, metrics, given)


@pytest.fixture(scope="session")
def trained_by(command, recordings, cache, tmp_path_factory):
    """By recipe the detector of the shared set, trained when first asked for."""
    made: dict[str, Trained] = {}

    def trained(recipe: str) -> Trained:
        if recipe not in made:
            how = settings(onset="debounced", workers=0, cache=cache, export=False, baselines=False)
            overrides = [*of_set(recordings), *split_of_set(), *RECIPES[recipe], *how]
            made[recipe] = train(command, tmp_path_factory.mktemp(recipe), overrides)
        return made[recipe]

    return trained


@pytest.fixture(scope="session", params=list(RECIPES))
def trained(request, trained_by) -> Trained:
    """Each of the two detectors."""
    return trained_by(request.param)


@pytest.fixture(
    scope="session", params=["selected", pytest.param("general", marks=pytest.mark.slow)]
)
def trained_or_slow(request, trained_by) -> Trained:
    """The same, the default among the slow tests: for what trains once more."""
    return trained_by(request.param)


@pytest.fixture(scope="session")
def selected(trained_by) -> Trained:
    """The one of few features."""
    return trained_by("selected")


@pytest.fixture(scope="session")
def graphs_of(command, trained_by, tmp_path_factory):
    """By recipe and precision a folder with both graphs, exported when first asked for."""
    made: dict[tuple[str, str], Path] = {}

    def graphs(recipe: str, precision: str = "float32") -> Path:
        key = recipe, precision
        if key not in made:
            folder = tmp_path_factory.mktemp("graphs")
            model = trained_by(recipe).file
            words = settings(model=model, precision=precision, output=folder, graph="both")
            command.well(folder, "export", *words)
            assert {BIN_GRAPH, STREAM_GRAPH} <= {path.name for path in folder.iterdir()}
            made[key] = folder
        return made[key]

    return graphs


class Quick(NamedTuple):
    """The quick experiment on the simulated hand: its folder, and what it executed."""

    folder: Path
    modules: list[str]


@pytest.fixture(scope="session")
def quick(tmp_path_factory) -> Quick:
    folder = tmp_path_factory.mktemp("quick")
    return Quick(folder, of_training(folder))
