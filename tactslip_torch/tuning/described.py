"""Selected features with gradients, and no others: what a step of tuning can afford.

The values are ``FeaturePool``'s; of films only the branches and descriptors in use are formed, and
bins go chunk by chunk, formed again on the way back instead of being kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from tactslip_torch.features.descriptors import band_energy_ratio, describe
from tactslip_torch.features.guards import settle
from tactslip_torch.features.names import FeatureName
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.signals.spectrum import frequency_axis_hz
from tactslip_torch.signals.wavelet import branch_names

_CHUNK_BINS = 64


def selected_features(pool: FeaturePool, bins: Tensor, names: Sequence[FeatureName]) -> Tensor:
    """The named features of filtered bins, differentiable in these and in the pool's branches.

    Shape:
        - bins: ``[N, C, n]``, float64
        - output: ``[N, len(names)]``
    """
    found = dict[FeatureName, Tensor]()
    hand = pool.hand
    slow = [name for name in names if name.component == "raw"]
    fast = [name for name in names if name.component != "raw"]
    for own, describe_all in ((slow, _of_slow), (fast, _of_fast)):
        if own:
            channels = sorted({hand.names.index(name.channel) for name in own})
            found |= describe_all(pool, bins[:, channels], channels, own)
    return torch.stack([found[name] for name in names], dim=-1)


def in_chunks(function: Callable[[Tensor], Tensor], raw: Tensor) -> Tensor:
    """``function`` of bins, remembering only what goes in; the rest is made again going back."""
    parts = [
        checkpoint(function, chunk, use_reentrant=False)
        if torch.is_grad_enabled()
        else function(chunk)
        for chunk in raw.split(_CHUNK_BINS)
    ]
    return torch.cat(parts)


def _of_slow(
    pool: FeaturePool, bins: Tensor, channels: Sequence[int], names: Sequence[FeatureName]
) -> dict[FeatureName, Tensor]:
    scale = bins.detach().abs().amax(-1)
    descriptors = sorted({name.descriptor for name in names})
    values = describe(settle(bins, scale), descriptors, scale=scale)
    of_channel = {pool.hand.names[channel]: place for place, channel in enumerate(channels)}
    return {n: values[:, of_channel[n.channel], descriptors.index(n.descriptor)] for n in names}


def _of_fast(
    pool: FeaturePool, films: Tensor, channels: Sequence[int], names: Sequence[FeatureName]
) -> dict[FeatureName, Tensor]:
    order = branch_names(pool.level)
    axis_hz = frequency_axis_hz(pool.bin_samples, pool.sample_rate_hz, pool.spectrum)
    scale = films.detach().abs().amax(-1)
    branches = pool.branches(films)
    spectra = pool.amplitudes(branches)
    of_channel = {pool.hand.names[channel]: place for place, channel in enumerate(channels)}
    found = dict[FeatureName, Tensor]()
    for domain, rows in (("time", branches), ("freq", spectra)):
        own = [n for n in names if n.domain == domain and n.descriptor != "band_energy_ratio"]
        if not own:
            continue
        used = sorted({order.index(name.component) for name in own})
        descriptors = sorted({name.descriptor for name in own})
        values = describe(
            rows[:, :, used],
            descriptors,
            scale=scale[..., None].expand(*scale.shape, len(used)),
            reference=settle(films, scale)[..., None, :] if domain == "time" else None,
            frequency_hz=axis_hz if domain == "freq" else None,
        )
        for name in own:
            row, place = used.index(order.index(name.component)), of_channel[name.channel]
            found[name] = values[:, place, row, descriptors.index(name.descriptor)]
    if ratios := [name for name in names if name.descriptor == "band_energy_ratio"]:
        values = band_energy_ratio(spectra)
        for name in ratios:
            found[name] = values[:, of_channel[name.channel], order.index(name.component)]
    return found
