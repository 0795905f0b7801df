"""Programs that run an exported detector without Python: ``tactslip hosts NAME FOLDER``."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from tactslip_torch.commands.packaged import copy_host, host_names


def _add_sample(page: Path) -> None:
    """Put the pretrained detector as ``stream.onnx``, and the sample recording, beside the page."""
    from tactslip_torch.deploy.export import export_detector  # of no need for --help
    from tactslip_torch.model.detector import SlipDetector
    from tactslip_torch.pretrained import NAME, RECORDING

    export_detector(SlipDetector.pretrained(NAME), page, graphs=("stream",))
    shutil.copyfile(RECORDING, page / "recording.npz")


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="tactslip hosts",
        description="Copy a program that runs an exported detector (model.onnx, stream.onnx).",
        epilog="example: tactslip hosts c slip-in-c",
    )
    parser.add_argument("name", help=f"one of {', '.join(host_names())}")
    parser.add_argument("folder", type=Path, help="where its folder is put")
    given = parser.parse_args()
    from tactslip_torch.commands.stopping import errors_in_one_line

    with errors_in_one_line():
        copied = copy_host(given.name, given.folder)
        if given.name == "web":
            _add_sample(copied)
        print(f"{copied}\nhow to build and run it: {copied / 'README.md'}")
