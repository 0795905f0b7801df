"""Every cell of the table of invariances: that it holds, and that "neither" is neither."""

from pathlib import Path

import generated
import numpy as np
import pytest
import sensitivity
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tactslip_torch.features.descriptors import (
    SPECTRUM_DESCRIPTORS,
    TIME_DESCRIPTORS,
    band_energy_ratio,
    describe,
)
from tactslip_torch.features.invariance import INVARIANCES, feature_invariance, invariance_table
from tactslip_torch.signals.spectrum import amplitude_spectrum, frequency_axis_hz

PAGE = Path(__file__).parents[1] / "docs" / "numerics.md"
ROWS = {f"{row.descriptor} of {row.domain}": row for row in INVARIANCES}
CHANGES = ("gain", "offset", "polarity", "reversal", "permutation")
NEITHER = [(name, c) for name, row in ROWS.items() for c in CHANGES if getattr(row, c) == "neither"]
HOLDS = [(name, c) for name in ROWS for c in CHANGES if (name, c) not in NEITHER]
RATE_HZ = 2000.0
BANDS = 8  # signals whose spectra share their energy
MOST = {torch.float64: 6.0, torch.float32: 3.0}  # offsets up to ten to this times the span


def measure(x, row):
    """Values ``[N]`` of one descriptor of signals ``[N, n]``; correlation is with the one before,
    and eight of them share the energy of their spectra."""
    scale = x.abs().amax(-1)
    if row.domain == "time":
        return describe(x, [row.descriptor], scale=scale, reference=x.roll(1, 0))[:, 0]
    spectra = amplitude_spectrum(x)
    if row.descriptor == "band_energy_ratio":
        return band_energy_ratio(spectra.unflatten(0, (-1, BANDS))).flatten()
    hz = frequency_axis_hz(x.shape[-1], RATE_HZ)
    return describe(spectra, [row.descriptor], scale=scale, frequency_hz=hz)[:, 0]


def tolerance(x, row, size):
    """How far ``measure`` may move if each value is rounded at a magnitude of ``size [N]``."""
    dtype = np.float64 if x.dtype == torch.float64 else np.float32
    eps, num = float(np.finfo(dtype).eps), x.shape[-1]
    x, size = x.double().numpy(), size.double().numpy()
    scale, move = np.abs(x).max(-1), 5 * eps * size
    if row.descriptor == "correlation":
        return sensitivity.correlation_tolerance(x, move, np.roll(x, 1, 0), np.roll(move, 1), dtype)
    if row.domain == "time":
        bounds = sensitivity.tolerances(x, move, dtype, scale=scale, scale_after=size)
        return bounds[row.descriptor]
    spectra = amplitude_spectrum(torch.from_numpy(x)).numpy()
    move = num / (num - 1) * (move + num * eps * scale)  # a line is a weighted sum of the values
    if row.descriptor == "band_energy_ratio":
        spectra, move = spectra.reshape(-1, BANDS, num), move.reshape(-1, BANDS)
        return sensitivity.ratio_tolerance(spectra, move, dtype).flatten()
    if row.descriptor.startswith("spectral"):
        highest_hz = (num - 1) * RATE_HZ / num
        return sensitivity.line_tolerances(spectra, move, dtype, highest_hz)[row.descriptor]
    return sensitivity.tolerances(spectra, move, dtype, scale=scale)[row.descriptor]


def draw_signals(source, num_samples, dtype):
    """Eight signals of about one volt: noise, ties, skewed values and waves, two of each."""
    size = (2, num_samples)
    noise = torch.randn(size, generator=source, dtype=torch.float64)
    ties = torch.randint(-4, 5, size, generator=source).double()
    ties[:, 0] = 6  # so that none is constant
    skewed = torch.randn(size, generator=source, dtype=torch.float64).exp()
    pitch = 0.1 + 2 * torch.rand((2, 1), generator=source, dtype=torch.float64)
    waves = torch.sin(pitch * (1 + torch.arange(num_samples)))
    return torch.stack([noise, ties, skewed, waves], 1).flatten(0, 1).to(dtype)


def draw_change(x, change, source):
    """The signals changed; by what factor, offset or sign; and at what magnitude in their unit."""
    size = x.abs().amax(-1)
    if change == "gain":
        gain = 10 ** (24 * torch.rand((), generator=source, dtype=torch.float64) - 12)
        gain = gain.to(x.dtype)
        return x * gain, gain.double(), size
    if change == "offset":
        exponent = MOST[x.dtype] * torch.rand((*size.shape, 1), generator=source)
        sign = torch.where(torch.rand((*size.shape, 1), generator=source) < 0.5, -1, 1)
        offset = (sign * (x.amax(-1) - x.amin(-1))[..., None] * 10**exponent).to(x.dtype)
        return x + offset, offset[..., 0].double(), size + offset[..., 0].abs()
    if change == "polarity":
        return -x, None, size
    if change == "reversal":
        return x.flip(-1), None, size
    return x[..., torch.randperm(x.shape[-1], generator=source)], None, size


def by_table(before, answer, by):
    """What an answer of the table says of values, and the unit their tolerance is in."""
    if answer in (0, 1, 2):
        return before * by**answer, float(by**answer)
    if answer == "shifts":
        return before + by, 1.0
    return (-before if answer == "odd" else before), 1.0


# Of a signal and of its spectrum -------------------------------------------------------------


@pytest.mark.parametrize("dtype", MOST)
@pytest.mark.parametrize(("name", "change"), HOLDS)
@settings(max_examples=8)
@given(drawn=st.integers(0, 2**40), num_samples=st.integers(8, 120))
def test_a_claim_holds(name, change, dtype, drawn, num_samples):
    row, source = ROWS[name], generated.generator(drawn)
    x = draw_signals(source, num_samples, dtype)
    after, by, size = draw_change(x, change, source)
    wanted, unit = by_table(measure(x, row).double(), getattr(row, change), by)
    excess = (measure(after, row).double() - wanted).abs().numpy() - tolerance(x, row, size) * unit
    assert excess.max() <= 0, f"by {by}: {wanted.tolist()}, got {measure(after, row).tolist()}"


WITNESSES = torch.tensor(
    [
        [0, 0, 0, 1, 2, 0, 0, 1],
        [3, 1, 4, 1, 5, 9, 2, 6],
        [0, 1, -3, 2, 2, -1, 0, 7],
        [1, 2, 4, 8, 16, 32, 64, 128],
        [-2, 7, 1, 8, -2, 8, 1, 8],
        [1, 0, 0, 0, 0, 0, 0, -1],
        [5, 6, 5, 6, 5, 6, 5, 9],
        [0, 3, 1, -3, 0, 2, -1, -2],
    ],
    dtype=torch.float64,
)
SHUFFLE = [3, 0, 6, 1, 7, 2, 5, 4]
FORMS = {"offset": ("same", "shifts"), "polarity": ("even", "odd")}


@pytest.mark.parametrize(("name", "change"), NEITHER)
def test_neither_is_neither(name, change):
    """One signal of eight breaks every form the answer could have had, far beyond rounding."""
    row, x = ROWS[name], WITNESSES
    moved = {"offset": x + 1, "polarity": -x, "reversal": x.flip(-1), "permutation": x[:, SHUFFLE]}
    before, after = measure(x, row), measure(moved[change], row)
    breaks = torch.ones(len(x), dtype=torch.bool)
    for answer in FORMS.get(change, ("same",)):
        wanted, _ = by_table(before, answer, 1.0)
        breaks &= (after - wanted).abs() > 1e-3 * before.abs().amax()
    assert breaks.any()


def test_the_bounds_say_something():
    """Where values stand at a step of mode or entropy a bound excuses everything: seldom."""
    x = draw_signals(generated.generator(0), 100, torch.float64).repeat(8, 1)
    for name, row in ROWS.items():
        typical = measure(x, row).abs().median().clamp(min=0.01).item()
        bounds = tolerance(x, row, x.abs().amax(-1))
        assert np.quantile(bounds / typical, 0.85) < 1e-8, name


# Of the table --------------------------------------------------------------------------------


def test_the_table_has_every_descriptor_once():
    of_time = [row.descriptor for row in INVARIANCES if row.domain == "time"]
    of_spectra = [row.descriptor for row in INVARIANCES if row.domain == "freq"]
    assert of_time == list(TIME_DESCRIPTORS)
    assert of_spectra == [*SPECTRUM_DESCRIPTORS, "band_energy_ratio"]
    assert len({*of_time, *of_spectra}) == 17


def test_the_cv_of_a_mean_of_exactly_zero_is_positive_either_way():
    row, x = ROWS["cv of time"], torch.tensor([[1.0, -1.0, 2.0, -2.0]], dtype=torch.float64)
    assert measure(x, row).item() == measure(-x, row).item() > 1e6


def test_an_offset_that_drowns_the_gaps_joins_values_for_the_mode():
    row = ROWS["mode of time"]
    x = torch.tensor([[0.0, 5, 5, 5, 9, 9 + 1e-7, 9 + 2e-7, 9 + 3e-7]], dtype=torch.float64)
    assert measure(x, row).item() == 5
    assert measure(x + 1e6, row).item() == pytest.approx(1e6 + 9, abs=1e-6)


def test_the_markdown_is_aligned_and_complete():
    table, legend = invariance_table().split("\n\n")
    lines = table.splitlines()
    assert len(lines) == 2 + len(INVARIANCES)
    bars = [[i for i, c in enumerate(line) if c == "|"] for line in lines]
    assert all(places == bars[0] for places in bars)
    assert "equivariant" in lines[2]
    assert max(map(len, legend.splitlines())) <= 100


def test_the_readme_carries_the_table():
    text = PAGE.read_text(encoding="utf-8")
    begin, end = "<!-- invariances -->", "<!-- /invariances -->"
    assert (text.count(begin), text.count(end)) in ((0, 0), (1, 1))
    if begin in text:  # once it is there, it is this one
        assert text.split(begin)[1].split(end)[0].strip() == invariance_table()


@pytest.mark.parametrize(
    "names",
    [("raw", "time", "wobble"), ("B1", "time", "mean"), ("A1", "time", "spectral_centroid")],
)
def test_an_unknown_feature_is_named(names):
    with pytest.raises(ValueError, match=f"no feature {' '.join(names)};.*domains time and freq"):
        feature_invariance(*names)
