"""Write a detector as ONNX, or for the C library: ``tactslip export model=detector.pt``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from tactslip_torch.commands.entry import entry_point
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
    if config.graph == "native":
        given: Any = OmegaConf.to_container(config.native)
        with_source = given.pop("source")
        made = NativeFile.checked(detector, config.precision, **given)
        reason = f", as in float32 {made.why_double}" if made.why_double else ""
        for path in made.write(folder, source=with_source):
            print(f"{path}: {path.stat().st_size / 1000:.0f} kB, {made.precision}{reason}")
        return
    graphs = wanted_graphs(config.graph, detector)
    precision: Precision = "float32" if config.precision == "auto" else config.precision
    for path in export_detector(detector, folder, graphs, precision, source=source):
        print(summary(path))


main = entry_point("export", export)
