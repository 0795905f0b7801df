"""How long a chain of imports a reader follows."""

import ast
from functools import cache

from .names import PACKAGE
from .running import ROOT

FOLDER = ROOT / PACKAGE
DEEPEST = 9
"""Modules in the longest chain of imports."""


@cache
def depth(module):
    """Modules in the longest chain of imports from one, named from the package on."""
    path = ROOT.joinpath(*module.split(".")).with_suffix(".py")
    if not path.is_file():
        return 0
    imported = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.ImportFrom)]
    whole = {f"{n.module}.{each.name}" for n in imported for each in n.names} - {module}
    whole |= {n.module for n in imported}
    return 1 + max((depth(name) for name in whole if str(name).startswith(PACKAGE)), default=0)


def test_no_chain_of_imports_is_longer():
    paths = [path for path in FOLDER.rglob("*.py") if path.stem != "__init__"]
    of = {p: depth(".".join(p.relative_to(ROOT).with_suffix("").parts)) for p in paths}
    deepest = max(of, key=of.get)
    assert 5 < of[deepest] <= DEEPEST, deepest
