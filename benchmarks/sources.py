"""Which sources decide the numbers of a benchmark, and whether a section is of the present ones.

The digest of a benchmark is of its module and of all that is imported from there inside this
repository, without comments, docstrings and the package's version; of the files beside these
modules that are compiled or read; and of what ``SOURCES`` of a module names: patterns of files that
it runs and does not import.
A name that a module passes on counts as an import from where it is defined. What prints
tables (``harness``, ``tables``) does not count. Needs the standard library alone.
"""

from __future__ import annotations

import ast
import hashlib
import json
import re
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
_PACKAGES = ("tactslip_torch", "benchmarks")
_SHOW = {ROOT / "benchmarks" / name for name in ("harness.py", "tables.py", "sources.py")}
_BESIDE = (".c", ".cpp", ".h", ".json")
_TARGET = re.compile(r"^\s*_target_:\s*(\S+)", re.MULTILINE)
_OPTION = re.compile(r"(?:^|[\s+~'\"])(\w+)=(\w*)$")
"""Of a group, in the words of a command line; nothing behind the sign: a name is put in."""
_DEFAULT = re.compile(r"^ +- (?:override +)?/?(?:(\w+)(?:@\S+)?: +)?(\w+)\b", re.MULTILINE)
_COMMENT = re.compile(r"(?:^|(?<=\s))#.*", re.MULTILINE)
_SECTION = re.compile(r"`python -m benchmarks\.(\w+)[^`]*`[^\n]*?\bcode ([0-9a-f]{16})[^\n]*")
STALE = "*The code has changed since this was measured: numbers of the present code may differ.*"
"""Stands below the line that names command and code of such a section."""


def digest(name: str) -> str:
    """Of the sources of ``python -m benchmarks.NAME``."""
    found = hashlib.sha256()
    for path in sources(name):
        found.update(path.relative_to(ROOT).as_posix().encode())
        found.update(_content(path))
    return found.hexdigest()[:16]


def is_current(name: str) -> bool:
    """Whether the kept numbers of a benchmark, and those it takes, are of the present sources."""
    path = RESULTS / f"{name}.json"
    if not path.exists() or json.loads(path.read_text(encoding="utf-8"))["code"] != digest(name):
        return False
    return all(is_current(of.stem) for of in sources(name) if of.parent == RESULTS)


def sections(page: str) -> list[tuple[str, str]]:
    """The benchmark and the digest of code of each line of a page that names both."""
    return _SECTION.findall(page)


def marked(page: str) -> str:
    """The page with a sentence below each such line whose benchmark is not current."""
    return _SECTION.sub(
        lambda found: found[0] if is_current(found[1]) else f"{found[0]}\n\n{STALE}\n", page
    )


def sources(name: str) -> list[Path]:
    """The files that decide the numbers of a benchmark, in order."""
    found, left = set[Path](), [ROOT / "benchmarks" / f"{name}.py"]
    while left:
        path = left.pop()
        if path not in found and path not in _SHOW:
            found.add(path)
            left += _followed(path)
        left = left or [of for of in _configuration(found) if of not in found]
    return sorted(found)


def _configuration(found: Iterable[Path]) -> list[Path]:
    """What commands of these files are configured by: their own files and the options chosen.

    A command's own file counts with its module, and ``scenes.yaml`` with every command.
    An option is chosen by the defaults of a file that counts, or by the strings of a benchmark,
    such as ``+exp=unseen4``; one that ends in ``recipe=`` chooses all options of the group.
    """
    commands = ROOT / "tactslip_torch" / "commands"
    if commands / "configuration.py" not in found:
        return []
    words = [
        node.value
        for path in found
        if path.parent == ROOT / "benchmarks" and path.suffix == ".py"
        for node in ast.walk(_tree(path))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    chosen = {option for word in words for option in _OPTION.findall(word)}
    for path in found:
        if path.suffix == ".yaml":
            group = path.parent.relative_to(ROOT / "conf").as_posix()
            chosen |= {
                (of or group, option)
                for of, option in _DEFAULT.findall(path.read_text(encoding="utf-8"))
            }
    own = {"scenes", *(path.stem for path in found if path.parent == commands)}
    options = sorted(ROOT.glob("conf/*/*.yaml"))
    return [
        *(of for of in sorted(ROOT.glob("conf/*.yaml")) if of.stem in own),
        *(of for of in options if {(of.parent.name, of.stem), (of.parent.name, "")} & chosen),
    ]


@cache
def _followed(path: Path) -> list[Path]:
    """What a file needs: modules that it imports or names, and files beside it."""
    if path.suffix == ".yaml":
        named = _TARGET.findall(path.read_text(encoding="utf-8"))
        return [of for target in named if (of := _defined(*target.rpartition(".")[::2]))]
    if path.suffix != ".py":
        return []
    tree = _tree(path)
    needed = [of for module, name in _imports(tree) if (of := _defined(module, name))]
    needed += [of for of in path.parent.iterdir() if of.suffix in _BESIDE]
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "SOURCES":
            for pattern in ast.literal_eval(node.value):
                needed += sorted(of for of in ROOT.glob(pattern) if of.is_file())
    return needed


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def _imports(tree: ast.Module, *, with_types: bool = False) -> Iterator[tuple[str, str]]:
    """Module and name of each import, anywhere but under ``if TYPE_CHECKING``."""
    left: list[ast.AST] = [tree]
    while left:
        node = left.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            left += node.body if with_types else node.orelse
        elif isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from ((node.module or "", alias.name) for alias in node.names)
        else:
            left += ast.iter_child_nodes(node)


def _defined(module: str, name: str) -> Path | None:
    """The file that defines a name of a module; None outside this repository."""
    if module.partition(".")[0] not in _PACKAGES:
        return None
    if name and (path := _file(f"{module}.{name}")):
        return path
    path = _file(module)
    for other, passed_on in _imports(_tree(path), with_types=True) if path and name else ():
        if passed_on == name and other != module:
            return _defined(other, name) or path
    return path


def _file(module: str) -> Path | None:
    place = ROOT / module.replace(".", "/")
    each = (place.with_suffix(".py"), place / "__init__.py")
    return next((path for path in each if path.exists()), None)


@cache
def _content(path: Path) -> bytes:
    """A file's bytes; of Python and YAML without comments, docstrings and layout."""
    if path.suffix == ".py":
        return "".join(_said(_tree(path))).encode()
    if path.suffix == ".yaml":
        lines = _COMMENT.sub("", path.read_text(encoding="utf-8")).splitlines()
        return "\n".join(text for line in lines if (text := line.rstrip())).encode()
    return path.read_bytes()


def _said(node: object) -> Iterable[str]:
    """The same in every version of Python that can read the file."""
    if isinstance(node, list):
        for each in node:
            yield from _said(each)
    elif not isinstance(node, ast.AST):
        yield repr(node)
    elif not (_is_docstring(node) or _is_version(node)):
        yield f"({type(node).__name__}"
        for name, value in ast.iter_fields(node):
            if value not in (None, []):
                yield f" {name}="
                yield from _said(value)
        yield ")"


def _is_version(node: object) -> bool:
    """Whether a statement is the package's version, by which a release differs."""
    return isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__version__"


def _is_docstring(node: ast.AST) -> bool:
    """Whether a statement is a string alone."""
    is_alone = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return is_alone and isinstance(node.value.value, str)  # type: ignore[attr-defined]
