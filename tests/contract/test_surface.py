"""How many names of the package a reader may take for something to rely on."""

import ast

from .names import PACKAGE
from .running import ROOT

MOST = 590
"""Functions and classes at the top level of modules whose names begin with no underscore."""


def test_no_more_functions_and_classes_are_public():
    modules = [ast.parse(path.read_text()) for path in (ROOT / PACKAGE).rglob("*.py")]
    defined = [
        n for of in modules for n in of.body if isinstance(n, ast.FunctionDef | ast.ClassDef)
    ]
    public = [n.name for n in defined if not n.name.startswith("_")]
    assert 100 < len(public) <= MOST
