"""``tactslip COMMAND ...``, and ``python -m tactslip_torch COMMAND ...``."""

from __future__ import annotations

import runpy
import sys
from difflib import get_close_matches

COMMANDS = {
    "train": "fit a detector, evaluate, save and export it",
    "evaluate": "evaluate a saved detector on recordings",
    "detect": "find slips in recordings",
    "generate": "write simulated recordings as files",
    "data": "check, describe and convert recordings in files",
    "export": "write a detector as ONNX",
    "adapt": "add a material to a detector, or take it out",
    "importance": "which sensors matter",
    "crossval": "every choice of held-out materials",
    "pareto": "the most accurate detector within a deadline",
    "certify": "what float32 does to a detector",
    "calibrate-simulator": "set the free parameters of the simulator",
}


def main() -> None:
    """Run the command that the first argument names; the others are its own.

    Raises:
        SystemExit: with status 2 if there is no such command.
    """
    given, *rest = sys.argv[1:] or ["--help"]
    if given in ("-h", "--help"):
        print("usage: tactslip COMMAND [key=value ...]; tactslip COMMAND --help tells its keys\n")
        print("\n".join(f"  {name:22}{what}" for name, what in COMMANDS.items()))
        return
    if given not in COMMANDS:
        near = get_close_matches(given, COMMANDS, 1)
        hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(COMMANDS)}"
        print(f"error: no command {given!r}; {hint}", file=sys.stderr)
        raise SystemExit(2)
    sys.argv = [f"tactslip {given}", *rest]
    # as __main__, so that Lightning finds what to start again in further processes
    runpy.run_module(
        f"tactslip_torch.commands.{given.replace('-', '_')}", run_name="__main__", alter_sys=True
    )


if __name__ == "__main__":
    main()
