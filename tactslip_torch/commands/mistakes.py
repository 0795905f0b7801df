"""What is wrong with a command line, in one line: what was typed, what is wanted, what to do.

Hydra composes a configuration from ``key=value``; what it says of one that it cannot compose is
several lines about its grammar. So a command line is composed here first, and each error is told
in the words of this package. Keys that are added (``+key=value``, or in an experiment's file) must
be ones that something takes.
"""

from __future__ import annotations

import inspect
import re
import tempfile
import typing
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any

from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from tactslip_torch.commands.configuration import Composed, conf_dir, options_of

_ELSEWHERE = {"--config-name", "-cn", "--config-path", "-cp", "--hydra-help", "--info", "--version"}
_ELSEWHERE |= {"--shell-completion", "-sc", "-i"}
_SCENES = re.compile(r"(.+\.)?extra_scenes$")
_PAIRS = {"[": "]", "{": "}", "(": ")"}
_MIRROR = str.maketrans("[]{}()", "][}{)(")


class Mistake(ValueError):
    """A command line that cannot be carried out; its text is one line for the user."""


def checked(command: str, name: str, arguments: Sequence[str]) -> tuple[list[str], Composed | None]:
    """A command line in the order that Hydra wants, and its configuration.

    Args:
        command: as it is typed, for messages.
        name: of its file in ``conf``.
        arguments: of the command line.

    Returns:
        The same arguments, options last; ``None`` where another configuration is asked for.

    Raises:
        Mistake: if it cannot be composed, or has a key that nothing takes.
    """
    overrides, options = _apart(command, name, arguments)
    given = {option.partition("=")[0] for option in options}
    if given & _ELSEWHERE:
        return [*overrides, *options], None
    folder = _folder_of(options)
    if folder is not None and not Path(folder).is_dir():
        raise Mistake(f"--config-dir {folder}: there is no such folder")
    _check_words(command, name, overrides)
    if problem := unknown_choice(arguments):
        raise Mistake(problem)
    overrides = [_readable(override) for override in overrides]
    several = bool(given & {"-m", "--multirun"})
    first = [_first_of(override) for override in overrides] if several else overrides
    try:
        composed = Composed(name, first, folder)
    except (HydraException, OmegaConfBaseException, ValueError) as error:
        raise Mistake(_translated(command, name, first, error, folder)) from error
    for key in unknown_keys(composed):
        raise Mistake(_no_key(command, name, first, key, composed))
    return [*overrides, *options], composed


@cache
def _plain(name: str) -> Composed:
    """The configuration as the files have it."""
    return Composed(name)


# Words ------------------------------------------------------------------------------------------


def _apart(command: str, name: str, arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Overrides, and options with their values: Hydra wants no option between overrides."""
    actions = get_args_parser()._option_string_actions
    overrides: list[str] = []
    options: list[str] = []
    takes = 0
    for place, argument in enumerate(arguments):
        if takes:
            known = actions[options[-1]].choices
            if known and argument not in known:
                wanted = ", ".join(map(str, known))
                raise Mistake(f"{options[-1]} must be one of {wanted}, got {argument}")
            options.append(argument)
            takes = 0
        elif not argument.startswith("-") or argument == "-":
            overrides.append(argument)
        else:
            option, found, value = argument.partition("=")
            if option not in actions:
                key = option.lstrip("-").replace("-", "_")
                near = _nearest(key, _names(_plain(name))) or "KEY"
                if not found:
                    value = next((x for x in arguments[place + 1 :][:1] if x[:1] != "-"), "")
                hint = f"write {near}={value or 'VALUE'}, without dashes"
                raise Mistake(f"{command} has no option {option}; {hint}")
            options.append(argument)
            takes = 0 if found or actions[option].nargs == 0 else 1
    if takes and actions[options[-1]].nargs is None:
        raise Mistake(f"{options[-1]} needs a value; {_LIST_KEYS.format(command)}")
    return overrides, options


def _folder_of(options: Sequence[str]) -> str | None:
    """The user's own folder of configuration, ``--config-dir``."""
    for place, option in enumerate(options):
        if option.startswith("--config-dir="):
            return option.partition("=")[2]
        if option in ("--config-dir", "-cd") and place + 1 < len(options):
            return options[place + 1]
    return None


def _check_words(command: str, name: str, overrides: Sequence[str]) -> None:
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
            raise Mistake(_no_value(command, name, word, overrides[place + 1 :]))
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


def _no_value(command: str, name: str, word: str, rest: Sequence[str]) -> str:
    """What to write in place of a word without ``=``."""
    composed = _plain(name)
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
    own = _folder_of(arguments)
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
    command: str, name: str, overrides: Sequence[str], error: Exception, folder: str | None
) -> str:
    """What Hydra raised, in one line."""
    said = str(error)
    if found := re.search(r"Could not override '([^']+)'", said):
        added = [f"+{o}" if o.startswith(f"{found[1]}=") else o for o in overrides]
        try:
            composed = Composed(name, added, folder)
        except (HydraException, OmegaConfBaseException):
            composed = _plain(name)
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
        return _no_key(command, name, overrides, found[1])
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
    command: str, name: str, overrides: Sequence[str], key: str, composed: Composed | None = None
) -> str:
    """That a key is unknown: what is near it, or which option has it."""
    groups = {group.name: group for group in _plain(name).groups}
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
        try:
            composed = Composed(name, kept)
        except (HydraException, OmegaConfBaseException):
            composed = _plain(name)
    names = _names(composed)
    if section := _scene_of(key):
        names = [f"{section}.{parameter}" for parameter in sorted(_scene_parameters())]
    near = _nearest(key, names)
    hint = f"did you mean {near}?" if near else _LIST_KEYS.format(command)
    return f"{command} has no key {key}; {hint}"


@cache
def _keys_of(file: str) -> frozenset[str]:
    """The keys of a file of a group and of its bases."""
    content: Any = OmegaConf.to_container(OmegaConf.load(conf_dir() / f"{file}.yaml"))
    bases = [entry for entry in content.pop("defaults", ()) if isinstance(entry, str)]
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
        parts = path.split(".")
        depth = next(n for n in range(len(parts), -1, -1) if not n or ".".join(parts[:n]) in known)
        above = ".".join(parts[:depth])
        if depth == len(parts) or (above and above not in inner and not _scene_of(path)):
            continue  # a key of a file, or below a value that is free
        if (_SCENES.match(above) and depth + 1 < len(parts)) or _SCENES.match(path):
            above = ".".join(parts[: depth + 1])
        if section := _scene_of(path):
            if parts[section.count(".") + 1] in _scene_parameters():
                continue
        elif parts[depth] in _accepted(config, parts[:depth]):
            continue
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


def _accepted(config: Mapping[str, Any], parts: Sequence[str]) -> set[str]:
    """Names of arguments of what a section is made into."""
    section: Any = config
    for part in parts:
        section = section[part]
    return set(_arguments(section.get("_target_", ""))) | {"_target_", "_convert_", "_partial_"}


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
        section: Any = plain
        *parts, last = path.split(".")
        for part in parts:
            section = section[part]
        wanted = _arguments(section.get("_target_", "")).get(last)
        if _wants_list(wanted, type(value)) if wanted else said.get(path, "").startswith("list"):
            OmegaConf.update(config, path, [value], merge=False)


def _members(wanted: Any) -> tuple[Any, ...]:
    """The types of a union, or the type alone."""
    is_union = typing.get_origin(wanted) in (typing.Union, type(int | str))
    return typing.get_args(wanted) if is_union else (wanted,)


def _wants_list(wanted: Any, kind: type) -> bool:
    """Whether a type takes lists, and no value of a simple kind."""
    members = _members(wanted)
    is_simple = any(each in (kind, Any) or (kind is int and each is float) for each in members)
    is_simple |= any(typing.get_origin(each) is typing.Literal for each in members)
    lists = (list, tuple, Sequence)
    return not is_simple and any(typing.get_origin(e) in lists or e in lists for e in members)


# Folders ------------------------------------------------------------------------------------------


def folder_problem(arguments: Sequence[str], default: str = "outputs") -> str | None:
    """One line about a results folder that cannot be made; Hydra alone would show a trace.

    Args:
        arguments: of the command line.
        default: where results go if no argument says so; ``"."`` is not looked at.

    Example:
        >>> folder_problem(["hydra.run.dir=/dev/null/recordings"])
        'cannot write to hydra.run.dir=/dev/null/recordings: Not a directory at /dev/null'
    """
    given = {key.lstrip("+"): value for key, _, value in (a.partition("=") for a in arguments)}
    name = "hydra.sweep.dir" if {"-m", "--multirun"} & set(arguments) else "hydra.run.dir"
    if (wanted := given.get(name, default)) == ".":
        return None
    folder = Path(wanted.strip("'\"")).absolute()
    nearest = next(place for place in (folder, *folder.parents) if place.exists())
    try:
        with tempfile.TemporaryDirectory(dir=nearest):
            return None
    except OSError as error:
        return f"cannot write to {name}={folder}: {error.strerror} at {nearest}"
