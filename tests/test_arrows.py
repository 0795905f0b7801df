"""Parts of the package import each other along one direction."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1] / "tactslip_torch"
_LOWER = ("hand", "native", "signals", "data", "features", "model")
ARROWS = {
    "runtime": (),
    "package_files": ("hand",),
    "hand": (),
    "native": (),
    "signals": ("hand",),
    "data": ("hand", "signals"),
    "simulation": ("hand", "data", "native"),
    "features": ("hand", "signals", "native"),
    "model": ("features", "signals", "native", "hand"),
    "onset": ("model", "features", "signals", "native", "hand"),
    "deploy": ("features", "model", "onset", "signals", "hand"),
    "live": ("hand", "data", "signals", "model", "onset", "deploy"),
    "training": (*_LOWER, "onset", "deploy", "report"),
    "pareto": ("model", "features", "report"),
    "report": (),
}
"""Importer: what it may import beside itself, ``runtime`` and ``package_files``; others may all."""


def part_of(module: str) -> str:
    return module.split(".")[0]


def imports() -> Iterator[tuple[str, str]]:
    """Every module of the package with each module of the package that it imports."""
    for path in ROOT.rglob("*.py"):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ImportFrom) or not node.module:
                continue
            if node.module.startswith("tactslip_torch."):
                yield module, node.module.removeprefix("tactslip_torch.")


def test_parts_import_along_the_arrows() -> None:
    wrong = set()
    for module, imported in imports():
        part, other = part_of(module), part_of(imported)
        if part in ARROWS and other not in (part, "runtime", "package_files", *ARROWS[part]):
            wrong.add(f"{module} -> {imported}")
    assert not wrong, "\n".join(sorted(wrong))


def test_contributing_lists_parts_in_the_order_of_their_imports() -> None:
    text = (ROOT.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
    cells = re.findall(r"^\| (`.*?) \|", text, re.MULTILINE)
    parts = [
        re.sub(r"\.py$|/$", "", name) for cell in cells for name in re.findall("`(.+?)`", cell)
    ]
    on_disk = {path.relative_to(ROOT).parts[0].removesuffix(".py") for path in ROOT.rglob("*.py")}
    assert on_disk - {"__init__"} <= set(parts)
    wrong = {
        f"{module} -> {imported}"
        for module, imported in imports()
        if module != "__init__"
        if parts.index(part_of(imported)) > parts.index(part_of(module))
    }
    assert not wrong, "\n".join(sorted(wrong))
