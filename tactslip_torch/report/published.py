"""The paper's results, as constants that tables and figures put beside ours.

Source: He et al. 2026, arXiv:2603.18370, section V. The paper splits at random over bins, so
neighbouring bins of one slide lie on both sides, and its features were ranked on all bins.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

PAPER = "He et al. 2026, arXiv:2603.18370"

PAPER_SCENE = "paper"
"""The kind of scene that is the paper's protocol, in ``per_scene`` of scores."""


@dataclass(frozen=True)
class PublishedSplit:
    """Published scores of one split, as fractions; None where the paper states nothing."""

    accuracy: float
    balanced_accuracy: float | None = None
    non_slip_recall: float | None = None
    slip_recall: float | None = None


SPLITS: Mapping[str, PublishedSplit] = {
    # section V-B, text: six seen materials
    "train": PublishedSplit(accuracy=0.9659),
    # section V-B, text and figure 6; balanced accuracy is the mean of the two recalls
    "test": PublishedSplit(0.9639, 0.9555, 0.938, 0.973),
    # section V-C, text and figure 8: wood, iron, copper, cloth
    "unseen": PublishedSplit(0.9195, 0.8605, 0.744, 0.977),
}


LARGER_CLASS = 0.753
"""Share of slip among the bins of figure 6: what calling all of them slip would score."""

BINS_PER_MINUTE = 20 * 60
"""Bins of 50 ms, with which a recall of non-slip is a number of false slips a minute."""

NUM_SELECTED = 120

SELECTED_BY_KIND: Mapping[str, int] = {"SG": 6, "PVDF": 114}
"""Figure 7(a)."""

SELECTED_BY_FINGER: Mapping[str, Mapping[str, int]] = {
    "SG": {"little": 0, "ring": 2, "middle": 4, "index": 0, "thumb": 0},
    "PVDF": {"little": 15, "ring": 21, "middle": 17, "index": 48, "thumb": 13},
}
"""Figure 7(c), by sensor kind."""


DESCRIPTORS_RANKED: tuple[str, ...] = (
    "peak_factor",
    "kurtosis",
    "skewness",
    "spectral_centroid",
    "band_energy_ratio",
    "cv",
    "std",
    "range",
    "entropy",
    "mean_deviation",
    "iqr",
    "median",
    "mean",
    "spectral_spread",
    "correlation",
)
"""Figure 7(d), most selected first. The counts are not printed, so only the order is used."""

DESCRIPTORS_NEVER: tuple[str, ...] = ("energy", "mode")
"""Selected not once."""

COMPONENTS_IN_WORDS = "A over D, none from D1"
"""Figure 7(b) and section V-B, text: approximations give more features than details."""

DOMAINS_IN_WORDS = "frequency over time domain"
"""Section V-B, text."""
