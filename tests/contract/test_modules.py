"""How many modules a reader must follow: of a short training, and of one push of a stream."""

import pytest

from .modules import counted, of_push, of_training

MOST_OF_TRAINING = 40
MOST_OF_A_PUSH = 8
"""Without features and deployment, as issue 20 asks."""


@pytest.mark.slow
def test_a_short_training_executes_so_many_modules(tmp_path):
    modules = counted(of_training(tmp_path))
    assert 10 < len(modules) <= MOST_OF_TRAINING, modules


def test_one_push_executes_so_many_modules(trained):
    modules = counted(of_push(trained.detector))
    assert 1 < len(modules) <= MOST_OF_A_PUSH, modules
