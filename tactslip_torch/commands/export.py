"""Write a detector as ONNX, or for the C library: ``tactslip export model=detector.pt``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from tactslip_torch.commands.entry import entry_point
from tactslip_torch.data.formats import Reading
from tactslip_torch.deploy.bins import Precision
from tactslip_torch.deploy.export import export_detector, summary, wanted_graphs
from tactslip_torch.deploy.native import NativeFile
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.runtime import check_choice


def export(config: DictConfig, results: Path) -> None:
    """Write the graphs of ``config.model``, each with its sidecar, and print a line on each.

    ``graph=native`` writes the file of the C library in their place.

    They go where ``output`` or ``hydra.run.dir`` says, else beside the detector.
    """
    source = Path(config.model)
    detector = SlipDetector.load(source)
    is_here = results.resolve() == Path.cwd().resolve()
    folder = Path(config.output or (source.parent if is_here else results))
    if folder.suffix == ".onnx" or folder.is_file():
        raise ValueError(f"output must be a folder, got {folder}; the files have their names")
    check_choice("precision", config.precision, ("auto", "float32", "float64"))
    given: Any = OmegaConf.to_container(config.native)
    with_source = given.pop("source")
    if type(with_source) is not bool:
        raise ValueError(f"native.source must be true or false, got {with_source!r}")
    if config.graph == "native":
        made = NativeFile.checked(detector, config.precision, **given)
        reason = f", as in float32 {made.why_double}" if made.why_double else ""
        for path in made.write(folder, source=with_source):
            print(f"{path}: {path.stat().st_size / 1000:.0f} kB, {made.precision}{reason}")
        _tell_tare(detector)
        return
    if with_source or given != {"scale": 1.0, "offset": 0.0}:
        raise ValueError(
            f"native.source={with_source}, native.scale={given['scale']} and "
            f"native.offset={given['offset']} are of graph=native; got graph={config.graph}"
        )
    graphs = wanted_graphs(config.graph, detector)
    precision: Precision = "float32" if config.precision == "auto" else config.precision
    for path in export_detector(detector, folder, graphs, precision, source=source):
        print(summary(path))
    _tell_tare(detector)


def _tell_tare(detector: SlipDetector) -> None:
    """Files take samples as they are; the means that were subtracted for training are not."""
    if tare := Reading.of(detector.info.get("reading") or {}).tare_s:
        print(
            f"note: for training, the mean of {tare[0]:g} to {tare[1]:g} s was taken off each "
            "channel (reading.tare_s); a program that runs these files must take it off too",
            file=sys.stderr,
        )


main = entry_point("export", export)
