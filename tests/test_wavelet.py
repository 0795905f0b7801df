import numpy as np
import oracles
import pytest
import pywt
import torch

from tactslip_torch.signals.wavelet import (
    branch_matrix,
    branch_names,
    highest_level,
    wavelet_branches,
)

LENGTHS = [80, 99, 100, 101, 128]


def oracle(x, **options):
    return np.stack([oracles.wavelet_branches(one, **options) for one in x])


def assert_branches_close(actual, expected):
    """Against the largest branch value: a detail is as exact as the sum it is taken from."""
    scale = np.abs(expected).max()
    np.testing.assert_allclose(actual.numpy(), expected, rtol=1e-10, atol=1e-13 * scale)


@pytest.mark.parametrize("num_samples", LENGTHS)
@pytest.mark.parametrize("make", [oracles.random_bins, oracles.integer_bins])
def test_equals_pywavelets(num_samples, make, rng):
    x = make(rng, 3, num_samples)
    assert_branches_close(wavelet_branches(torch.from_numpy(x)), oracle(x))


@pytest.mark.parametrize("wavelet", ["haar", "db4", "bior2.4", "sym5", "rbio2.2"])
@pytest.mark.parametrize("mode", ["symmetric", "reflect", "zero", "periodic", "constant"])
@pytest.mark.parametrize("level", [1, 2, 3])
@pytest.mark.parametrize("num_samples", [72, 75])
def test_every_option_equals_pywavelets(wavelet, mode, level, num_samples, rng):
    x = rng.standard_normal((2, num_samples))
    options = {"wavelet": wavelet, "mode": mode, "level": level}
    assert_branches_close(wavelet_branches(torch.from_numpy(x), **options), oracle(x, **options))


@pytest.mark.parametrize("num_samples", LENGTHS)
def test_branches_add_up(num_samples, rng):
    x = torch.from_numpy(rng.standard_normal((3, num_samples)))
    branches = wavelet_branches(x)
    parent = x
    for m in range(4):
        a, d = branches[:, 2 * m], branches[:, 2 * m + 1]
        torch.testing.assert_close(a + d, parent, rtol=0, atol=1e-13)
        parent = a


@pytest.mark.parametrize("num_samples", [99, 100])
@pytest.mark.parametrize("options", [{}, {"wavelet": "db2", "level": 2, "mode": "zero"}])
def test_matrix_is_the_same_map(num_samples, options, rng):
    x = rng.standard_normal(num_samples)
    matrix = branch_matrix(num_samples, **options)
    level = options.get("level", 4)
    assert matrix.dtype == torch.float64
    assert matrix.shape == (2 * level, num_samples, num_samples)
    assert_branches_close(matrix @ torch.from_numpy(x), oracles.wavelet_branches(x, **options))


def test_names_are_in_the_order_of_the_branches():
    assert branch_names(4) == ("A1", "D1", "A2", "D2", "A3", "D3", "A4", "D4")
    assert branch_names(1) == ("A1", "D1")


def test_manners(rng, device):
    x = torch.from_numpy(oracles.random_bins(rng, 4, 100)).to(device)
    oracles.assert_manners(wavelet_branches, x)


def test_float32_is_close_to_float64(rng):
    x = torch.from_numpy(oracles.random_bins(rng, 3, 100))
    actual = wavelet_branches(x.float()).double()
    torch.testing.assert_close(actual, wavelet_branches(x), rtol=1e-5, atol=1e-5)


def test_gradcheck(rng):
    x = torch.from_numpy(rng.standard_normal((2, 17))).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: wavelet_branches(x, level=1), x)
    assert torch.autograd.gradcheck(
        wavelet_branches, torch.from_numpy(rng.standard_normal(80)).requires_grad_()
    )


@pytest.mark.parametrize(("frequency_hz", "branch"), [(950, "D1"), (375, "D2"), (180, "D3")])
def test_a_tone_lands_in_its_subband(frequency_hz, branch):
    """Level m of the details covers fs/2^(m+1) to fs/2^m."""
    t = torch.arange(100, dtype=torch.float64) / 2000.0
    tone = torch.sin(2 * torch.pi * frequency_hz * t + 0.3)
    energy = dict(zip(branch_names(4), wavelet_branches(tone).square().sum(-1), strict=True))
    details = {name: value for name, value in energy.items() if name[0] == "D"}
    assert max(details, key=details.get) == branch


def test_a_constant_has_no_detail():
    branches = wavelet_branches(torch.full((100,), 5.0, dtype=torch.float64))
    torch.testing.assert_close(branches[::2], torch.full_like(branches[::2], 5), rtol=1e-14, atol=0)
    assert branches[1::2].abs().max() < 16 * oracles.EPS * 5
    assert (wavelet_branches(torch.zeros(3, 100)) == 0).all()


def test_nan_stays_where_its_filters_reach():
    x = torch.zeros(100)
    x[50] = float("nan")
    branches = wavelet_branches(torch.stack([x, torch.ones(100)]))
    assert branches[0, :, 50].isnan().all()
    assert branches[1].isfinite().all()


@pytest.mark.parametrize("wavelet", ["haar", "db3", "rbio2.2", "sym8", "dmey"])
def test_the_highest_level_is_pywavelets(wavelet):
    length = pywt.Wavelet(wavelet).dec_len
    shortest = 2 * (length - 1)
    for num_samples in (shortest, shortest + 1, 100 + shortest, 1000):
        highest = highest_level(num_samples, wavelet)
        assert highest == pywt.dwt_max_level(num_samples, length) >= 1
    with pytest.raises(ValueError, match=f"{wavelet}, which needs {shortest}"):
        highest_level(shortest - 1, wavelet)


@pytest.mark.parametrize(
    ("num_samples", "options", "message"),
    [
        (100, {"level": 5}, r"1\.\.4.*100 samples.*got 5"),
        (100, {"level": 0}, r"1\.\.4.*got 0"),
        (50, {}, r"1\.\.3.*50 samples.*got 4"),
        (100, {"wavelet": "rbio9.9"}, r"rbio9\.9"),
        (
            9,
            {"level": 1},
            r"bins of 9 samples .* rbio2\.2, which needs 10; use longer",
        ),
        (0, {"level": 1}, r"bins of 0 samples are too short"),
    ],
)
def test_errors_name_the_value(num_samples, options, message):
    with pytest.raises(ValueError, match=message):
        wavelet_branches(torch.zeros(num_samples), **options)
