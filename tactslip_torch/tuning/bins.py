"""The bins that settings are tuned on: a part of the sample of the first pass, raw as well."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tactslip_torch.data.splits import Split
from tactslip_torch.feature_maker import FeatureMaker
from tactslip_torch.features.bin_sample import SampledBins, bin_keys


@dataclass(frozen=True)
class TuningBins:
    """Bins of several groups.

    Args:
        features: selected, unscaled, float64.
        is_slip: their truth.
        weights: with which they stand for all bins that are trained on, so that C means the same.
        group: index into ``names``.
        names: of the groups.
        raw: with the context that filtering takes; ``None`` where filters are not learned.

    Shape:
        - features: ``[N, K]``; is_slip, weights, group: ``[N]``
        - raw: ``[N, C, before + n + after]``, volts
    """

    features: Tensor
    is_slip: Tensor
    weights: Tensor
    group: Tensor
    names: tuple[str, ...]
    raw: Tensor | None = None

    def of(self, groups: Sequence[int]) -> TuningBins:
        """The bins of some of the groups; they stand for as much as before."""
        own = torch.isin(self.group, torch.tensor(list(groups)))
        raw = None if self.raw is None else self.raw[own]
        return replace(
            self,
            features=self.features[own],
            is_slip=self.is_slip[own],
            weights=self.weights[own],
            group=self.group[own],
            raw=raw,
        )


def tuning_bins(
    sample: SampledBins,
    selected: Sequence[int],
    weights: Tensor,
    most: int,
    maker: FeatureMaker | None,
    split: Split,
) -> TuningBins:
    """At most so many sampled bins of every group and class: those of smallest key.

    Args:
        sample: of the first pass over the training recordings, and of no other.
        selected: pool indices of the features.
        weights: with which sampled bins stand for all that are trained on, ``[n]``.
        most: bins of each group and class.
        maker: reads the recordings again for raw bins; none are wanted without.
        split: whose training bins were sampled from.
    """
    keys = torch.zeros(len(sample.is_slip), dtype=torch.float64)
    for place, name in enumerate(sample.recording_names):
        own = sample.recording == place
        index = sample.bin_index[own]
        keys[own] = bin_keys(name, int(index.max()) + 1)[index]
    kept = []
    for group in range(len(sample.group_names)):
        for kind in (False, True):
            rows = ((sample.group == group) & (sample.is_slip == kind)).nonzero().flatten()
            kept.append(rows[keys[rows].argsort(stable=True)[:most]])
    rows = torch.cat(kept).sort().values
    raw = None if maker is None else _raw(sample, rows, maker, split)
    features = sample.features[rows][:, list(selected)].double()
    names = sample.group_names
    is_slip, of_group, own_weights = sample.is_slip[rows], sample.group[rows], weights[rows]
    for kind in (False, True):  # those that are kept stand for the others
        own = is_slip == kind
        own_weights[own] *= weights[sample.is_slip == kind].sum() / own_weights[own].sum()
    return TuningBins(features, is_slip, own_weights, of_group, names, raw)


def _raw(sample: SampledBins, rows: Tensor, maker: FeatureMaker, split: Split) -> Tensor:
    """Raw bins of these rows of the sample, read recording by recording."""
    by_name = {str(recording): recording for recording in split.having("train")}
    parts: list[Tensor] = [torch.empty(0)] * len(rows)
    for place, name in enumerate(sample.recording_names):
        own = (sample.recording[rows] == place).nonzero().flatten()
        if len(own):
            recording = by_name[name]
            num_bins = len(maker.lay_bins(maker.source.timeline(recording)).starts)
            trained = split.bin_roles(recording, num_bins)["train"].nonzero().flatten()
            windows = maker.raw_bins(recording, trained[sample.bin_index[rows[own]]])
            for row, window in zip(own.tolist(), windows, strict=True):
                parts[row] = window
    return torch.stack(parts)
