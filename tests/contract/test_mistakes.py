"""The commonest mistakes at every command: one line that says what came and what is wanted."""

import subprocess
import sys

import pytest

from .names import (
    ALARM_INFO,
    BAD_INPUT_STATUS,
    DETECTOR,
    TRACEBACK_VARIABLE,
    SlipDetector,
    settings,
)
from .recordings import CHANNELS, of_set, split_of_set
from .running import arguments_of, environment


def files(**words):
    """Overrides for the shared set, its split, and more."""
    return [*of_set("{root}"), *split_of_set(), *settings(workers=0, **words)]


MISTAKES = {  # beside those of tests/test_command_line.py, which a page lists
    # command, overrides, words of the line
    "seen and held out": ("train", files(held_out=["A"]), "A seen unseen"),
    "no recordings left": ("train", settings(cycles=0), "cycles 1 0"),
    "dtype": ("train", files(dtype="float16"), "features.dtype float64 float32 'float16'"),
    "too many features": (
        "train",
        files(recipe="paper", num_features=9999),
        "recipe.num_features=9999 506",
    ),
    "channel of no column": (
        "train",
        files(channels=[CHANNELS[0] | {"name": "Z1"}, *CHANNELS[1:]]),
        "Z1 SG1 csv",
    ),
    "evaluate another hand": (
        "evaluate",
        ["data=simulated", *settings(model="{model}", cycles=2)],
        "4 24 SG1",
    ),
    "detect without an alarm": ("detect", settings(model="{bare}", input="{root}"), "alarm onset"),
    "export in a precision": (
        "export",
        settings(model="{model}", precision="int8"),
        "precision float32 float64 'int8'",
    ),
    "export of no alarm": ("export", settings(model="{bare}", graph="stream"), "alarm onset"),
}


@pytest.fixture(scope="module")
def places(general, paper, recordings, tmp_path_factory):
    """What stands for the words in braces: a detector with an alarm, one without, recordings."""
    folder = tmp_path_factory.mktemp("bare")
    bare = SlipDetector.load(general.file)
    del bare.info[ALARM_INFO]
    bare.save(folder / DETECTOR)
    model = paper.file
    return {"{model}": model, "{root}": recordings, "{bare}": folder / DETECTOR}


QUICK = ("seen and held out", "evaluate another hand", "detect without an alarm")
SOME_SLOW = [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in MISTAKES]


@pytest.mark.parametrize("name", SOME_SLOW)
def test_a_mistake_is_one_line_and_a_failing_exit(command, places, name, tmp_path):
    which, overrides, words = MISTAKES[name]
    for word, place in places.items():
        overrides = [override.replace(word, str(place)) for override in overrides]
    ran = command(tmp_path, which, *overrides)
    assert ran.status == BAD_INPUT_STATUS, ran
    (line,) = ran.err.splitlines()
    assert line.startswith("error: ")
    missing = [word for word in words.split() if word not in line]
    assert not missing, ran.err


@pytest.mark.slow
def test_a_traceback_is_there_for_whoever_asks(tmp_path):
    """In a process of its own, as a user starts it."""
    told = settings(model="missing.pt")
    done = subprocess.run(
        [sys.executable, *arguments_of("evaluate", *told)],
        cwd=tmp_path,
        env=environment(**{TRACEBACK_VARIABLE: "1"}),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode != 0
    assert "Traceback" in done.stderr
    assert "missing.pt" in done.stderr
