"""How many modules a reader must follow: of a short training, and of one push of a stream."""

import ast
from functools import cache

import pytest

from .modules import FOLDER, counted, of_push
from .names import PACKAGE
from .recordings import samples_of

MOST_OF_TRAINING = 40
MOST_OF_A_PUSH = 8
"""Without features and deployment, as issue 20 asks."""


DEEPEST = 10
"""Modules in the longest chain of imports."""


@cache
def depth(module):
    """Modules in the longest chain of imports from one, named from the package on."""
    path = FOLDER.parent.joinpath(*module.split(".")).with_suffix(".py")
    if not path.is_file():
        return 0
    imported = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.ImportFrom)]
    whole = {f"{n.module}.{each.name}" for n in imported for each in n.names} - {module}
    whole |= {n.module for n in imported}
    return 1 + max((depth(name) for name in whole if str(name).startswith(PACKAGE)), default=0)


def test_no_chain_of_imports_is_longer():
    paths = [path for path in FOLDER.rglob("*.py") if path.stem != "__init__"]
    of = {p: depth(".".join(p.relative_to(FOLDER.parent).with_suffix("").parts)) for p in paths}
    deepest = max(of, key=of.get)
    assert 5 < of[deepest] <= DEEPEST, deepest


@pytest.mark.slow
def test_a_short_training_executes_so_many_modules(quick):
    modules = counted(quick.modules)
    assert 10 < len(modules) <= MOST_OF_TRAINING, modules


def test_one_push_executes_so_many_modules(trained):
    modules = counted(of_push(trained.detector, samples_of("D", 1)))
    assert 1 < len(modules) <= MOST_OF_A_PUSH, modules
