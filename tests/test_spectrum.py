import numpy as np
import oracles
import pytest
import torch

from tactslip_torch.signals.spectrum import (
    amplitude_spectrum,
    frequency_axis_hz,
    spectrum_matrix,
)

LENGTHS = [2, 3, 5, 50, 64, 65, 99, 100, 101, 129, 130]
METHODS = ["reference", "clean"]


def oracle(x, method):
    return np.stack([oracles.amplitude_spectrum(one, method) for one in x])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("num_samples", LENGTHS)
@pytest.mark.parametrize("make", [oracles.random_bins, oracles.integer_bins])
def test_equals_numpy(method, num_samples, make, rng):
    x = make(rng, 5, num_samples)
    oracles.assert_columns_close(amplitude_spectrum(torch.from_numpy(x), method), oracle(x, method))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("num_samples", LENGTHS)
def test_matrix_is_the_same_map(method, num_samples, rng):
    x = rng.standard_normal((5, num_samples))
    matrix = spectrum_matrix(num_samples, method)
    assert matrix.dtype == torch.complex128
    actual = (matrix @ torch.from_numpy(x).to(torch.complex128).T).abs().T
    oracles.assert_columns_close(actual, oracle(x, method))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("num_samples", [2, 99, 100])
def test_axis(method, num_samples):
    actual = frequency_axis_hz(num_samples, 2000.0, method=method)
    expected = oracles.frequency_axis_hz(num_samples, 2000.0, method)
    assert actual.dtype == torch.float64
    np.testing.assert_allclose(actual.numpy(), expected, rtol=1e-15)
    assert len(actual) == amplitude_spectrum(torch.zeros(num_samples), method).shape[-1]


def test_the_default_is_the_authors(rng):
    x = rng.standard_normal((2, 100))
    actual = amplitude_spectrum(torch.from_numpy(x))
    oracles.assert_columns_close(actual, oracle(x, "reference"))
    assert frequency_axis_hz(100, 2000.0)[1] == 20


@pytest.mark.parametrize("method", METHODS)
def test_manners(method, rng, device):
    x = torch.from_numpy(oracles.random_bins(rng, 4, 100)).to(device)
    oracles.assert_manners(lambda x: amplitude_spectrum(x, method), x)


@pytest.mark.parametrize("method", METHODS)
def test_float32_is_close_to_float64(method, rng):
    x = torch.from_numpy(oracles.random_bins(rng, 4, 100))
    actual = amplitude_spectrum(x.float(), method).double()
    torch.testing.assert_close(actual, amplitude_spectrum(x, method), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("num_samples", [9, 10])
def test_gradcheck(method, num_samples, rng):
    x = torch.from_numpy(rng.standard_normal((2, num_samples))).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: amplitude_spectrum(x, method), x)


@pytest.mark.parametrize("method", METHODS)
def test_gradient_of_silence_is_finite(method):
    x = torch.zeros(100, dtype=torch.float64, requires_grad=True)
    amplitude_spectrum(x, method).sum().backward()
    assert x.grad.isfinite().all()


@pytest.mark.parametrize("line", [1, 7, 49])
def test_a_tone_lands_in_its_line_with_its_amplitude(line):
    """Clean: 20 Hz lines, true amplitudes."""
    t = torch.arange(100, dtype=torch.float64) / 2000.0
    frequency_hz = frequency_axis_hz(100, 2000.0, method="clean")[line]
    spectrum = amplitude_spectrum(0.7 * torch.cos(2 * torch.pi * frequency_hz * t + 1), "clean")
    assert spectrum[line].item() == pytest.approx(0.7, rel=1e-12)
    spectrum[line] = 0
    assert spectrum.max() < 1e-13


def test_clean_keeps_dc_and_nyquist():
    t = torch.arange(100, dtype=torch.float64)
    spectrum = amplitude_spectrum(0.3 + 0.2 * torch.cos(torch.pi * t), "clean")
    torch.testing.assert_close(spectrum[[0, 50]], torch.tensor([0.3, 0.2], dtype=torch.float64))
    assert spectrum[1:50].max() < 1e-13


@pytest.mark.parametrize("frequency_hz", [125.0, 250.0, 500.0])
def test_the_reference_has_its_peak_at_the_line_of_256_points(frequency_hz):
    """True lines are fs/256 = 7.8125 Hz apart; the authors' axis is 2.56 times that."""
    t = torch.arange(100, dtype=torch.float64) / 2000.0
    spectrum = amplitude_spectrum(torch.sin(2 * torch.pi * frequency_hz * t))
    line = int(spectrum.argmax())
    assert line == round(frequency_hz * 256 / 2000)
    assert frequency_axis_hz(100, 2000.0)[line] == pytest.approx(2.56 * frequency_hz)


@pytest.mark.parametrize("method", METHODS)
def test_zero_and_nan(method):
    x = torch.zeros(2, 100)
    x[1, 3] = float("nan")
    spectrum = amplitude_spectrum(x, method)
    assert (spectrum[0] == 0).all()
    assert spectrum[1].isnan().all()


def test_errors_name_the_value():
    with pytest.raises(ValueError, match="two samples, got 1"):
        amplitude_spectrum(torch.zeros(3, 1))
    with pytest.raises(ValueError, match="'reference' or 'clean', got 'welch'"):
        amplitude_spectrum(torch.zeros(100), "welch")
    with pytest.raises(ValueError, match="welch"):
        frequency_axis_hz(100, 2000.0, method="welch")
    with pytest.raises(ValueError, match="welch"):
        spectrum_matrix(100, "welch")
