"""Mistakes at commands as they are started: one line that says what came and what is wanted."""

import pytest

from .names import BAD_INPUT_STATUS, settings
from .recordings import of_set, split_of_set

MISTAKES = {  # beside those of tests/test_command_line.py, which a page lists
    # command, overrides, words of the line
    "seen and held out": ("train", settings(held_out=["A"]), "A seen unseen"),
    "dtype": ("train", settings(dtype="float16"), "features.dtype float64 float32 'float16'"),
    "another hand": ("evaluate", settings(data="simulated", cycles=2), "4 24 SG1"),
    "precision": ("export", settings(precision="int8"), "precision float32 float64 'int8'"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_line_and_a_failing_exit(command, paper, recordings, name, tmp_path):
    which, overrides, words = MISTAKES[name]
    of_data = [*of_set(recordings), *split_of_set(), *settings(workers=0)]
    given = of_data if which == "train" else settings(model=paper.file)
    ran = command(tmp_path, which, *given, *overrides)
    assert ran.status == BAD_INPUT_STATUS, ran
    (line,) = ran.err.splitlines()
    assert line.startswith("error: ")
    missing = [word for word in words.split() if word not in line]
    assert not missing, ran.err
