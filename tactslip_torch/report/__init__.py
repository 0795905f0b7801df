"""Reports for people: scores per bin, tables, figures, and the paper's numbers beside."""

from tactslip_torch.report.metrics import bin_metrics, confusion_matrix, split_metrics
from tactslip_torch.report.published import PublishedSplit
from tactslip_torch.report.results import (
    confusion_figure,
    materials_table,
    selected_features_figure,
    selected_table,
    solve_line,
    splits_table,
    timing_table,
)

__all__ = [
    "PublishedSplit",
    "bin_metrics",
    "confusion_figure",
    "confusion_matrix",
    "materials_table",
    "selected_features_figure",
    "selected_table",
    "solve_line",
    "split_metrics",
    "splits_table",
    "timing_table",
]
