"""``tactslip COMMAND ...``, and ``python -m tactslip_torch COMMAND ...``."""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from importlib import import_module

COMMANDS = {
    "demo": "find the slip in a sample recording, draw it, export; nothing is needed",
    "setup": "look at your recordings, write how they are read: hand.yaml, and a picture",
    "train": "fit a detector, evaluate, save and export it",
    "evaluate": "evaluate a saved detector on recordings",
    "calibrate": "set a detector's alarm and threshold on recordings of its use",
    "detect": "find slips in recordings",
    "stream": "find slips in samples as they come: serial port, socket, stdin or file",
    "generate": "write simulated recordings as files",
    "data": "check, describe and convert recordings in files",
    "export": "write a detector as ONNX",
    "importance": "which sensors matter",
    "pareto": "the most accurate detector within a deadline",
    "hosts": "copy a program that runs an exported detector: python, c, native, node or web",
}
OF_THEIR_OWN = ("demo", "setup", "hosts")
"""Commands without a configuration."""


def main() -> None:
    """Run the command that the first argument names; the others are its own.

    Where nobody reads what it prints, as behind ``| head``, it ends without a word.

    Raises:
        SystemExit: with status 2 if there is no such command.
    """
    try:
        _main()
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _main() -> None:
    given, *rest = sys.argv[1:] or ["--help"]
    if given in ("-h", "--help"):
        print("usage: tactslip COMMAND [KEY=VALUE ...]\n")
        print("\n".join(f"  {name:22}{what}" for name, what in COMMANDS.items()))
        print("\ntactslip COMMAND --help lists the keys of a command, with examples")
        return
    if given in ("-V", "--version"):
        print(f"tactslip_torch {_version()}")
        return
    if given not in COMMANDS:
        near = get_close_matches(given, COMMANDS, 1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(COMMANDS)}"
        print(f"error: no command {given}; {hint}", file=sys.stderr)
        raise SystemExit(2)
    run(given, rest)


def _version() -> str:
    """That of the package, and of libraries that decide numbers."""
    from tactslip_torch.features.cache import versions

    known = versions()
    own = known.pop("tactslip_torch")
    return f"{own} ({', '.join(f'{name} {number}' for name, number in known.items())})"


def run(command: str, arguments: list[str]) -> None:
    """Carry out a command, or print its help, for which nothing heavy is imported.

    Raises:
        SystemExit: with another status than 0 if it failed.
    """
    with _importing():
        from tactslip_torch.commands.configuration import checked, help_text
        from tactslip_torch.commands.stopping import errors_in_one_line, stopping

    with stopping():
        if command in OF_THEIR_OWN:
            sys.argv = [f"tactslip {command}", *arguments]
            with _importing():
                module = import_module(f"{__package__}.commands.{command}")
            module.main()
            return
        asked = [each for each in arguments if each not in ("-h", "--help")]
        with errors_in_one_line():
            line = checked(command, asked)
        if len(asked) < len(arguments):
            print(help_text(COMMANDS[command], line))
            return
        with _importing():
            module = import_module(f"{__package__}.commands.{command.replace('-', '_')}")
        module.main(line)


@contextmanager
def _importing() -> Iterator[None]:
    """Without searches for garbage, which find none in modules."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


if __name__ == "__main__":
    main()
