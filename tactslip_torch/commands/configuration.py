"""The configuration of a command: Hydra composes it, its commented YAML files describe it.

Nothing here imports torch, so that help and mistakes come at once.
"""

from __future__ import annotations

import os
import re
import shlex
import textwrap
from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import yaml  # type: ignore[import-untyped,unused-ignore]
from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from tactslip_torch.commands import packaged_folder

_COMMENTED = re.compile(r"( *)(?:- )?([\w@/]+):(?: +([^#\s].*?))?(?: +# (.*))?$")
_WIDTH, _INDENT = 100, 34
_HELP = """
every command also takes:
  hydra.run.dir=FOLDER            folder of the results
  -m, --multirun                  a run for each of several values, such as seed=0,1,2, and a table
  --cfg job                       print the configuration and stop
  --config-dir FOLDER             a folder with configuration of your own
  TACTSLIP_TRACEBACK=1            environment variable: errors show where they were raised"""

HAND_FILE = "hand.yaml"
"""How the recordings of its folder are read and labelled; written by ``tactslip setup``."""
_MANIFEST = "manifest.csv"
OF_HAND = ("data", "labels", "features", "split")
"""Its sections."""
_SECTIONS = {
    "train": OF_HAND,
    "pareto": OF_HAND,
    "evaluate": ("data", "labels"),
    "calibrate": ("data", "labels"),
    "data": ("data", "labels", "features"),
}
"""Of each command that takes a folder, the sections of ``hand.yaml`` that it has."""
_PLACES = {"detect": "input", "stream": "source"}
"""The key of commands that take a file or folder and need no labels."""
FOLDER_KEYS = {name: ["data.root"] for name in _SECTIONS}
FOLDER_KEYS |= {"data": ["root", "action"], "detect": ["input"]}
"""The keys that a folder as first argument sets, by command."""
_OWN = "own"


class CommandLine(NamedTuple):
    """A command line that can be carried out.

    Attributes:
        command: the first word.
        arguments: for ``hydra.main``: overrides, then options.
        typed: the arguments as they were given.
        options: of the command line, such as ``multirun``.
        config: composed, with Hydra's own section; of several values each key has the first.
    """

    command: str
    arguments: list[str]
    typed: list[str]
    options: Namespace
    config: DictConfig


class Key(NamedTuple):
    """A key that ``name=value`` sets, with the comment that describes it."""

    name: str
    value: Any
    description: str


def conf_dir() -> Path:
    """The folder ``conf``."""
    return packaged_folder("conf", "train.yaml")


@cache
def presets() -> Mapping[str, Mapping[str, Any]]:
    """Options of groups that are no files of their own, ``conf/scenes.yaml``; registered once."""
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    text = (conf_dir() / "scenes.yaml").read_text(encoding="utf-8")
    groups: dict[str, dict[str, Any]] = yaml.load(text, loader)
    for group, options in groups.items():
        for name, node in options.items():
            ConfigStore.instance().store(name, node, group)
    return groups


def compose_config(
    command: str,
    overrides: Sequence[str] = (),
    folder: str | None = None,
    *,
    with_hydra: bool = False,
) -> DictConfig:
    """The configuration of a command.

    Args:
        command: name of its file in ``conf``.
        overrides: such as ``"seed=1"``.
        folder: with configuration of the user's own.
        with_hydra: with Hydra's own section as well.

    Raises:
        HydraException: or another of Hydra's, if it cannot be composed.
    """
    given = list(overrides)
    if folder is not None:
        given.append(f"hydra.searchpath=[{Path(folder).absolute().as_uri()}]")
    presets()
    with initialize_config_dir(str(conf_dir()), command, "1.3"):
        config = compose(command, given, return_hydra_config=with_hydra)
    OmegaConf.set_struct(config, False)
    return config


def _options_of(group: str) -> list[str]:
    """The options of a group."""
    group = group.partition("@")[0]
    files = (conf_dir() / group).glob("*.yaml") if group else ()
    return sorted([*(path.stem for path in files), *presets().get(group, ())])


def _groups(hydra: Any) -> dict[str, str]:
    """The groups, such as ``GROUP@PACKAGE``, with their options, from Hydra's own section."""
    chosen = hydra.runtime.choices.items()
    return {group: str(option) for group, option in chosen if re.fullmatch(r"[\w.@]+", group)}


# Keys and help ------------------------------------------------------------------------------------


@cache
def _comments(path: Path) -> dict[str, str]:
    """The comment behind each key of a YAML file, by the key's dotted path."""
    found: dict[str, str] = {}
    sections: list[tuple[int, str]] = []
    key = ""
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
        if match := _COMMENTED.match(line):
            indent, name, comment = len(match[1]), match[2], match[4]
            sections = [section for section in sections if section[0] < indent]
            key = ".".join([*(own for _, own in sections), name])
            sections.append((indent, name))
        else:  # a value goes on
            comment = (re.search(r"\S +# (.*)", line) or [None, None])[1]
        if comment:
            found.setdefault(key, comment)
    return found


@cache
def _described(group: str, option: str) -> dict[str, str]:
    """Comments of the file of an option, and of its bases, which come first."""
    path = conf_dir() / group.partition("@")[0] / f"{option}.yaml"
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    bases = re.findall(r"(?m)^  - (\w+)$", text.partition("defaults:\n")[2])
    own = _comments(path)
    for base in bases:
        own = own | (_described(group, base) if base != "_self_" else {})
    return own


def _keys_of(command: str, config: DictConfig, hydra: Any = None) -> list[Key]:
    """The keys that may be set, in the order of the configuration.

    A mapping that is described as a whole is one key.

    Args:
        command: name of its file in ``conf``.
        config: its configuration.
        hydra: Hydra's own section, if it is not in ``config``.
    """
    said = {
        f"{group.partition('@')[2] or group}.{key}": text
        for group, option in _groups(hydra or config.hydra).items()
        for key, text in _described(group, option).items()
    }
    for key, text in _described("", command).items():
        said.setdefault(key, text)
    sections = {key.rpartition(".")[0] for key in said}

    def walk(section: Mapping[str, Any], prefix: str) -> Iterator[Key]:
        for key, value in section.items():
            name = f"{prefix}{key}"
            if re.fullmatch(r"_\w+_", str(key)) or name in (*presets(), "hydra"):
                continue
            if isinstance(value, dict) and value and (name in sections or name not in said):
                yield from walk(value, f"{name}.")
            elif value != {} or name in said:
                yield Key(name, value, said.get(name, ""))

    plain: Any = OmegaConf.to_container(config, resolve=False)
    return list(walk(plain, ""))


def help_text(summary: str, line: CommandLine) -> str:
    """What ``tactslip COMMAND --help`` prints, with the keys of the options that are chosen."""
    command, config = line.command, line.config
    path = conf_dir() / f"{command}.yaml"
    head = [row[2:] for row in path.read_text().partition("defaults:")[0].splitlines()]
    keys, about = _keys_of(command, config), _described("", command)
    groups = {
        name: at
        for name, at in reversed(_groups(config.hydra).items())
        if f"defaults.{name}" in about
    }
    required = [key.name for key in keys if key.value == "???"]
    given = FOLDER_KEYS.get(command, [])
    words = [f"{name}=VALUE" for name in required if name not in given]
    folder = ["FOLDER" if set(given) & set(required) else "[FOLDER]"] if given else []
    lines = [" ".join(["usage: tactslip", command, *folder, *words, "[KEY=VALUE ...]"]), ""]
    lines += [f"{command}: {summary}.", *(row for row in head if not row.startswith("tactslip "))]
    lines += ["", "examples:", *(f"  {row}" for row in head if row.startswith("tactslip "))]
    if groups:
        lines += ["", "groups of settings (GROUP=OPTION; the default is marked *):"]
        for group, chosen in groups.items():
            options = " ".join(f"*{o}" if o == chosen else o for o in _options_of(group))
            lines += _row(group, f"{about[f'defaults.{group}']}: {options}")
        lines += _row("", "GROUP=OPTION beside --help lists the keys of that option")
        lines += _row("+exp=NAME", "an experiment: other defaults for several keys")
        for option in _options_of("exp"):
            text = (conf_dir() / f"exp/{option}.yaml").read_text(encoding="utf-8")
            if set(re.findall(r"override /(\w+):", text)) <= set(groups):
                comments = re.findall(r"(?m)^# (.*)$", text.partition("\ndefaults:")[0])
                lines += _row(f"  {option}", " ".join(comments[1:]))
    lines += ["", "keys (KEY=DEFAULT):"]
    before = ""
    for key in sorted(keys, key=lambda key: "." in key.name):  # those without a section come first
        if before != (before := key.name.partition(".")[0] if "." in key.name else ""):
            lines.append("")
        flow = yaml.safe_dump(key.value, default_flow_style=True, width=10_000, sort_keys=False)
        value = "" if key.value == "???" else flow.removesuffix("\n").removesuffix("\n...")
        text = key.description + " (required)" * (key.value == "???")
        lines += _row(f"{key.name}={value.replace(', ', ',')}", text)
    return "\n".join(lines) + "\n" + _HELP


def _row(name: str, text: str) -> list[str]:
    """A name, and what it is: behind it where there is place, else below."""
    margin = " " * _INDENT
    rows = textwrap.wrap(text, _WIDTH, initial_indent=margin, subsequent_indent=margin)
    if len(name) + 4 <= _INDENT and rows:
        return [f"  {name:{_INDENT - 2}}{rows[0].lstrip()}", *rows[1:]]
    return [f"  {name}", *rows]


# Mistakes -----------------------------------------------------------------------------------------


class _Parser(ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ValueError(message)


def checked(command: str, arguments: Sequence[str]) -> CommandLine:
    """A command line, read and composed.

    Raises:
        ValueError: if it cannot be composed.
    """
    typed = list(arguments)
    arguments = _with_folder(command, arguments)
    has_hand = list(arguments) != typed
    if "TORCHELASTIC_RUN_ID" in os.environ and os.environ.get("RANK", "0") != "0":
        nowhere = ["hydra.run.dir=.", "hydra.output_subdir=null", "hydra/job_logging=stdout"]
        arguments = [*nowhere, *arguments]
    parser = _Parser(allow_abbrev=False, add_help=False)
    parser.add_argument("overrides", nargs="*")
    parser.add_argument("-m", "--multirun", action="store_true")
    parser.add_argument("-c", "--cfg", choices=("job", "hydra", "all"))
    parser.add_argument("--resolve", action="store_true")
    parser.add_argument("-cd", "--config-dir")
    options, unknown = parser.parse_known_intermixed_args(arguments)
    if unknown:
        key, _, value = unknown[0].lstrip("-").partition("=")
        near = _nearest(command, key.replace("-", "_")) or "KEY"
        hint = f"write {near}={value or 'VALUE'}, without dashes"
        raise ValueError(f"{command} has no option {unknown[0]}; {hint}")
    if options.config_dir is not None and not Path(options.config_dir).is_dir():
        raise ValueError(f"--config-dir {options.config_dir}: there is no such folder")
    rest = list(arguments)
    for override in options.overrides:
        rest.remove(override)
    overrides, config = _composed(command, options)
    known = {key.name.partition(".")[0] for key in _keys_of(command, config) if key.description}
    for name in config:
        if str(name) not in known.union(_groups(config.hydra), presets(), ("hydra",)):
            raise ValueError(_no_key(command, str(name), config))
    if has_hand:
        for own in _keys_of(command, config):
            if not own.description and own.name.partition(".")[0] in OF_HAND:
                raise ValueError(f"{HAND_FILE}: {_no_key(command, own.name, config)}")
    return CommandLine(command, [*overrides, *rest], typed, options, config)


def _composed(command: str, options: Namespace) -> tuple[list[str], DictConfig]:
    """The overrides as Hydra reads them, and the configuration.

    A value that is nothing in Hydra's grammar (``a=b``, ``{material}_{trial}``) is a text. With
    ``--multirun`` the first of several values is composed.
    """
    overrides, tried = list(options.overrides), list(options.overrides)
    while True:
        try:
            config = compose_config(command, tried, options.config_dir, with_hydra=True)
            return overrides, config
        except (HydraException, OmegaConfBaseException, ValueError) as error:
            swept = re.search(r"(?:argument|parameters) '(.+)'", str(error))
            if options.multirun and swept and (word := swept[1]) in tried:
                key, _, values = word.partition("=")
                first, *others = re.sub(r"\w+\(|\)", "", values).split(",")
                tried[tried.index(word)] = f"{key}={first}"
                known = _options_of(key.lstrip("+"))
                for option in others if known and not options.config_dir else ():
                    if option not in known:
                        raise ValueError(_unknown(key.lstrip("+"), option, known)) from error
                continue
            word = error.override if isinstance(error, OverrideParseException) else ""
            key, found, value = word.partition("=")
            is_closed = value.count("{") == value.count("}")
            if found and word in overrides and is_closed and value[:1] not in "'\"[=":
                escaped = value.replace("\\", "\\\\").replace('"', '\\"')
                quoted = f'{key}="{escaped}"'
                for words in (overrides, tried):
                    words[words.index(word)] = quoted
                continue
            raise ValueError(_translated(command, tried, error)) from error


def _translated(command: str, overrides: Sequence[str], error: Exception) -> str:
    """What Hydra raised, in one line."""
    text, listed = str(error), f"tactslip {command} --help lists the keys"
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, option = error.missing_cfg_file.rpartition("/")
        return _unknown(group, option, sorted({*_options_of(group), *(error.options or ())}))
    if found := re.search(r"(?:argument|parameters) '(.+)'", text):
        key, _, value = found[1].partition("=")
        hint = "" if "(" in value else f", or write '{key}=[{value}]' for a list"
        return f"{found[1]} has several values; add -m for a run of each{hint}"
    if isinstance(error, OverrideParseException):
        key = re.match(r"[+~]*([\w.@/]*)", error.override)[1]  # type: ignore[index]
        near_key = "+exp" if key == "exp" else _nearest(command, key) or "KEY"
        hint = f"write {near_key}=VALUE without blanks, in quotes if it has any"
        return f"{error.override} cannot be read; {hint}; brackets and quotes must close"
    if found := re.search(r"Multiple values for ([\w/]+)", text):
        values = [
            word.partition("=")[2] for word in overrides if found[1] in word.partition("=")[0]
        ]
        hint = f"'+exp=[{','.join(values)}]'" if found[1] == "exp" else f"{found[1]}={values[-1]}"
        return f"{found[1]} is given twice; write {hint}"
    if found := re.search(r"An item is already at '([^']+)'", text):
        return f"{found[1]} is there already; write {found[1]}=VALUE, without +"
    if found := re.search(r"Could not (?:override|delete)[^']*'([^'=]+)", text):
        return _no_key(command, found[1], *_tried(command, overrides))
    return f"{(text.splitlines() or [type(error).__name__])[0]}; {listed}"


def _unknown(group: str, option: str, known: Sequence[str]) -> str:
    near = get_close_matches(option, known, 3)
    order = [*near, *(each for each in known if each not in near)]
    return f"unknown {group} {option}; known: {', '.join(order)}"


def _tried(command: str, overrides: Sequence[str]) -> list[DictConfig]:
    """The configuration with the options of groups alone."""
    groups = [word for word in overrides if _options_of(word.partition("=")[0].lstrip("+"))]
    try:
        return [compose_config(command, groups, with_hydra=True)]
    except (HydraException, OmegaConfBaseException):
        return []


def _no_key(command: str, key: str, config: DictConfig | None = None) -> str:
    """That a key is unknown: which option has it, or what is near it."""
    config = config or compose_config(command, with_hydra=True)
    if key == "exp":
        return "experiments are added: write +exp=NAME"
    group, _, rest = key.partition(".")
    chosen = _groups(config.hydra).get(group)
    having = [
        f"{group}={option}"
        for option in _options_of(group)
        if any(f"{rest}.".startswith(f"{own}.") for own in _described(group, option))
    ]
    if chosen and rest and having and f"{group}={chosen}" not in having:
        return f"{group}={chosen} has no key {key}; {' or '.join(having)} has it"
    near = _nearest(command, key, config)
    hint = f"did you mean {near}?" if near else f"tactslip {command} --help lists the keys"
    if group in config and rest and not near:
        hint += f", +{key}=VALUE sets what has no default"
    return f"{command} has no key {key}; {hint}"


def _nearest(command: str, key: str, config: DictConfig | None = None) -> str | None:
    """The name that was meant: one without dots before others."""
    config = config or compose_config(command, with_hydra=True)
    keys = [each.name for each in _keys_of(command, config) if each.description]
    names = ["hydra.run.dir", *_groups(config.hydra), *keys]
    names = sorted(names, key=lambda name: name.count("."))
    by_last = {name.rpartition(".")[2]: name for name in reversed(names)}
    last = key.rpartition(".")[2].lower()
    if last in by_last:
        return by_last[last]
    near = get_close_matches(key, names, 1, 0.8) or get_close_matches(last, by_last, 1, 0.75)
    return by_last.get(near[0], near[0]) if near else None


def with_lists(command: str, config: DictConfig, hydra: Any) -> None:
    """Put a text or number where the description of a key says "list" into a list, in place."""
    for key in _keys_of(command, config, hydra):
        is_simple = isinstance(key.value, str | int | float) and not isinstance(key.value, bool)
        is_set = key.value != "???" and not str(key.value).startswith("${")
        if is_simple and is_set and key.description.startswith("list"):
            OmegaConf.update(config, key.name, [key.value], merge=False)


# A folder of recordings as the first argument -----------------------------------------------------


def _with_folder(command: str, arguments: Sequence[str]) -> list[str]:
    """The arguments of a command, a folder or file as the first of them made overrides.

    Args:
        command: its name.
        arguments: as they were typed.

    Raises:
        ValueError: in one line, if the folder is none or does not say how it is read.
    """
    first, *rest = arguments or [""]
    if not first or first[:1] in "-+~" or "=" in first:
        return list(arguments)
    if command not in _SECTIONS and command not in _PLACES:
        return list(arguments)
    folder = Path(first)
    if not folder.exists():
        top = conf_dir() / f"{command}.yaml"
        if re.search(rf"(?m)^(?:  - )?{re.escape(first.partition('.')[0])}:", top.read_text()):
            return list(arguments)  # a key without its value, which is told so
        raise ValueError(f"no folder at {first}; give a folder of recordings, or KEY=VALUE")
    more = [word for before, word in pairwise(arguments) if not before.startswith("-")]
    more = [word for word in more if "=" not in word and Path(word).exists()]
    if more:
        raise ValueError(
            f"{command} takes one folder or file, and {more[0]} is a second; give the folder"
        )
    if command in _PLACES:
        return [f"{_PLACES[command]}={_quoted(first)}", *rest]
    if not folder.is_dir():
        raise ValueError(f"{first} is a file; give the folder that it is in")
    settings = _hand_settings(command, folder, rest)
    kept = {name: settings[name] for name in _SECTIONS[command] if settings.get(name)}
    node: dict[str, Any] = {"defaults": _group_options(command, kept), **kept}
    node.setdefault("data", {})["root"] = str(folder)
    if command in ("train", "pareto"):
        node["name"] = re.sub(r"[^\w.-]+", "_", folder.resolve().name) or "own"
    if command == "train":
        node["train_on_all"] = True
    if command == "data":
        node["root"] = str(folder)
        if not any(word.startswith("action=") for word in rest):
            rest = ["action=check", *rest]
    ConfigStore.instance().store(_OWN, node, _OWN, package="_global_")
    return [f"+{_OWN}={_OWN}", *rest]


def _group_options(command: str, settings: Mapping[str, Any]) -> list[Any]:
    """The options of groups that recordings of one's own take."""
    files = "named" if "pattern" in settings.get("data", {}) else "files"
    chosen: list[Any] = [{"override /data": files}]
    if command in ("train", "pareto"):
        chosen.append({"override /split": "groups"})
    return [*chosen, "_self_"]


def _hand_settings(command: str, folder: Path, rest: Sequence[str]) -> dict[str, Any]:
    """What ``hand.yaml`` says, else the detector that is given, else nothing but a manifest.

    Raises:
        ValueError: if it is no such file, or nothing says how the folder is read.
    """
    path = folder / HAND_FILE
    if path.is_file():
        return _read_hand(path)
    model = next((word.removeprefix("model=") for word in rest if word.startswith("model=")), None)
    if model is not None and Path(model).is_file():
        from tactslip_torch.model.detector import SlipDetector  # torch, which help does without

        info = SlipDetector.load(model).info
        if "data" in info:
            data = {**info["data"], "reading": info.get("reading", {})}
            if "pattern" not in data and not (folder / _MANIFEST).is_file():
                data["pattern"] = "auto"
            return {"data": data, "labels": info.get("labels", {})}
    if (folder / _MANIFEST).is_file():
        return {}
    raise ValueError(
        f"{folder} has neither {HAND_FILE} nor {_MANIFEST}, so it is not known how it is read; "
        f"tactslip setup {shlex.quote(str(folder))} looks at it and writes {HAND_FILE}"
    )


def _read_hand(path: Path) -> dict[str, Any]:
    """The sections of ``hand.yaml``.

    Raises:
        ValueError: in one line, if it is none.
    """
    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no YAML: {' '.join(str(error).split())}") from None
    if not isinstance(found, dict) or not set(found) <= set(OF_HAND):
        has = ", ".join(map(str, found)) if isinstance(found, dict) else repr(found)[:40]
        raise ValueError(f"{path} must have the sections {', '.join(OF_HAND)}, got {has}")
    for name, section in found.items():
        if section is not None and not isinstance(section, dict):
            raise ValueError(f"{path}: {name} must be KEY: VALUE lines, got {section!r}")
        if hidden := [key for key in section or {} if str(key).startswith("_")]:
            raise ValueError(f"{path}: {name} has no key {hidden[0]}; remove it")
    return {name: section for name, section in found.items() if section}


def _quoted(text: str) -> str:
    """A text that Hydra reads as it is."""
    escaped = text.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"
