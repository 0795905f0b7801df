"""What each command can be told: its keys with their descriptions, from the commented YAML alone.

Nothing here imports torch, so that ``--help`` is there at once. The comments of ``conf/`` are the
only source: the one behind a key describes it (in group files, that of the base file), those at
the top of a file describe the command or the option, and lines ``# tactslip ...`` there are
examples.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import yaml  # type: ignore[import-untyped,unused-ignore]
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

_PACKAGE = Path(__file__).resolve().parents[1]
_CONF_HINT = "train.yaml"
_OURS = re.compile(r"(.+\.)?_\w+_$")  # _target_ and the like: Hydra's, nothing to be set
_WIDTH = 100
_INDENT = 34


def packaged_folder(name: str, hint: str) -> Path:
    """A folder inside the package (wheel) or beside it (checkout, editable install).

    Args:
        name: of the folder.
        hint: a file that is in it.

    Raises:
        FileNotFoundError: if there is none.
    """
    for folder in (_PACKAGE / name, _PACKAGE.parent / name):
        if (folder / hint).is_file():
            return folder
    raise FileNotFoundError(f"no {name} folder with {hint} in or beside {_PACKAGE}; reinstall")


def conf_dir() -> Path:
    """The ``conf`` folder."""
    return packaged_folder("conf", _CONF_HINT)


class Comments(NamedTuple):
    """What a YAML file says of itself.

    Attributes:
        head: the lines at its top, without examples.
        examples: command lines.
        keys: what stands behind or above each key, by its dotted path.
        groups: the same of its defaults list, by ``group`` or ``group@package``.
    """

    head: str
    examples: tuple[str, ...]
    keys: Mapping[str, str]
    groups: Mapping[str, str]


@cache
def comments_of(path: Path) -> Comments:
    """The comments of a YAML file."""
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    top: list[str] = []
    for line in lines:
        if not line.startswith("#"):
            break
        top.append(line.lstrip("# "))
    keys: dict[str, str] = {}
    groups: dict[str, str] = {}

    def behind(line: int, column: int, key_line: int) -> str:
        if found := re.match(r"\s*#\s*(.*)", lines[line][column:]):
            return found[1]
        above: list[str] = []
        while key_line > len(top) and lines[key_line - 1].lstrip().startswith("#"):
            key_line -= 1
            above.insert(0, lines[key_line].lstrip(" #"))
        return " ".join(above)

    def walk(node: yaml.MappingNode, prefix: str) -> None:
        for key, value in node.value:
            name, line = prefix + str(key.value), key.start_mark.line
            if name == "defaults":
                for entry in value.value:
                    if isinstance(entry, yaml.MappingNode):
                        (group, option), *_ = entry.value
                        place = option.end_mark.line, option.end_mark.column
                        groups[str(group.value)] = behind(*place, option.end_mark.line)
                continue
            is_block = isinstance(value, yaml.CollectionNode) and not value.flow_style
            end = (line, key.end_mark.column + 1) if is_block else None
            found = behind(*(end or (value.end_mark.line, value.end_mark.column)), line)
            if found:
                keys[name] = found
            if is_block and isinstance(value, yaml.MappingNode) and name != "hydra":
                walk(value, f"{name}.")

    root = yaml.compose(text, yaml.SafeLoader)
    if isinstance(root, yaml.MappingNode):
        walk(root, "")
    head = [line for line in top if not line.startswith(("tactslip ", "@package"))]
    examples = tuple(line for line in top if line.startswith("tactslip "))
    return Comments(" ".join(head), examples, keys, groups)


class Group(NamedTuple):
    """A group of the configuration: files to choose one of.

    Attributes:
        name: on the command line, ``+exp`` for experiments.
        chosen: the option that is used now.
        options: all there are.
        description: what the group is about.
    """

    name: str
    chosen: str | None
    options: tuple[str, ...]
    description: str


class Key(NamedTuple):
    """A key of the configuration: ``name=value`` sets it."""

    name: str
    value: Any
    description: str


class Composed:
    """A configuration as Hydra composes it, and what its files say of it.

    Args:
        name: of the file in ``conf``.
        overrides: of the command line.
        folder: of configuration of the user's own, ``--config-dir``.

    Attributes:
        config: without Hydra's own section, unresolved.
        keys: those that may be set, in the order of their sections.
        groups: those that apply.
        head: what the command does.
        examples: command lines.

    Raises:
        HydraException: or another of Hydra's, if it cannot be composed.
    """

    def __init__(self, name: str, overrides: Sequence[str] = (), folder: str | None = None) -> None:
        given = list(overrides)
        if folder is not None:
            given.append(f"hydra.searchpath=[{Path(folder).absolute().as_uri()}]")
        with _loader() as loader:
            whole = loader.load_configuration(name, given, RunMode.RUN)
            files = loader.compute_defaults_list(name, given, RunMode.RUN).defaults
        OmegaConf.set_struct(whole, False)
        whole.pop("hydra", None)
        self.config: DictConfig = whole
        own = comments_of(conf_dir() / f"{name}.yaml")
        self.head, self.examples = own.head, own.examples
        self._files: list[tuple[Path, str]] = []
        places = [conf_dir(), *([Path(folder)] if folder is not None else [])]
        for file in files:
            found = [p for at in places if (p := at / f"{file.config_path}.yaml").is_file()]
            if found and not (file.package or "").startswith("hydra"):
                self._files.append((found[0], f"{file.package}." if file.package else ""))
        said: dict[str, str] = {}
        for path, prefix in self._files:
            for key, text in comments_of(path).keys.items():
                said.setdefault(prefix + key, text)  # the base describes
        self._said = said
        plain: Any = OmegaConf.to_container(whole, resolve=False)
        self.keys = tuple(_keys(plain, "", said))
        self.groups = tuple(self._groups(name, own.groups))

    @cached_property
    def known(self) -> dict[str, Any]:
        """Every key that a file but an experiment's has, sections included, with its value."""
        found: dict[str, Any] = {}

        def walk(section: Mapping[str, Any], prefix: str) -> None:
            for key, value in section.items():
                found[f"{prefix}{key}"] = value
                name = f"{prefix}{key}"
                if isinstance(value, dict) and (name not in self._said or _has(self._said, name)):
                    walk(value, f"{name}.")

        for path, prefix in self._files:
            if path.parent.name == "exp":
                continue
            content: Any = OmegaConf.to_container(OmegaConf.load(path))
            for name in ("defaults", "hydra"):
                content.pop(name, None)
            parts = prefix.split(".")[:-1]
            for depth in range(1, len(parts) + 1):
                found.setdefault(".".join(parts[:depth]), {})
            walk(content, prefix)
        return found

    def _groups(self, name: str, said: Mapping[str, str]) -> Iterator[Group]:
        content: Any = OmegaConf.to_container(OmegaConf.load(conf_dir() / f"{name}.yaml"))
        entries = [entry for entry in content.get("defaults", ()) if isinstance(entry, dict)]
        used = {k: v for entry in entries for k, v in entry.items() if not k.startswith("override")}
        for group, chosen in used.items():
            yield Group(group, chosen, options_of(group), said.get(group, ""))
        fitting = tuple(each for each in options_of("exp") if self._fits(each, used))
        if fitting:
            yield Group("+exp", None, fitting, "an experiment: other defaults for several keys")

    def _fits(self, experiment: str, used: Mapping[str, str]) -> bool:
        """Whether an experiment changes nothing that this command does not have."""
        content: Any = OmegaConf.to_container(OmegaConf.load(conf_dir() / f"exp/{experiment}.yaml"))
        groups = {k.removeprefix("override /") for e in content.pop("defaults", ()) for k in e}
        return groups <= set(used) and set(content) <= set(self.config)


@contextmanager
def _loader() -> Iterator[Any]:
    """Hydra's loader of this configuration, which leaves no mark on the process."""
    before = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(conf_dir()), version_base="1.3"):
            yield GlobalHydra.instance().config_loader()
    finally:
        GlobalHydra.instance().hydra = before


def options_of(group: str) -> tuple[str, ...]:
    """The options of a group, which may be given as ``group@package``."""
    folder = conf_dir() / group.partition("@")[0]
    return tuple(sorted(path.stem for path in folder.glob("*.yaml")))


def _keys(section: Mapping[str, Any], prefix: str, said: Mapping[str, str]) -> Iterator[Key]:
    """The keys of a section; of a mapping that is described as a whole, itself alone."""
    for key, value in section.items():
        name = f"{prefix}{key}"
        if _OURS.match(name):
            continue
        if isinstance(value, dict) and value and (not said.get(name) or _has(said, name)):
            is_described = "_target_" in value or _has(said, name)
            yield from _keys(value, f"{name}.", said) if is_described or prefix else ()
        elif value != {} or name in said:
            yield Key(name, value, said.get(name, ""))


def _has(said: Mapping[str, str], name: str) -> bool:
    return any(key.startswith(f"{name}.") for key in said)


def help_text(command: str, summary: str, composed: Composed) -> str:
    """What ``tactslip COMMAND --help`` prints.

    Args:
        command: as it is typed.
        summary: what it does, in a line.
        composed: its configuration: keys of the options that are chosen are told.
    """
    required = [f"{key.name}=VALUE" for key in composed.keys if key.value == "???"]
    experiment = ["[+exp=NAME]"] if any(g.name == "+exp" for g in composed.groups) else []
    words = ["usage: tactslip", command, *required, *experiment, "[KEY=VALUE ...]"]
    lines = [" ".join(words), "", f"{command}: {summary}.", *_wrapped(composed.head, 0), ""]
    lines += ["examples:", *(f"  {example}" for example in composed.examples)]
    if composed.groups:
        lines += ["", "groups of settings (GROUP=OPTION; the default is marked *):"]
        for group in composed.groups:
            options = [f"*{o}" if o == group.chosen else o for o in group.options]
            if group.name == "+exp":
                lines += _row("+exp=NAME", group.description)
                for option in options:
                    head = comments_of(conf_dir() / f"exp/{option}.yaml").head
                    lines += _row(f"  {option}", head)
            else:
                lines += _row(group.name, f"{group.description}: {' '.join(options)}")
        lines += _row("", "GROUP=OPTION beside --help lists the keys of that option")
    lines += ["", "keys (KEY=DEFAULT):"]
    section = ""
    for key in sorted(composed.keys, key=lambda key: "." in key.name):  # those without come first
        if (own := key.name.rpartition(".")[0].partition(".")[0]) != section:
            section = own
            lines += [""]
        value = "" if key.value == "???" else _flow(key.value)
        lines += _row(f"{key.name}={value}", key.description + " (required)" * (key.value == "???"))
    lines += ["", "every command also takes:"]
    for what, text in _EVERYWHERE.items():
        lines += _row(what, text)
    return "\n".join(lines)


_EVERYWHERE = {
    "hydra.run.dir=FOLDER": "folder of the results",
    "-m, --multirun": "a run for each of several values, such as seed=0,1,2; ends in a table",
    "--cfg job": "print the configuration and stop",
    "--config-dir FOLDER": "a folder with configuration of your own",
    "--hydra-help": "Hydra's own options",
    "TACTSLIP_TRACEBACK=1": "environment variable: errors show where they were raised",
}


def _flow(value: Any) -> str:
    """A value as it is typed."""
    text: str = yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...").replace(", ", ",")


def _wrapped(text: str, indent: int) -> list[str]:
    margin = " " * indent
    return textwrap.wrap(
        text, _WIDTH, initial_indent=margin, subsequent_indent=margin, break_on_hyphens=False
    )


def _row(name: str, text: str) -> list[str]:
    """A name, and what it is: behind it where there is place, else below."""
    rows = _wrapped(text, _INDENT)
    if len(name) + 4 <= _INDENT and rows:
        return [f"  {name:{_INDENT - 2}}{rows[0].lstrip()}", *rows[1:]]
    return [f"  {name}", *rows]
