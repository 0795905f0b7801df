"""Low-rank products equal PyWavelets' branches and numpy's spectra."""

import numpy as np
import pytest
import pywt
import torch

from tactslip_torch.features.bank import LinearMaps
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.hand import HandLayout
from tactslip_torch.signals.wavelet import SpectrumMethod

CASES = [(100, 4, "reference"), (100, 4, "clean"), (101, 4, "reference"), (50, 3, "clean")]


def maps_of(num: int, level: int, spectrum: SpectrumMethod) -> LinearMaps:
    hand = HandLayout.paper24()
    return FeaturePool(hand, bin_samples=num, level=level, spectrum=spectrum).maps


def branch_by_pywt(x: np.ndarray, name: str, level: int) -> np.ndarray:
    """One component rebuilt alone, at the signal's own length."""
    kind, depth = name[0], int(name[1:])
    parts = pywt.wavedec(x, "rbio2.2", mode="symmetric", level=depth)
    kept = 0 if kind == "A" else 1
    parts = [part if i == kept else np.zeros_like(part) for i, part in enumerate(parts)]
    return pywt.waverec(parts, "rbio2.2", mode="symmetric")[: len(x)]


@pytest.mark.parametrize(("num", "level", "spectrum"), CASES)
def test_branches_equal_pywavelets(num: int, level: int, spectrum: SpectrumMethod) -> None:
    maps = maps_of(num, level, spectrum)
    x = np.random.default_rng(0).normal(size=num)
    for place, (name, dense) in enumerate(zip(maps.branches, maps.dense, strict=True)):
        expected, block = branch_by_pywt(x, name, level), maps.block(place)
        coordinates = torch.from_numpy(x) @ block.into
        branch = coordinates[:-1] @ block.out + coordinates[-1] / num
        np.testing.assert_allclose(branch, expected, atol=1e-13)
        np.testing.assert_allclose(dense @ torch.from_numpy(x), expected, atol=1e-13)


@pytest.mark.parametrize(("num", "level", "spectrum"), CASES)
def test_lines_equal_numpys_transform(num: int, level: int, spectrum: SpectrumMethod) -> None:
    maps = maps_of(num, level, spectrum)
    length = 2 * (num - 1)
    num_fft = 1 << (length - 1).bit_length() if spectrum == "reference" else num
    divisor = length if spectrum == "reference" else num

    def amplitudes(x: np.ndarray) -> np.ndarray:
        plain = np.abs(np.fft.fft(x, num_fft))[: maps.num_lines] / divisor
        is_edge = [0, -1] if spectrum == "reference" or num % 2 == 0 else [0]
        doubled = 2 * plain
        doubled[is_edge] /= 2
        return doubled

    def modulus(lines: torch.Tensor) -> torch.Tensor:
        return lines.reshape(2, -1).square().sum(0).sqrt()

    x = np.random.default_rng(1).normal(size=num)
    for place, name in enumerate(maps.branches):
        expected, block = amplitudes(branch_by_pywt(x, name, level)), maps.block(place)
        lines = torch.from_numpy(x) @ block.into @ block.lines
        np.testing.assert_allclose(modulus(lines), expected, atol=1e-13)
    np.testing.assert_allclose(
        modulus(maps.dense_lines @ torch.from_numpy(x)), amplitudes(x), atol=1e-13
    )


def test_ranks_are_the_numbers_of_wavelet_coefficients() -> None:
    maps = maps_of(100, 4, "reference")
    ranks = {name: maps.block(place).rank for place, name in enumerate(maps.branches)}
    parts = [len(part) for part in pywt.wavedec(np.zeros(100), "rbio2.2", "symmetric", 4)]
    assert ranks["A4"] == parts[0] - 1  # its mean is a coordinate beside them
    # symmetric extension makes one coefficient of each detail follow from the others
    assert [ranks[f"D{m}"] for m in (4, 3, 2, 1)] == [num - 1 for num in parts[1:]]


def test_details_remove_a_constant_and_approximations_keep_it() -> None:
    maps = maps_of(100, 4, "reference")
    for keeps, dense in zip(maps.is_approximation, maps.dense, strict=True):
        torch.testing.assert_close(dense.sum(-1), torch.full((100,), float(keeps)).double())
