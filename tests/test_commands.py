"""The commands as a user runs them: what they leave behind, and what they say of bad input."""

import importlib
import json
from types import SimpleNamespace

import pytest
import torch
from biotac_layout import write_biotac
from contract.recordings import CHANNELS
from hydra.errors import InstantiationException
from small_set import NoiseRecordings

from tactslip_torch import HandLayout, SlipDetector
from tactslip_torch.commands.configuration import _options_of, compose_config
from tactslip_torch.commands.evaluate import evaluate
from tactslip_torch.commands.stopping import one_line
from tactslip_torch.commands.train import train
from tactslip_torch.data.recording import RecordingId, Timeline
from tactslip_torch.training.recipe import General

BAD_INPUT = (ValueError, KeyError, TypeError, OSError, InstantiationException)


class TinyRecordings(NoiseRecordings):
    """Recordings in the place of real ones: two strokes, louder while the hand slides.

    ``scene`` may hold ``slide_s`` and ``rate``; ``channels`` says how many of the four channels
    there are, ``broken`` which recording ends in NaN.
    """

    def __init__(self, seed, cycles, materials, channels=None, scene=None, broken="", **simulated):
        self.hand = HandLayout.from_rows(CHANNELS[-channels:] if channels else CHANNELS)
        self._options = {"slide_s": 0.8, "rate": 2000.0} | (scene or {})
        assert not simulated.get("extra_scenes")
        self.sample_rate_hz = self._options["rate"]
        self.ids = tuple(RecordingId(m, c) for m in materials for c in range(cycles))
        self._seed, self._broken = seed, broken

    def timeline(self, recording):
        slide_s, onsets = self._options["slide_s"], (1.1, 3.1)
        return Timeline(
            duration_s=4.5,
            onsets_s=onsets,
            annotated_onsets_s=onsets,
            sliding_s=tuple((onset, onset + slide_s) for onset in onsets),
            speeds_mm_s=(20.0, 40.0),
            released_s=tuple((onset - 0.04, onset + 0.02) for onset in onsets),
        )

    def key(self, recording):
        own = {"tiny": str(recording), "seed": self._seed, "hand": self.hand.to_rows()}
        return own | self._options | {"broken": self._broken}

    def seed(self, recording):
        return self._seed * 1009 + sum(recording.material.encode()) * 31 + recording.cycle

    def shape(self, noise, time_s, recording, generator):
        for start, end in self.timeline(recording).sliding_s:
            noise[:, (time_s >= start) & (time_s < end)] *= 1.3
        if str(recording) == self._broken:
            noise[0, 2000:] = torch.nan


TINY_DATA = (
    "data._target_=test_commands.TinyRecordings",
    "data.materials=[A,B,C]",
    "data.cycles=4",
)
TINY_SPLIT = ("split.seen=[A,B]", "split.unseen=[C]", "split.train_fraction=0.5")

TINY_FIT = (
    *("recipe.num_features=10", "recipe.penalties=[0.3,3.0]"),
    *("num_workers=0", "export=false"),
)
TINY = (*TINY_DATA, *TINY_SPLIT, *TINY_FIT)
TINY_BY_FOLD = (
    *TINY_DATA,
    *("split=leave_one_material_out", "split.materials=[A,B,C]", "split.train_fraction=0.5"),
    *TINY_FIT,
)


def composed(*overrides, name="train"):
    return compose_config(name, overrides)


def run_train(folder, *overrides):
    """What ``train`` returns, and what it wrote."""
    returned = train(composed(*overrides), folder)
    return returned, json.loads((folder / "metrics.json").read_text())


def assert_same_detector(folder, other):
    own, its = (SlipDetector.load(f / "detector.pt") for f in (folder, other))
    assert own.selected == its.selected
    torch.testing.assert_close(own.state_dict(), its.state_dict(), rtol=1e-9, atol=1e-12)


# A run on recordings that are not simulated ----------------------------------------------------


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A run, and the cache of its features."""
    folder, cache = tmp_path_factory.mktemp("tiny"), tmp_path_factory.mktemp("cache")
    run_train(folder, *TINY, f"cache={cache}")
    return SimpleNamespace(folder=folder, cache=cache)


@pytest.mark.slow
def test_one_fold_per_material_leaves_a_folder_each(tiny, tmp_path):
    _, metrics = run_train(tmp_path, *TINY_BY_FOLD, f"cache={tiny.cache}")
    folds, events = metrics["folds"], metrics["events"]
    assert list(folds) == ["without_A", "without_B", "without_C"]
    for name, fold in folds.items():
        assert (tmp_path / name / "detector.pt").is_file()
        assert list(fold["splits"]["unseen"]["per_material"]) == [name.removeprefix("without_")]
    total = metrics["splits"]["unseen"]
    assert total["num_bins"] == sum(f["splits"]["unseen"]["num_bins"] for f in folds.values())
    assert list(total["per_material"]) == ["A", "B", "C"]
    shared = set.intersection(*(set(fold["selected"]) for fold in folds.values()))
    assert set(metrics["selected"]) == shared
    counts = ("num_recordings", "num_onsets", "num_found", "num_false_alarms")
    for rule, own in events["unseen"].items():
        of_folds = [fold["events"]["unseen"][rule] for fold in folds.values()]
        assert [own[n] for n in counts] == [sum(part[n] for part in of_folds) for n in counts]
        assert list(own["per_material"]) == ["A", "B", "C"]
    trained = [fold["events"]["train"]["two_of_three"]["num_onsets"] for fold in folds.values()]
    assert events["train"]["two_of_three"]["num_onsets"] == sum(trained)  # each by two detectors
    assert "recording_events" not in json.dumps(metrics)


# Evaluate --------------------------------------------------------------------------------------


def test_evaluate_tells_of_recordings_it_was_trained_on(tiny, tmp_path, capsys):
    found = evaluated(tiny, tmp_path, "split.seen=[B,C]", "split.unseen=[A]")
    (overlap,) = found["overlap"].values()
    assert len(overlap["recordings"]) == 2  # half of A's cycles; of B the same ones are tested
    assert {name.partition("/")[0] for name in overlap["recordings"]} == {"A"}
    assert overlap["unseen_materials"] == ["A"]
    out = capsys.readouterr().out
    assert "note: the detector was trained on 2 recordings" in out
    assert "A/" in out


def evaluated(tiny, folder, *overrides):
    given = "data=simulated", "split=unseen4", *TINY_DATA, *TINY_SPLIT
    told = *given, "num_workers=0", f"cache={tiny.cache}"
    model = f"model={tiny.folder / 'detector.pt'}"
    return evaluate(composed(*told, model, *overrides, name="evaluate"), folder)


UNFIT = [
    ("data.channels=3", "the features expect 4 channels SG1..PVDF2, the recordings have 3 SG2"),
    ("+scene.rate=1000.0", "the features expect 2000 Hz, the recordings have 1000 Hz"),
    ("labels.bin_ms=100", "the features expect bins of 100 samples, labels.bin_ms=100 makes"),
    ("split.seen=[A,Foo]", "no recording of material 'Foo'; the set has A, B, C"),
]


@pytest.mark.parametrize(("override", "line"), UNFIT)
def test_evaluate_refuses_what_does_not_fit_the_detector(tiny, tmp_path, override, line):
    with pytest.raises(BAD_INPUT) as caught:
        evaluated(tiny, tmp_path, override)
    assert_one_line(caught.value, line)


# Bad input -------------------------------------------------------------------------------------


def assert_one_line(error, expected):
    line = one_line(error)
    assert expected in line
    assert "\n" not in line


REFUSED = [
    (["data.cycles=1"], "no recording has the role 'test'"),
    (["split.unseen=[]"], "no recording has the role 'unseen'"),
    (["features.frames={SG: 51}", "~features.frames.PVDF"], "no frame for PVDF channels"),
    (["+features.misspelt=1"], "misspelt"),
    (["recipe.num_features=0"], "recipe.num_features must be a positive whole number"),
    (["onset=debounced", "onset.hop_ms=0.3"], "onset.hop_ms=0.3 is 0.6 samples at 2000 Hz"),
    (["+scene.misspelt=1"], "a scene has no parameter misspelt"),
    (["data.channels=[{name: film, kind: FSR, finger: index, segment: distal}]"], "FSR"),
    ([*TINY, "+scene.slide_s=0.03"], "no slip"),  # slides hold no bin of 50 ms
]


@pytest.mark.parametrize(
    ("overrides", "line"), REFUSED, ids=lambda value: value[0] if isinstance(value, list) else ""
)
def test_bad_input_is_refused_before_anything_is_simulated(overrides, line, tmp_path, monkeypatch):
    module = importlib.import_module("tactslip_torch.simulation.simulate")  # the name is a function
    monkeypatch.setattr(module, "simulate", None)
    config = composed("num_workers=0", f"cache={tmp_path / 'cache'}", *overrides)
    with pytest.raises(BAD_INPUT) as caught:
        train(config, tmp_path / "run")
    assert_one_line(caught.value, line)


def test_a_run_that_fails_leaves_the_configuration_of_an_earlier_one(tmp_path, monkeypatch):
    (tmp_path / "config.yaml").write_text("seed: 7\n")
    monkeypatch.setattr(General, "fit", lambda *given, **named: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        train(composed(*TINY, f"cache={tmp_path / 'cache'}"), tmp_path)
    assert (tmp_path / "config.yaml").read_text() == "seed: 7\n"


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["split.seen=[A]", "data.cycles=2", "split.train_fraction=0.5"], "there is one"),
        (["recipe=paper", "recipe.penalties=[0.1]"], "give several recipe.penalties"),
    ],
)
def test_that_no_alarm_will_be_set_is_told_before_the_fit(
    overrides, words, tmp_path, monkeypatch, caplog
):
    def stop(*_):
        raise InterruptedError

    module = importlib.import_module("tactslip_torch.commands.train")
    monkeypatch.setattr(module, "run_experiment", stop)
    with pytest.raises(InterruptedError):
        train(composed(*TINY, *overrides), tmp_path / "run")
    (told,) = [record.message for record in caplog.records if "no alarm is set" in record.message]
    assert words in told


# Experiments, on the simulated hand ---------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", _options_of("exp"))
def test_every_experiment_runs_on_few_recordings(name, tmp_path, tmp_path_factory):
    cache = tmp_path_factory.getbasetemp() / "features"  # made by the first experiment of a kind
    overrides = f"+exp={name}", "num_workers=0", f"cache={cache}", "export=false", "baselines=false"
    fit = ("recipe.views=[pooled]", "recipe.penalties=[1.0,10.0]", "recipe.sample_bins=20")
    told = ["data.materials=[M1,M6,iron]", "data.cycles=2", "split.train_fraction=0.5"]
    if name == "biotacsp_dos":
        told = write_biotac(tmp_path / "biotac")
    elif name == "leave_one_material_out":
        told += ["split.materials=[M1,iron]"]
    else:
        told += ["split.seen=[M1,M6]"]
        told += ["split.unseen=[iron]"] if name not in SEEN_ALONE else []
    if name in ("deploy", "onset"):
        told += ["onset=debounced"]
    config = composed(*overrides, *told, *fit)
    for scene in config.get("extra_scenes") or ():
        told += [f"extra_scenes.{scene}.cycles=2"]
    _, metrics = run_train(tmp_path / "run", *overrides, *told, *fit)
    assert metrics["splits"]


SEEN_ALONE = ("random_bins", "seen6", "sessions")
