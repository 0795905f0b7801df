"""Write a detector as ONNX: ``tactslip export model=detector.pt``."""

from __future__ import annotations

from pathlib import Path

import hydra
from omegaconf import DictConfig

from tactslip_torch.commands.entry import conf_dir, errors_in_one_line, run_entry_point
from tactslip_torch.graph.export import export_detector, summary, wanted_graphs
from tactslip_torch.model.detector import SlipDetector


@hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="export")
def main(config: DictConfig) -> None:
    """Entry point."""
    with errors_in_one_line():
        source = Path(config.model)
        detector = SlipDetector.load(source)
        folder = Path(config.output or source.parent)
        if folder.suffix == ".onnx" or folder.is_file():
            raise ValueError(f"output must be a folder, got {folder}; the files have their names")
        graphs = wanted_graphs(config.graph, detector)
        paths = export_detector(detector, folder, graphs, config.precision, source=source)
        for path in paths:
            print(summary(path))


if __name__ == "__main__":
    run_entry_point(main)
