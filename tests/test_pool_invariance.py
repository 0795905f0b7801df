"""The table of invariances, held against all 2582 columns of the pool."""

import generated
import numpy as np
import oracles
import pytest
import sensitivity
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from test_invariance import by_table, draw_change, draw_signals

from tactslip_torch import FeaturePool, HandLayout
from tactslip_torch.features.invariance import feature_invariance
from tactslip_torch.signals.wavelet import branch_matrix

HAND = HandLayout.paper24()
POOL = FeaturePool(HAND)
ANSWERS = [feature_invariance(n.component, n.domain, n.descriptor) for n in POOL.names]
PLAIN = [str(name) for name in POOL.names]
CHANGES = ("gain", "offset", "polarity", "reversal", "permutation")
EPS = oracles.EPS
WEIGHTS = branch_matrix(100).abs().sum(-1).amax(-1).numpy()  # how far a branch moves, at most
SEEDS = st.integers(0, 2**40)


def draw_bins(source, num=2, dtype=torch.float64):
    """Bins ``[num, 24, 100]`` of waves, noise, ties and skewed values, from 1e-3 to 1e3 V."""
    channels = torch.stack([draw_signals(source, 100, torch.float64) for _ in range(3 * num)])
    bins = channels.reshape(3, num, 8, 100).transpose(0, 1).flatten(1, 2)
    order = torch.rand((num, 24, 1), generator=source).argsort(1)  # each bin its own
    bins = bins.gather(1, order.expand(num, 24, 100))
    return (bins * 10 ** (6 * torch.rand((num, 24, 1), generator=source) - 3)).to(dtype)


def tolerances(bins, size):
    """How far each column may move if each value is rounded at ``size [N, C]``, ``[N, 2582]``."""
    raw, moved = bins.numpy(), 5 * EPS * size.numpy()
    gauges, films = raw[:, :14], bins[:, 14:]
    scale, scale_after = np.abs(raw).max(-1), size.numpy()
    of_gauges = sensitivity.tolerances(
        gauges, moved[:, :14], np.float64, scale=scale[:, :14], scale_after=scale_after[:, :14]
    )
    columns = {
        (HAND.names[i], "raw", "time", name): bound[:, i]
        for name, bound in of_gauges.items()
        for i in range(14)
    }
    branches = POOL.branches(films)
    spectra = POOL.amplitudes(branches).numpy()
    branches = branches.numpy()
    # the sum of 100 products, and the offset that a sample of it was subtracted from
    by = WEIGHTS * (moved[:, 14:] + 100 * EPS * np.ptp(raw[:, 14:], axis=-1))[..., None]
    lines_by = 100 / 99 * (by + 100 * EPS * np.abs(branches).max(-1))
    sizes = {
        "scale": np.broadcast_to(scale[:, 14:, None], by.shape),
        "scale_after": np.broadcast_to(scale_after[:, 14:, None], by.shape),
    }
    in_time = sensitivity.tolerances(branches, by, np.float64, **sizes)
    in_time["correlation"] = sensitivity.correlation_tolerance(
        branches, by, films.numpy()[:, :, None], moved[:, 14:, None], np.float64
    )
    in_frequency = sensitivity.tolerances(spectra, lines_by, np.float64, **sizes)
    in_frequency |= sensitivity.line_tolerances(spectra, lines_by, np.float64, 1980.0)
    in_frequency["band_energy_ratio"] = sensitivity.ratio_tolerance(spectra, lines_by, np.float64)
    for domain, bounds in (("time", in_time), ("freq", in_frequency)):
        for name, bound in bounds.items():
            for i in range(10):
                for b in range(8):
                    branch = f"{'AD'[b % 2]}{b // 2 + 1}"
                    columns[HAND.names[14 + i], branch, domain, name] = bound[:, i, b]
    names = [(n.channel, n.component, n.domain, n.descriptor) for n in POOL.names]
    return np.stack([columns[name] for name in names], axis=-1)


def judge(bins, change, source):
    """Features after the change, what the table says of them, and the bound of the difference."""
    after, by, size = draw_change(bins, change, source)
    before, bound = POOL(bins), tolerances(bins, size)
    if change == "offset":
        by = by[:, [HAND.names.index(n.channel) for n in POOL.names]]
    wanted = torch.full_like(before, torch.nan)
    for answer in {getattr(a, change) for a in ANSWERS} - {"neither"}:
        here = [i for i, a in enumerate(ANSWERS) if getattr(a, change) == answer]
        offset = by[:, here] if change == "offset" else by
        wanted[:, here], unit = by_table(before[:, here], answer, offset)
        bound[:, here] *= unit
    return POOL(after), wanted, torch.from_numpy(bound)


@pytest.mark.parametrize("change", CHANGES)
@settings(max_examples=12)
@given(drawn=SEEDS)
def test_every_column_answers_as_the_table_says(change, drawn):
    source = generated.generator(drawn)
    bins = draw_bins(source)
    after, wanted, bound = judge(bins, change, source)
    claimed = ~wanted.isnan()
    wrong = claimed & ((after - wanted).abs() > bound)
    found = [(PLAIN[c], after[r, c], wanted[r, c]) for r, c in wrong.nonzero()[:4].tolist()]
    assert not found
    assert claimed.all(0).sum() == sum(getattr(a, change) != "neither" for a in ANSWERS)


FORMS = {"offset": ("same", "shifts"), "polarity": ("even", "odd")}


@pytest.mark.parametrize("change", CHANGES[1:])
def test_every_neither_has_a_bin_that_shows_it(change):
    """Far beyond its bound, in one of the bins, every form the answer could have had is wrong."""
    source = generated.generator(7)
    bins = draw_bins(source, 48)  # entropy seldom minds its polarity
    moved = {"offset": bins + bins.abs().amax(-1, keepdim=True), "polarity": -bins}
    moved |= {
        "reversal": bins.flip(-1),
        "permutation": bins[..., torch.randperm(100, generator=source)],
    }
    before, after = POOL(bins), POOL(moved[change])
    bound = torch.from_numpy(tolerances(bins, 2 * bins.abs().amax(-1)))
    offset = bins.abs().amax(-1)[:, [HAND.names.index(n.channel) for n in POOL.names]]
    breaks = torch.ones(before.shape, dtype=torch.bool)
    for answer in FORMS.get(change, ("same",)):
        breaks &= (after - by_table(before, answer, offset)[0]).abs() > 100 * bound
    shown = breaks.any(0).tolist()
    silent = [
        name
        for name, answers, has in zip(PLAIN, ANSWERS, shown, strict=True)
        if getattr(answers, change) == "neither" and not has
    ]
    assert silent == []


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@settings(max_examples=10)
@given(drawn=SEEDS, exponent=st.integers(-40, 40))
def test_a_gain_of_a_power_of_two_changes_no_digit(dtype, drawn, exponent):
    bins = draw_bins(generated.generator(drawn), dtype=dtype)
    degree = torch.tensor([a.gain for a in ANSWERS])
    wanted = torch.ldexp(POOL(bins), exponent * degree)
    actual = POOL(torch.ldexp(bins, torch.tensor(exponent)))
    wrong = (actual != wanted).nonzero()[:4].tolist()
    assert [(PLAIN[c], actual[r, c], wanted[r, c]) for r, c in wrong] == []


@settings(max_examples=12)
@given(drawn=SEEDS)
def test_features_follow_their_channels(drawn):
    source = generated.generator(drawn)
    bins = draw_bins(source)
    gauges = torch.randperm(14, generator=source)
    films = torch.randperm(10, generator=source)
    order = torch.cat([gauges, 14 + films])
    features = POOL(bins)
    of_gauges = features[:, : 14 * 13].unflatten(-1, (14, 13))[:, gauges]
    of_films = features[:, 14 * 13 :].unflatten(-1, (10, 240))[:, films]
    wanted = torch.cat([of_gauges.flatten(1), of_films.flatten(1)], dim=-1)
    moved = bins[:, order]
    bound = torch.from_numpy(tolerances(moved, moved.abs().amax(-1)))
    assert ((POOL(moved) - wanted).abs() <= bound).all()


def test_the_bounds_say_something():
    """Few columns of few bins stand at a step or a zero where a bound excuses everything."""
    bins = draw_bins(generated.generator(1), 16)
    features = POOL(bins).abs()
    bound = torch.from_numpy(tolerances(bins, bins.abs().amax(-1)))
    typical = torch.maximum(features, features.median(0).values)
    assert (bound <= 1e-6 * typical).float().mean() > 0.95
