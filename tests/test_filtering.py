import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from tactslip_torch.signals.filtering import ChannelFilter, reach, savgol_filter

WINDOWS = [(1, 0), (3, 1), (5, 2), (11, 1), (51, 1), (51, 3), (11, 0), (7, 6)]
WINDOW_OF_CHANNEL = [51, 11, 51, 5]
ALIGNS = ["centred", "causal", "trailing"]
CHOICES = [(0, 1), (2, 3), (1, 2), (0, 1, 2, 3)]


@pytest.mark.parametrize(("window", "order"), WINDOWS)
@pytest.mark.parametrize("num_samples", [51, 52, 200, 333])
@pytest.mark.parametrize("make", [oracles.random_bins, oracles.integer_bins])
def test_equals_scipy(window, order, num_samples, make, rng):
    x = make(rng, 40, num_samples)
    actual = savgol_filter(torch.from_numpy(x), window, order)
    oracles.assert_columns_close(actual, oracles.savgol(x, window, order))


def causal(x, window, order=1):
    """The trailing frame's polynomial at its last sample; the first frame's before it is full."""
    taps = signal.savgol_coeffs(window, order, pos=window - 1, use="dot")
    rest = np.lib.stride_tricks.sliding_window_view(x, window, axis=-1) @ taps
    position = np.arange(window)
    fits = [np.polynomial.Polynomial.fit(position, row, order) for row in x[:, :window]]
    head = np.stack([fit(position[:-1]) for fit in fits])
    return np.concatenate([head, rest], axis=-1)


@pytest.mark.parametrize(("window", "order"), WINDOWS)
@pytest.mark.parametrize("num_samples", [51, 52, 200])
def test_causal_equals_scipys_coefficients(window, order, num_samples, rng):
    x = oracles.random_bins(rng, 20, num_samples)
    actual = savgol_filter(torch.from_numpy(x), window, order, "causal")
    oracles.assert_columns_close(actual, causal(x, window, order), 1e-9)


def trailing(x, window, order=1):
    """The centred filter half a frame late; the first half frame holds what it begins with."""
    centred, half = oracles.savgol(x, window, order), window // 2
    inside = centred[..., : x.shape[-1] - half]
    return np.concatenate([np.repeat(inside[..., :1], half, axis=-1), inside], axis=-1)


@pytest.mark.parametrize(("window", "order"), WINDOWS)
@pytest.mark.parametrize("num_samples", [51, 52, 200])
def test_trailing_is_scipys_centred_filter_half_a_frame_late(window, order, num_samples, rng):
    x = oracles.random_bins(rng, 20, num_samples)
    actual = savgol_filter(torch.from_numpy(x), window, order, "trailing")
    oracles.assert_columns_close(actual, trailing(x, window, order), 1e-9)


def test_trailing_of_order_one_is_the_mean_of_the_last_samples(rng):
    x = oracles.random_bins(rng, 90)
    found = savgol_filter(torch.from_numpy(x), 11, align="trailing")
    means = [x[i - 10 : i + 1].mean() for i in range(10, 90)]
    np.testing.assert_allclose(found[10:], means, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("align", ["causal", "trailing"])
@pytest.mark.parametrize("window", [11, 51])
def test_nothing_behind_a_sample_is_used_without_look_ahead(window, align, rng):
    x = torch.from_numpy(oracles.random_bins(rng, 300))
    changed = x.clone()
    changed[200:] += 100
    before, after = (savgol_filter(y, window, align=align) for y in (x, changed))
    assert torch.equal(after[:200], before[:200])
    assert (after[200] - before[200]).abs() > 1
    changed = x.clone()
    changed[200] += 100
    last = savgol_filter(changed, window, align=align) - savgol_filter(x, window, align=align)
    assert (last[:200] == 0).all()
    assert last[200 + window - 1].abs() > 1e-3  # the frame reaches so far back
    assert (last[200 + window :] == 0).all()


@pytest.mark.parametrize(("window", "gain", "corner_hz"), [(11, 3.5, 200.0), (51, 3.885, 44.0)])
def test_what_causal_lets_through_is_as_stated(window, gain, corner_hz):
    impulse = torch.zeros(8 * window, dtype=torch.float64)
    impulse[2 * window] = 1
    taps = savgol_filter(impulse, window, align="causal")
    assert float(taps.square().sum() * window) == pytest.approx(gain, abs=1e-3)
    t = torch.arange(4000, dtype=torch.float64) / 2000.0
    tone = torch.sin(2 * torch.pi * corner_hz * t)
    inside = slice(200, -200)
    passed = savgol_filter(tone, window, align="causal")[inside].std() / tone[inside].std()
    assert 20 * torch.log10(passed) == pytest.approx(-3, abs=0.2)


def test_default_order_is_one(rng):
    x = oracles.random_bins(rng, 2, 60)
    oracles.assert_columns_close(savgol_filter(torch.from_numpy(x), 11), oracles.savgol(x, 11, 1))


@given(half=st.integers(1, 20), extra=st.integers(0, 30), seed=st.integers(0, 99), data=st.data())
def test_equals_scipy_at_any_length(half, extra, seed, data):
    window = 2 * half + 1
    order = data.draw(st.integers(0, min(3, window - 1)))
    x = oracles.random_bins(np.random.default_rng(seed), 20, window + extra)
    actual = savgol_filter(torch.from_numpy(x), window, order)
    oracles.assert_columns_close(actual, oracles.savgol(x, window, order))


@pytest.mark.parametrize("window", [11, 51])
def test_manners(window, rng, device):
    x = torch.from_numpy(oracles.random_bins(rng, 4, 120)).to(device)
    oracles.assert_manners(lambda x: savgol_filter(x, window), x)


def test_float32_is_close_to_float64(rng):
    x = torch.from_numpy(oracles.random_bins(rng, 3, 200))
    actual = savgol_filter(x.float(), 51)
    torch.testing.assert_close(actual.double(), savgol_filter(x, 51), rtol=1e-5, atol=1e-6)


def test_gradcheck(rng):
    x = torch.from_numpy(oracles.random_bins(rng, 2, 14)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: savgol_filter(x, 5, 2), x)


@pytest.mark.parametrize("window", [3, 11, 51])
@pytest.mark.parametrize("order", [1, 2])
def test_polynomials_of_its_order_pass_unchanged(window, order):
    t = torch.linspace(-1, 1, 120, dtype=torch.float64)
    line = 3 + 2 * t - (4 * t**2 if order == 2 else 0)
    torch.testing.assert_close(savgol_filter(line, window, order), line, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("window", "corner_hz"), [(11, 81.0), (51, 17.0)])
def test_a_tone_at_the_stated_corner_loses_three_decibels(window, corner_hz):
    t = torch.arange(4000, dtype=torch.float64) / 2000.0
    tone = torch.sin(2 * torch.pi * corner_hz * t)
    inside = slice(200, -200)
    gain = savgol_filter(tone, window)[inside].std() / tone[inside].std()
    assert 20 * torch.log10(gain) == pytest.approx(-3, abs=0.2)


@pytest.mark.parametrize("window", [11, 51])
def test_nothing_beyond_half_a_window_is_used(window, rng):
    x = torch.from_numpy(oracles.random_bins(rng, 300))
    changed = x.clone()
    changed[200:] += 100
    half = window // 2
    before, after = savgol_filter(x, window), savgol_filter(changed, window)
    torch.testing.assert_close(after[: 200 - half], before[: 200 - half], rtol=0, atol=1e-12)
    assert (after[200 - half] - before[200 - half]).abs() > 1e-3


def test_constant_and_zero_and_nan():
    torch.testing.assert_close(
        savgol_filter(torch.full((80,), 5.0, dtype=torch.float64), 11),
        torch.full((80,), 5.0, dtype=torch.float64),
        rtol=1e-14,
        atol=0,
    )
    assert (savgol_filter(torch.zeros(80), 51) == 0).all()
    x = torch.zeros(80)
    x[40] = float("nan")
    touched = savgol_filter(x, 11).isnan()
    assert touched[35:46].all()
    assert touched.sum() == 11


@pytest.mark.parametrize(
    ("num_samples", "window", "order", "message"),
    [
        (80, 10, 1, r"odd.*10"),
        (80, 0, 0, r"odd.*0"),
        (80, 5, 5, r"polyorder.*5"),
        (80, 5, -1, r"polyorder.*-1"),
        (50, 51, 1, r"50 samples.*51"),
    ],
)
def test_errors_name_the_value(num_samples, window, order, message):
    with pytest.raises(ValueError, match=message):
        savgol_filter(torch.zeros(num_samples), window, order)


def test_each_channel_gets_its_own_window(rng):
    x = oracles.random_bins(rng, 4, 160)
    expected = np.stack([oracles.savgol(x[c], w) for c, w in enumerate(WINDOW_OF_CHANNEL)])
    actual = ChannelFilter(WINDOW_OF_CHANNEL)(torch.from_numpy(x))
    oracles.assert_columns_close(actual, expected)
    quadratic = np.stack([oracles.savgol(x[c], w, 2) for c, w in enumerate(WINDOW_OF_CHANNEL)])
    actual = ChannelFilter(WINDOW_OF_CHANNEL, polyorder=2)(torch.from_numpy(x))
    oracles.assert_columns_close(actual, quadratic)


@pytest.mark.parametrize("num_samples", [1, 100, 101])
def test_valid_is_the_centre_of_the_filtered_whole(num_samples, rng):
    layer = ChannelFilter(WINDOW_OF_CHANNEL)
    assert layer.context == 25
    x = torch.from_numpy(oracles.random_bins(rng, 3, 4, num_samples + 50))
    inside = slice(layer.context, layer.context + num_samples)
    expected = np.stack(
        [oracles.savgol(x[:, c].numpy(), w)[..., inside] for c, w in enumerate(WINDOW_OF_CHANNEL)],
        axis=1,
    )
    actual = layer.valid(x)
    assert actual.shape == (3, 4, num_samples)
    torch.testing.assert_close(actual, torch.from_numpy(expected), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("num_samples", [1, 100, 101])
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize(("align", "oracle"), [("causal", causal), ("trailing", trailing)])
def test_valid_without_look_ahead_is_the_end_of_the_filtered_whole(
    num_samples, order, align, oracle, rng
):
    layer = ChannelFilter(WINDOW_OF_CHANNEL, order, align)
    assert (layer.context_before, layer.context_after, layer.context) == (50, 0, 25)
    assert layer.reaches == ((50, 0), (10, 0), (50, 0), (4, 0))
    x = oracles.random_bins(rng, 3, 4, 20 + 50 + num_samples)  # 20 samples that nobody needs
    expected = np.stack(
        [oracle(x[:, c], w, order)[:, 70:] for c, w in enumerate(WINDOW_OF_CHANNEL)], axis=1
    )
    actual = layer.valid(torch.from_numpy(x[..., 20:].copy()))
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-9)
    whole = layer(torch.from_numpy(x))
    np.testing.assert_allclose(whole[..., 70:], expected, rtol=1e-9, atol=1e-9)


def test_valid_keeps_its_matrices_to_itself(rng):
    layer = ChannelFilter(WINDOW_OF_CHANNEL)
    x = torch.from_numpy(oracles.random_bins(rng, 4, 150))
    with torch.inference_mode():
        first = layer.valid(x)
    wanting = x.clone().requires_grad_()
    again = layer.valid(wanting)
    again.sum().backward()
    torch.testing.assert_close(first, again, rtol=1e-13, atol=1e-13)
    assert layer.valid(x.float()).dtype == torch.float32
    assert layer.valid(x[:, :149]).shape == (4, 99)
    assert torch.equal(layer.valid(x), first)
    assert layer.state_dict() == {}


@pytest.mark.parametrize("channels", [None, (1, 2), (3,), (0, 1, 2, 3)])
@pytest.mark.parametrize("align", ALIGNS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_few_bins_are_filtered_as_many_are(channels, align, dtype, rng):
    x = torch.from_numpy(oracles.random_bins(rng, 9, 4, 150)).to(dtype)
    x[0, 1, 40] = torch.nan
    x[1, 0, 0 if align == "centred" else 149] = torch.inf
    x[2, 3, 75] = -torch.inf
    layer = ChannelFilter(WINDOW_OF_CHANNEL, align=align)
    many = layer.valid(x, channels)
    for few in (x[:1], x[:4], x[2], x.flip(-1)[:4].flip(-1)):
        found = layer.valid(few, channels)
        wanted = many[2] if few.ndim == 2 else many[: len(few)]
        assert found.dtype == dtype
        close = 1e-5 if dtype == torch.float32 else 1e-13
        torch.testing.assert_close(found, wanted, rtol=close, atol=close, equal_nan=True)


@pytest.mark.parametrize("align", ALIGNS)
def test_channel_filter_manners(align, rng, device):
    x = torch.from_numpy(oracles.random_bins(rng, 2, 4, 160)).to(device)
    layer = ChannelFilter(WINDOW_OF_CHANNEL, align=align).to(device)
    oracles.assert_manners(layer, x, num_axes=2)
    oracles.assert_manners(layer.valid, x, num_axes=2)
    assert torch.autograd.gradcheck(
        ChannelFilter([3, 5], align=align),
        torch.randn(2, 9, dtype=torch.float64, requires_grad=True),
    )


def test_channel_filter_errors():
    layer = ChannelFilter(WINDOW_OF_CHANNEL)
    with pytest.raises(ValueError, match=r"4.*\(3, 100\)"):
        layer(torch.zeros(3, 100))
    with pytest.raises(ValueError, match=r"4.*\(3, 100\)"):
        layer.valid(torch.zeros(3, 100))
    with pytest.raises(ValueError, match=r"25 samples of context before and 25 behind.* 50"):
        layer.valid(torch.zeros(4, 50))
    for align in ("causal", "trailing"):
        with pytest.raises(ValueError, match=r"50 samples of context before and 0 behind.* 50"):
            ChannelFilter(WINDOW_OF_CHANNEL, align=align).valid(torch.zeros(4, 50))
    with pytest.raises(ValueError, match=r"centred, causal, trailing, got 'left'"):
        ChannelFilter([11], align="left")
    with pytest.raises(ValueError, match=r"centred, causal, trailing, got 'left'"):
        reach(11, "left")
    with pytest.raises(ValueError, match=r"50 samples.*51"):
        layer(torch.zeros(4, 50))
    with pytest.raises(ValueError, match=r"odd.*10"):
        ChannelFilter([11, 10])


@pytest.mark.parametrize("align", ALIGNS)
def test_only_the_channels_wanted_are_filtered(align, rng):
    """The others come back as their largest magnitude, which shows what is not finite."""
    smooth = ChannelFilter([51, 51, 11, 11], align=align)
    samples = torch.from_numpy(rng.standard_normal((3, 4, 150)))
    samples[1, 0, 60] = torch.nan
    samples[2, 3, 80] = -torch.inf
    whole, part = smooth.valid(samples), smooth.valid(samples, {1, 2})
    torch.testing.assert_close(part[:, 1:3], whole[:, 1:3], rtol=1e-13, atol=1e-14)
    start = smooth.context_before - smooth.reaches[3][0]
    in_frame = samples[0, 3, start : start + 110].abs().max()
    assert (part[0, 3] == in_frame).all()
    assert part[1, 0].isnan().all()
    assert (part[2, 3] == torch.inf).all()


def test_threads_share_a_filter(rng):
    """Each asks for other channels first; the interpreter changes threads as often as it can."""
    samples = torch.from_numpy(rng.standard_normal((1, 4, 150)))
    expected = {
        wanted: ChannelFilter([51, 51, 11, 11]).valid(samples, wanted) for wanted in CHOICES
    }
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            for _ in range(100):
                smooth = ChannelFilter([51, 51, 11, 11])
                tasks = [(w, pool.submit(smooth.valid, samples, w)) for w in CHOICES * 4]
                for wanted, task in tasks:
                    torch.testing.assert_close(task.result(), expected[wanted])
    finally:
        sys.setswitchinterval(before)


@pytest.mark.parametrize("align", ALIGNS)
def test_a_recording_is_filtered_in_the_channels_wanted_alone(align, rng):
    samples = torch.from_numpy(rng.standard_normal((3, 4, 40)))
    smooth = ChannelFilter([51, 11, 51, 11], align=align)
    found = smooth(samples, {1, 3})  # the frames of the others would not fit
    assert torch.equal(found[:, [0, 2]], samples[:, [0, 2]])
    assert torch.equal(found[:, [1, 3]], savgol_filter(samples[:, [1, 3]], 11, align=align))
