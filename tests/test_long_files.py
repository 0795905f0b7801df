"""Recordings of hours: what is read of them is what is asked for, and no more stays in memory."""

import tracemalloc
from contextlib import contextmanager

import numpy as np
import pytest
import torch

from tactslip_torch.data.clock import even_clock
from tactslip_torch.data.file_recordings import EvenSamples
from tactslip_torch.data.formats import Samples, open_file

SHAPE = 240_000, 24  # 23 MB of float32
SIZE = 4 * SHAPE[0] * SHAPE[1]


@contextmanager
def at_most(num_bytes):
    """What is allocated at one time in a ``with``."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < num_bytes
    finally:
        tracemalloc.stop()


@pytest.fixture(scope="module")
def stored():
    values = np.zeros(SHAPE, np.float32)
    values[::1000] = np.random.default_rng(0).normal(size=(SHAPE[0] // 1000, SHAPE[1]))
    return values


def written(folder, kind, values):
    path = folder / f"a.{'npy' if kind == 'npy' else 'npz'}"
    if kind == "npy":
        np.save(path, values)
    elif kind == "columns":
        np.savez(path, samples=np.asfortranarray(values))
    elif kind == "packed":
        np.savez_compressed(path, samples=values)
    else:
        np.savez(path, samples=values)
    return path


@pytest.mark.parametrize("kind", ["npy", "npz", "columns", "packed"])
def test_a_stretch_of_a_large_array_is_read_alone(tmp_path, stored, kind):
    path = written(tmp_path, kind, stored)
    with at_most(SIZE / 4), open_file(path) as opened:
        samples = opened.samples
        assert (samples.num_channels, samples.num_samples) == SHAPE[::-1]
        for first, stop in ((0, 2000), (150_000, 152_000), (239_000, 300_000), (7, 7)):
            assert np.array_equal(samples.read(first, stop).numpy(), stored[first:stop].T)


def test_a_large_array_that_is_damaged_is_refused(tmp_path, stored):
    path = written(tmp_path, "npz", stored)
    content = bytearray(path.read_bytes())
    content[SIZE // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.npz is damaged"), open_file(path):
        pass
    path.write_bytes(written(tmp_path, "npy", stored).read_bytes()[:-1])
    with pytest.raises(ValueError, match="damaged"), open_file(tmp_path / "a.npz"):
        pass


def test_a_file_with_gaps_is_read_by_stretches(tmp_path, stored):
    path = written(tmp_path, "npy", stored)
    times = np.arange(SHAPE[0]) / 2000
    times[100_000:] += 0.01  # 20 samples
    clock = even_clock(times)
    with at_most(SIZE / 4), open_file(path) as opened:
        samples = EvenSamples(opened.samples, clock, 30, rows=[5, 2])
        crossed = samples.read(99_990, 100_030)
    expected = torch.from_numpy(stored[99_990:100_010, [5, 2]].T)
    assert torch.equal(torch.cat([crossed[:, :10], crossed[:, 30:]], 1), expected)
    assert crossed.isfinite().all()


def test_the_clock_of_many_times_takes_little_more_than_they_do():
    times = np.arange(2_000_000) / 2000
    times[1_500_000:] += 0.02
    with at_most(2 * times.nbytes):
        clock = even_clock(times)
    assert [tuple(gap) for gap in clock.gaps] == [(1_500_000, 40, 1_500_000)]
    assert clock.sample_rate_hz == pytest.approx(2000, rel=1e-12)


def test_a_column_of_a_long_table_is_read_without_the_others(stored, tmp_path):
    path = written(tmp_path, "npy", stored)
    values = np.load(path, mmap_mode="r")
    with at_most(SIZE / 4):
        column = Samples(path, values, 0, [3]).stored(0, SHAPE[0])
    assert np.array_equal(column[0], stored[:, 3])
