"""Pooling over channels: the layer against plain NumPy, and what becomes of absent channels."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from oracles import pooled

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import STATISTICS, ChannelPooling
from tactslip_torch.hand import HandLayout

HAND = HandLayout.from_rows(
    {"name": f"{kind}{i}", "kind": kind, "finger": f"f{i}", "segment": "distal"}
    for kind, num in (("SG", 3), ("PVDF", 4))
    for i in range(1, num + 1)
)
POOL = FeaturePool(HAND, level=1)
PLACE = {name: index for index, name in enumerate(POOL.names)}
SETTINGS = (list(STATISTICS), "sorted")


def features_of(rng, num=60):
    bins = torch.from_numpy(
        rng.standard_normal((num, 7, 100)) * 10 ** rng.uniform(-2, 1, (num, 7, 1))
    )
    return POOL(bins)


def fitted(rng, setting=("mean", "std")):
    features = features_of(rng)
    return ChannelPooling.fit(HAND, POOL.names, features, setting), features


def inputs_of(layer, features):
    return features[:, [PLACE[name] for name in layer.inputs]]


def expected(layer, features, is_lost=None):
    out = np.empty((len(features), len(layer.names)))
    scales = dict(zip(layer.families, layer.compression.tolist(), strict=True))
    for column, name in enumerate(layer.names):
        channels = [HAND.names[c] for c in HAND.indices(name.channel)]
        family = replace(name, statistic="")
        places = [PLACE[replace(family, channel=channel)] for channel in channels]
        for row, values in enumerate(features[:, places].numpy()):
            in_use = np.ones(len(channels), bool)
            if is_lost is not None:
                in_use = ~is_lost[row, list(HAND.indices(name.channel))].numpy()
            out[row, column] = pooled(values, in_use, scales[family], name.statistic)
    return torch.from_numpy(out)


@pytest.mark.parametrize("setting", SETTINGS, ids=str)
def test_equals_plain_numpy_where_channels_are_missing_too(rng, setting):
    layer, features = fitted(rng, setting)
    features = features[:12]
    is_lost = torch.zeros(12, 7, dtype=torch.bool)
    is_lost[6:, 1] = True
    is_lost[6::2, 4] = is_lost[6::3, 5] = True
    wanted = expected(layer, features, is_lost)
    for backend in ("auto", "torch"):
        found = layer(inputs_of(layer, features), is_lost, backend)
        torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-12)
        single = layer(inputs_of(layer, features).float(), is_lost, backend)
        torch.testing.assert_close(single, wanted.float(), rtol=1e-4, atol=1e-4)
        whole = layer(inputs_of(layer, features[:6]), backend=backend)
        torch.testing.assert_close(whole, found[:6], rtol=1e-12, atol=1e-13)


def test_without_any_channel_of_a_kind_a_column_is_its_training_median(rng):
    layer, features = fitted(rng)
    is_lost = torch.zeros(len(features), 7, dtype=torch.bool)
    is_lost[:, list(HAND.indices("PVDF"))] = True
    given = inputs_of(layer, features)
    found, whole = layer(given, is_lost), layer(given)
    films = torch.tensor([name.channel == "PVDF" for name in layer.names])
    middle = whole.median(0).values
    torch.testing.assert_close(found[:, films], middle[films].expand(len(found), -1))
    torch.testing.assert_close(found[:, ~films], whole[:, ~films])


def test_one_dead_channel_in_training_does_not_move_the_others(rng):
    """Compression scales and medians are those of the other channels alone."""
    bins = torch.from_numpy(rng.standard_normal((60, 7, 100)))
    is_lost = (torch.arange(7) == 2).expand(60, 7)
    layers = []
    for value in (0.25, 1e6):
        bins[:, 2] = value
        args = HAND, POOL.names, POOL(bins), ["mean", "std"], is_lost
        layers.append(ChannelPooling.fit(*args))
    for found, expected in zip(*(layer.buffers() for layer in layers), strict=True):
        assert torch.equal(found, expected)


def test_gradients_flow_and_are_finite_where_channels_agree(rng):
    layer, features = fitted(rng, ["mean", "std", "min", "max", "median"])
    layer = layer.select([3, 40, 77, 100, len(layer.names) - 1])
    given = inputs_of(layer, features)[:3].clone()
    assert torch.autograd.gradcheck(layer, given.requires_grad_())
    same = torch.ones_like(given[:1]).requires_grad_()
    layer(same).sum().backward()
    assert same.grad is not None
    assert same.grad.isfinite().all()


@pytest.mark.parametrize("setting", ["largest", [], ["mean", "mode"]])
def test_unknown_statistics_are_refused(setting):
    with pytest.raises(ValueError, match=r"features\.pooling must be sorted, null or some of mean"):
        ChannelPooling.fit(HAND, POOL.names, torch.zeros(1, len(POOL.names)), setting)
