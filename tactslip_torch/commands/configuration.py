"""What each command can be told: its keys with their descriptions, from the commented YAML alone.

Nothing here imports torch, so that ``--help`` is there at once. The comments of ``conf/`` are the
only source: the one behind a key describes it (in group files, that of the base file), those at
the top of a file describe the command or the option, and lines ``# tactslip ...`` there are
examples.

What is wrong with a command line, in one line: what was typed, what is wanted, what to do.

Hydra composes a configuration from ``key=value``; what it says of one that it cannot compose is
several lines about its grammar. So a command line is composed here first, and each error is told
in the words of this package. Keys that are added (``+key=value``, or in an experiment's file) must
be ones that something takes.
"""

from __future__ import annotations

import inspect
import os
import re
import shutil
import tempfile
import textwrap
import typing
from argparse import ArgumentError, Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from functools import cache, cached_property, reduce
from operator import getitem
from pathlib import Path
from types import UnionType
from typing import Any, NamedTuple

import yaml  # type: ignore[import-untyped,unused-ignore]
from hydra import initialize_config_dir
from hydra._internal.callbacks import Callbacks
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import run_job
from hydra.errors import HydraException
from hydra.types import HydraContext, RunMode
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

_PACKAGE = Path(__file__).resolve().parents[1]
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
    return packaged_folder("conf", "train.yaml")


_NEEDED = {"web": ("web", "node")}
"""Hosts of several folders: the page shares the reader and the stream of ``node``."""
_LEFT = shutil.ignore_patterns("node_modules", "__pycache__", "*.o")


def hosts_dir() -> Path:
    """The ``export`` folder."""
    return packaged_folder("export", "README.md")


def host_names() -> list[str]:
    """The hosts there are."""
    return sorted(path.name for path in hosts_dir().iterdir() if (path / "README.md").is_file())


def copy_host(name: str, folder: Path) -> Path:
    """Copy a host program, with what it shares with others, into a folder.

    Returns:
        Its own folder, ``folder / name``.

    Raises:
        ValueError: if there is no such host.
        FileExistsError: if there is something in its place.
    """
    if name not in host_names():
        raise ValueError(f"no host {name!r}; there are {', '.join(host_names())}")
    parts = _NEEDED.get(name, (name,))
    for part in parts:
        if (folder / part).exists():
            raise FileExistsError(f"{folder / part} is there already; give another folder")
    for part in parts:
        shutil.copytree(hosts_dir() / part, folder / part, ignore=_LEFT)
    return folder / name


class _File(NamedTuple):
    """What is in a YAML file, and what it says of itself.

    Attributes:
        content: without Hydra's section.
        defaults: its defaults list.
        head: the lines at its top, without examples.
        examples: command lines.
        keys: what stands behind or above each key, by its dotted path.
        groups: the same of its defaults list, by ``group`` or ``group@package``.
    """

    content: Mapping[str, Any]
    defaults: Sequence[Any]
    head: str
    examples: tuple[str, ...]
    keys: Mapping[str, str]
    groups: Mapping[str, str]


@cache
def _read(path: Path) -> _File:
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

    loader = yaml.SafeLoader(text)
    if root := loader.get_single_node():
        walk(root, "")
    head = [line for line in top if not line.startswith(("tactslip ", "@package"))]
    examples = tuple(line for line in top if line.startswith("tactslip "))
    content: dict[str, Any] = loader.construct_document(root) if root else {}
    content.pop("hydra", None)
    defaults = content.pop("defaults", [])
    return _File(content, defaults, " ".join(head), examples, keys, groups)


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
        command: as it is typed; its file in ``conf`` has ``_`` in place of ``-``.
        overrides: of the command line.
        folder: of configuration of the user's own, ``--config-dir``.

    Attributes:
        whole: all of it, Hydra's own section as well, which ``run`` uses up.
        config: without Hydra's own section, unresolved.
        head: what the command does.
        examples: command lines.

    Raises:
        HydraException: or another of Hydra's, if it cannot be composed.
    """

    def __init__(
        self, command: str, overrides: Sequence[str] = (), folder: str | None = None
    ) -> None:
        name, given = command.replace("-", "_"), list(overrides)
        if folder is not None:
            given.append(f"hydra.searchpath=[{Path(folder).absolute().as_uri()}]")
        with _loader(name) as loader:
            self.whole: DictConfig = loader.load_configuration(name, given, RunMode.RUN)
            files = loader.compute_defaults_list(name, given, RunMode.RUN).defaults
        self._loader = loader
        own_keys = [key for key in self.whole if key != "hydra"]
        self.config: DictConfig = OmegaConf.masked_copy(self.whole, own_keys)
        OmegaConf.set_struct(self.config, False)
        own = _read(conf_dir() / f"{name}.yaml")
        self.head, self.examples = own.head, own.examples
        self._own = own
        self._files: list[tuple[Path, str]] = []
        places = [conf_dir(), *([Path(folder)] if folder is not None else [])]
        for file in files:
            found = [p for at in places if (p := at / f"{file.config_path}.yaml").is_file()]
            if found and not (file.package or "").startswith("hydra"):
                self._files.append((found[0], f"{file.package}." if file.package else ""))
        self._said: dict[str, str] = {}
        for path, prefix in self._files:
            for key, text in _read(path).keys.items():
                self._said.setdefault(prefix + key, text)  # the base describes

    @cached_property
    def keys(self) -> tuple[Key, ...]:
        """Those that may be set, in the order of their sections."""
        plain: Any = OmegaConf.to_container(self.config, resolve=False)
        return tuple(_keys(plain, "", self._said))

    @cached_property
    def groups(self) -> tuple[Group, ...]:
        """Those that apply."""
        entries = [entry for entry in self._own.defaults if isinstance(entry, dict)]
        used = {k: v for each in entries for k, v in each.items() if not k.startswith("override")}
        groups = [Group(k, v, options_of(k), self._own.groups.get(k, "")) for k, v in used.items()]
        fitting = tuple(each for each in options_of("exp") if self._fits(each, set(used)))
        about = "an experiment: other defaults for several keys"
        return (*groups, *([Group("+exp", None, fitting, about)] if fitting else []))

    def _fits(self, experiment: str, used: set[str]) -> bool:
        """Whether an experiment changes nothing that this command does not have."""
        file = _read(conf_dir() / f"exp/{experiment}.yaml")
        groups = {k.removeprefix("override /") for each in file.defaults for k in each}
        return groups <= used and set(file.content) <= set(self.config)

    def run(self, task: Callable[[DictConfig], None]) -> None:
        """Carry out a task as ``hydra.main`` does, which would compose everything twice more.

        Args:
            task: given the configuration, with ``HydraConfig`` set, in a folder for results that
                holds the configuration and, as it says, the log.

        Raises:
            Exception: what the task raises.
        """
        self.whole.hydra.mode = RunMode.RUN
        callbacks, name = Callbacks(self.whole), self.whole.hydra.job.config_name
        callbacks.on_run_start(self.whole, config_name=name)
        context = HydraContext(self._loader, callbacks)
        done = run_job(task, self.whole, "hydra.run.dir", None, context)
        callbacks.on_run_end(self.whole, config_name=name, job_return=done)
        _ = done.return_value  # raises what the task did

    @cached_property
    def known(self) -> dict[str, Any]:
        """Every key that a file but an experiment's has, sections included, with its value."""
        found: dict[str, Any] = {}

        def walk(section: Mapping[str, Any], prefix: str) -> None:
            for key, value in section.items():
                name = f"{prefix}{key}"
                found[name] = value
                if isinstance(value, dict) and (name not in self._said or _has(self._said, name)):
                    walk(value, f"{name}.")

        for path, prefix in self._files:
            if path.parent.name == "exp":
                continue
            parts = prefix.split(".")[:-1]
            for depth in range(1, len(parts) + 1):
                found.setdefault(".".join(parts[:depth]), {})
            walk(_read(path).content, prefix)
        return found


@contextmanager
def _loader(name: str) -> Iterator[Any]:
    """Hydra's loader for a job of this name, which leaves no mark on the process."""
    before = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(conf_dir()), name, "1.3"):
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
                    lines += _row(f"  {option}", _read(conf_dir() / f"exp/{option}.yaml").head)
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


_ELSEWHERE = (
    "config_name", "config_path", "hydra_help", "info", "shell_completion", "experimental_rerun"
)  # fmt: skip
_PAIRS = {"[": "]", "{": "}", "(": ")"}
_MIRROR = str.maketrans("[]{}()", "][}{)(")


class Mistake(ValueError):
    """A command line that cannot be carried out; its text is one line for the user."""


class Checked(NamedTuple):
    """A command line that can be carried out.

    Attributes:
        arguments: in the order that Hydra wants, options last.
        options: as Hydra reads them.
        composed: the configuration; ``None`` where another one or help of Hydra's is asked for.
    """

    arguments: list[str]
    options: Namespace
    composed: Composed | None


def checked(command: str, arguments: Sequence[str]) -> Checked:
    """A command line, read and composed.

    Args:
        command: as it is typed.
        arguments: of the command line.

    Raises:
        Mistake: if it cannot be composed, or has a key that nothing takes.
    """
    if "TORCHELASTIC_RUN_ID" in os.environ and os.environ.get("RANK", "0") != "0":
        nowhere = ["hydra.run.dir=.", "hydra.output_subdir=null", "hydra/job_logging=stdout"]
        arguments = [*nowhere, *arguments]
    options, rest = _apart(command, arguments)
    overrides, folder, composed = options.overrides, options.config_dir, None
    if not any(getattr(options, name) for name in _ELSEWHERE):
        if folder is not None and not Path(folder).is_dir():
            raise Mistake(f"--config-dir {folder}: there is no such folder")
        _check_words(command, overrides)
        if problem := unknown_choice(arguments):
            raise Mistake(problem)
        overrides = [_readable(override) for override in overrides]
        first = [_first_of(each) for each in overrides] if options.multirun else overrides
        try:
            composed = Composed(command, first, folder)
        except (HydraException, OmegaConfBaseException, ValueError) as error:
            raise Mistake(_translated(command, first, error, folder)) from error
        for key in unknown_keys(composed):
            raise Mistake(_no_key(command, first, key, composed))
    return Checked([*overrides, *rest], options, composed)


@cache
def _plain(command: str) -> Composed:
    """The configuration as the files have it."""
    return Composed(command)


def _composed_or_plain(
    command: str, overrides: Sequence[str], folder: str | None = None
) -> Composed:
    """The configuration with these overrides or, if it cannot be composed, as the files have it."""
    try:
        return Composed(command, overrides, folder)
    except (HydraException, OmegaConfBaseException):
        return _plain(command)


# Words ------------------------------------------------------------------------------------------


def _apart(command: str, arguments: Sequence[str]) -> tuple[Namespace, list[str]]:
    """What Hydra's parser makes of arguments in any order, and those that are no overrides."""
    parser = get_args_parser()
    parser.exit_on_error, parser.allow_abbrev = False, False
    try:
        options, unknown = parser.parse_known_intermixed_args(arguments)
    except ArgumentError as error:
        raise Mistake(f"{error}; {_LIST_KEYS.format(command)}") from None
    if "--" in arguments:
        raise Mistake(f"{command} has no option --; write KEY=VALUE, without dashes")
    if unknown:
        option, found, value = unknown[0].partition("=")
        key = option.lstrip("-").replace("-", "_")
        near = _nearest(key, _names(_plain(command))) or "KEY"
        if not found:
            behind = arguments[arguments.index(unknown[0]) + 1 :][:1]
            value = next((each for each in behind if each[:1] != "-"), "")
        hint = f"write {near}={value or 'VALUE'}, without dashes"
        raise Mistake(f"{command} has no option {option}; {hint}")
    rest = list(arguments)
    for override in options.overrides:
        rest.remove(override)
    return options, rest


def _check_words(command: str, overrides: Sequence[str]) -> None:
    """Refuse words that are no ``key=value``, and brackets and quotes that do not close.

    Raises:
        Mistake: that says how to write the first of them.
    """
    for place, word in enumerate(overrides):
        key, found, value = word.partition("=")
        if word.startswith("~") and key != "~":
            continue
        if what := _unclosed(word):
            whole = " ".join(overrides[place:])
            ends = range(len(word) + 1, len(whole) + 1)
            better = next((whole[:end] for end in ends if not _unclosed(whole[:end])), word + what)
            outer = '"' if "'" in better else "'"
            raise Mistake(
                f"{word} is not closed: {what} is missing; "
                f"write {outer}{better}{outer}, with the quotes"
            )
        if extra := _unclosed(word[::-1].translate(_MIRROR)):
            raise Mistake(f"{word} has a {extra} too many; write '{word.removesuffix(extra)}'")
        if not found:
            raise Mistake(_no_value(command, word, overrides[place + 1 :]))
        if not key.strip("+~ "):
            raise Mistake(f"{word} has no key; write KEY=VALUE, {_LIST_KEYS.format(command)}")
        if value.startswith("="):
            raise Mistake(f"{word} has two =; write {key}={value.lstrip('=')}")


_LIST_KEYS = "tactslip {} --help lists the keys"


def _unclosed(word: str) -> str:
    """The bracket or quote that is missing at the end, or ``""``."""
    open_: list[str] = []
    quote = ""
    for character in word:
        if quote:
            quote = "" if character == quote else quote
        elif character in "'\"":
            quote = character
        elif character in _PAIRS:
            open_.append(_PAIRS[character])
        elif open_ and character == open_[-1]:
            open_.pop()
    return quote or "".join(reversed(open_))


def _no_value(command: str, word: str, rest: Sequence[str]) -> str:
    """What to write in place of a word without ``=``."""
    composed = _plain(command)
    if word in {option for group in composed.groups for option in group.options}:
        group = next(g.name for g in composed.groups if word in g.options)
        return f"{word} has no key; write {group}={word}"
    key, colon, value = word.rstrip(",").partition(":")
    if near := _nearest(key.lstrip("+"), _names(composed)):
        values = [value, *(each for each in rest if each != "=")] if colon else rest
        given = next(
            (each for each in values if each not in ("", "=") and "=" not in each), "VALUE"
        )
        return f"{word} has no value; write {near}={given}, without blanks"
    required = [key.name for key in composed.keys if key.value == "???"]
    if required and ("." in word or "/" in word or Path(word).exists()):
        return f"{word} has no key; write {required[0]}={word}"
    return f"{word} is no KEY=VALUE; {_LIST_KEYS.format(command)}"


def _readable(override: str) -> str:
    """An override as Hydra reads it.

    A value that is nothing in its grammar (``a=b``, ``{material}_{trial}``) is a text. A mapping
    may have new keys; whether something takes them is seen when all is composed.
    """
    key, found, value = override.partition("=")
    if not found or _is_read(override):
        return f"++{override}" if re.match(r"[\w.]+=\s*\{", override) else override
    escaped = value.replace("\\", "\\\\").replace('"', '\\"')
    quoted = f'{key}="{escaped}"'
    return quoted if _is_read(quoted) else override


def _is_read(override: str) -> bool:
    try:
        OverridesParser.create().parse_overrides([override])
    except HydraException:
        return False
    return True


def _first_of(override: str) -> str:
    """An override with the first of its values, as the first run of a sweep has it."""
    try:
        (parsed,) = OverridesParser.create().parse_overrides([override])
        if parsed.is_sweep_override():
            key = override.partition("=")[0]
            return f"{key}={next(iter(parsed.sweep_string_iterator()))}"
    except (HydraException, NotImplementedError, StopIteration):
        pass  # said when it is composed
    return override


# What Hydra says ---------------------------------------------------------------------------------


def unknown_choice(arguments: Sequence[str]) -> str | None:
    """One line about the first argument that names an option its config group does not have.

    Example:
        >>> unknown_choice(["+exp=unseen4", "seed=3"]) is None
        True
        >>> unknown_choice(["labels=quarter_second"])
        'unknown labels quarter_second; known: half_second, whole_slide'
        >>> unknown_choice(["+exp=quik"])[:31]
        'unknown exp quik; known: quick,'
    """
    own = get_args_parser().parse_known_args(arguments)[0].config_dir
    for argument in arguments:
        key, found, value = argument.lstrip("+").partition("=")
        group = key.partition("@")[0]
        if argument.startswith("-") or not found or not group or not (conf_dir() / group).is_dir():
            continue
        known = list(options_of(group))
        known += [path.stem for path in Path(own, group).glob("*.yaml")] if own else []
        for choice in value.strip("'\"[]").split(","):
            if choice and choice.strip() not in known and not value.startswith("{"):
                near = get_close_matches(choice, known, 5)
                order = [*near, *sorted(set(known) - set(near))]
                return f"unknown {group} {choice}; known: {', '.join(order)}"
        if group == "exp" and not argument.startswith("+"):
            return f"write +exp={value}: experiments are added to the configuration"
    return None


def _translated(
    command: str, overrides: Sequence[str], error: Exception, folder: str | None
) -> str:
    """What Hydra raised, in one line."""
    said = str(error)
    if found := re.search(r"Could not override '([^']+)'", said):
        added = [f"+{o}" if o.startswith(f"{found[1]}=") else o for o in overrides]
        composed = _composed_or_plain(command, added, folder)
        section = composed.known.get(found[1].rpartition(".")[0])
        if isinstance(section, dict) and not unknown_keys(composed):
            return f"{found[1]} has no default; write +{found[1]}=VALUE"
    if found := re.search(r"Multiple values for ([\w/@.]+)\. .*: ([\w/.-]+)'", said):
        group, option = found[1], found[2]
        if group == "exp":
            given = [o.partition("=")[2] for o in overrides if o.startswith("+exp=")]
            return f"+exp is given twice; write '+exp=[{','.join(given)}]'"
        return f"+{group}={option} adds a group that is there already; write {group}={option}"
    if found := re.search(r"Could not (?:override|delete from config\.) '([^']+)'", said):
        return _no_key(command, overrides, found[1])
    if found := re.search(r"An item is already at '([^']+)'", said):
        (word,) = [o for o in overrides if o.startswith(f"+{found[1]}=")][:1] or [f"+{found[1]}"]
        return f"{word} adds a key that is there already; write {word.lstrip('+')}"
    if found := re.search(r"Ambiguous value for argument '(.+)'", said):
        key, _, value = found[1].partition("=")
        if _is_choice(key) and not key.startswith("+"):
            return f"{found[1]} has several values; choose one, or add -m for a run of each"
        return (
            f"{found[1]} has several values; write '{key}=[{value}]' for a list, "
            "or add -m for a run of each"
        )
    if found := re.search(r"Sweep parameters '(.+)' requires", said):
        return f"{found[1]} has several values; add -m for a run of each"
    if found := re.search(r"Could not find '([^']+)'", said):
        return f"there is no configuration {found[1]}; {_LIST_KEYS.format(command)}"
    for word in overrides:
        if not _is_read(word):
            return f"{word} cannot be read; write KEY=VALUE, {_LIST_KEYS.format(command)}"
    lines = [line for line in said.splitlines() if line.strip()] or [type(error).__name__]
    return f"{lines[0]}; {_LIST_KEYS.format(command)}"


def _no_key(
    command: str, overrides: Sequence[str], key: str, composed: Composed | None = None
) -> str:
    """That a key is unknown: what is near it, or which option has it."""
    groups = {group.name: group for group in _plain(command).groups}
    head, _, rest = key.partition(".")
    if rest and head in groups:
        having = [o for o in groups[head].options if rest in _keys_of(f"{head}/{o}")]
        chosen = next(
            (o.partition("=")[2] for o in overrides if o.startswith(f"{head}=")),
            groups[head].chosen,
        )
        if having and chosen not in having:
            others = " or ".join(f"{head}={option}" for option in having)
            return f"{head}={chosen} has no key {key}; it is one of {others}"
    if composed is None:
        kept = [o for o in overrides if "." not in o.partition("=")[0] and _is_choice(o)]
        composed = _composed_or_plain(command, kept)
    names = _names(composed)
    if section := _scene_of(key):
        names = [f"{section}.{parameter}" for parameter in sorted(_scene_parameters())]
    near = _nearest(key, names)
    hint = f"did you mean {near}?" if near else _LIST_KEYS.format(command)
    return f"{command} has no key {key}; {hint}"


@cache
def _keys_of(file: str) -> frozenset[str]:
    """The keys of a file of a group and of its bases."""
    content, defaults, *_ = _read(conf_dir() / f"{file}.yaml")
    bases = [entry for entry in defaults if isinstance(entry, str)]
    own = {key for key, _ in _leaves(content)}
    folder = file.partition("/")[0]
    return frozenset(own.union(*(_keys_of(f"{folder}/{b}") for b in bases if b != "_self_")))


def _is_choice(override: str) -> bool:
    key = override.lstrip("+").partition("=")[0].partition("@")[0]
    return (conf_dir() / key).is_dir()


def _names(composed: Composed) -> list[str]:
    """Groups and keys; a section of the configuration may hold keys that were added."""
    keys = [key.name for key in composed.keys if key.name in composed.known]
    return [*(group.name for group in composed.groups), *keys, "hydra.run.dir", "hydra.sweep.dir"]


def _nearest(key: str, names: Sequence[str]) -> str | None:
    """The name that was meant, as far as can be told: one without dots before others."""
    names = sorted(names, key=lambda name: name.count("."))
    by_last = {name.rpartition(".")[2]: name for name in reversed(names)}
    last = key.rpartition(".")[2].lower()
    if last in by_last:
        return by_last[last]
    if near := get_close_matches(key, names, 1, 0.8):
        return near[0]
    near = get_close_matches(last, by_last, 1, 0.75)
    return by_last[near[0]] if near else None


# Keys that something takes -----------------------------------------------------------------------


def unknown_keys(composed: Composed) -> list[str]:
    """Keys of a configuration that are in no file but an experiment's, and that nothing takes."""
    config: Any = OmegaConf.to_container(composed.config, resolve=False)
    known = composed.known
    inner = {name.rpartition(".")[0] for name in known}
    found: dict[str, None] = {}
    for path, _ in _leaves(config):
        parts, section = path.split("."), _scene_of(path)
        depth = next(n for n in range(len(parts), -1, -1) if not n or ".".join(parts[:n]) in known)
        above = ".".join(parts[:depth])
        is_free = above != "" and above not in inner and not section
        if depth == len(parts) or is_free:
            continue
        if section:
            is_taken = parts[section.count(".") + 1] in _scene_parameters()
        else:
            target = reduce(getitem, parts[:depth], config).get("_target_", "")
            is_taken = parts[depth] in {"_target_", "_convert_", "_partial_", *_arguments(target)}
        if not is_taken:
            found[".".join(parts[: depth + 1])] = None
    return list(found)


def _leaves(section: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in section.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{name}.")
        else:
            yield name, value


def _scene_of(key: str) -> str | None:
    """The section of a scene that a key is in, such as ``scene`` or ``extra_scenes.taps``."""
    found = re.match(r"(scene|(?:.+\.)?extra_scenes\.[^.]+)\.", key)
    return found[1] if found else None


@cache
def _scene_parameters() -> frozenset[str]:
    """What can be set of a scene: fields of ``Scene`` and of its groups of parameters."""
    from tactslip_torch.simulation.scene import Scene

    names = {"name", "cycles"}
    for field in fields(Scene):
        names.add(field.name)
        if is_dataclass(field.default_factory):
            names |= {inner.name for inner in fields(field.default_factory)}
    return frozenset(names)


@cache
def _arguments(target: str) -> Mapping[str, Any]:
    """The arguments of a target with their types, as far as they are stated."""
    if not target:
        return {}
    try:
        made = get_object(target)
        names = inspect.signature(made).parameters
    except (ImportError, AttributeError, ValueError, TypeError):
        return {}  # said when it is made
    try:
        types = typing.get_type_hints(made.__init__ if inspect.isclass(made) else made)
    except (NameError, TypeError):
        types = {}
    return {name: types.get(name) for name in names}


def with_lists(config: DictConfig, composed: Composed) -> None:
    """Put a text or number where a list is wanted into a list of one, in place.

    A list is wanted where what is made of a section takes nothing simpler; of a section that
    nothing is made of, where the description of the key begins with "list".
    """
    said = {key.name: key.description for key in composed.keys}
    plain: Any = OmegaConf.to_container(config, resolve=False)
    for path, value in list(_leaves(plain)):
        is_simple = isinstance(value, str | int | float) and not isinstance(value, bool)
        if not is_simple or value == "???" or str(value).startswith("${"):
            continue
        *parts, last = path.split(".")
        wanted = _arguments(reduce(getitem, parts, plain).get("_target_", "")).get(last)
        if _wants_list(wanted, type(value)) if wanted else said.get(path, "").startswith("list"):
            OmegaConf.update(config, path, [value], merge=False)


def _wants_list(wanted: Any, kind: type) -> bool:
    """Whether a type takes lists, and no value of a simple kind."""
    is_union = typing.get_origin(wanted) in (typing.Union, UnionType)
    members = typing.get_args(wanted) if is_union else (wanted,)
    is_simple = any(each in (kind, Any) or (kind is int and each is float) for each in members)
    is_simple |= any(typing.get_origin(each) is typing.Literal for each in members)
    lists = (list, tuple, Sequence)
    return not is_simple and any(typing.get_origin(e) in lists or e in lists for e in members)


# Folders ------------------------------------------------------------------------------------------


def check_folder(composed: Composed, *, is_sweep: bool = False) -> None:
    """Refuse a results folder that cannot be made; Hydra alone would show a trace.

    Args:
        composed: says where results go; ``"."`` is not looked at.
        is_sweep: whether there are several runs.

    Raises:
        Mistake: that says why.

    Example:
        >>> composed = Composed("evaluate", ["hydra.run.dir=/dev/null/a"])
        >>> check_folder(composed)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        tactslip_torch.commands.configuration.Mistake: cannot write to hydra.run.dir=/dev/null...
    """
    of = "sweep" if is_sweep else "run"
    where: Any = OmegaConf.to_container(composed.whole.hydra[of])
    wanted = str(where["dir"]).partition("${")[0]  # what it holds of the configuration is new
    if wanted == ".":
        return
    folder = Path(wanted).absolute()
    nearest = next(place for place in (folder, *folder.parents) if place.exists())
    try:
        with tempfile.TemporaryDirectory(dir=nearest):
            pass
    except OSError as error:
        said = f"cannot write to hydra.{of}.dir={folder}: {error.strerror} at {nearest}"
        raise Mistake(said) from error
