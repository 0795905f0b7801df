"""What bins cover of the input, against plain NumPy."""

import numpy as np
import pytest
import torch

from tactslip_torch.analysis.certificate import KnownInputs, coverage

KINDS = {"SG1": "SG", "SG2": "SG", "PVDF1": "PVDF"}


def drawn(rng, num_bins=6):
    samples = rng.standard_normal((num_bins, 3, 9))
    return samples, samples[..., 2:-2] + 0.5


def covered(samples, filtered):
    return coverage(torch.from_numpy(samples), torch.from_numpy(filtered))


def test_what_bins_cover(rng):
    samples, filtered = drawn(rng)
    filtered[0, 0] = 0.0
    filtered[1, 1] = 3.0
    bins = covered(samples, filtered)
    np.testing.assert_array_equal(bins.low_v, samples.min(-1))
    np.testing.assert_array_equal(bins.high_v, samples.max(-1))
    span = np.ptp(filtered, axis=-1)
    np.testing.assert_array_equal(bins.span_v, span)
    size = np.abs(filtered).max(-1)
    expected = np.divide(span, size, out=np.zeros_like(span), where=size > 0)
    np.testing.assert_array_equal(bins.relative_span, expected)
    assert bins.relative_span[0, 0] == bins.relative_span[1, 1] == 0


def test_a_range_is_that_of_its_kind(rng):
    samples, filtered = drawn(rng)
    facts = KnownInputs(covered(samples, filtered), KINDS).to_dict()
    for kind, places in {"SG": [0, 1], "PVDF": [2]}.items():
        own = facts["kinds"][kind]
        assert own["low_v"] == samples[:, places].min()
        assert own["high_v"] == samples[:, places].max()
        spans, sizes = np.ptp(filtered[:, places], -1), np.abs(filtered[:, places]).max(-1)
        assert own["span_v"] == spans.min()
        assert own["relative_span"] == (spans / sizes).min()
    assert facts["channels"]["SG2"]["high_v"] == samples[:, 1].max()
    assert list(facts["channels"]) == list(KINDS)


def test_bins_cover_themselves_and_nothing_beyond(rng):
    samples, filtered = drawn(rng)
    bins = covered(samples, filtered)
    known = KnownInputs(bins, KINDS)
    assert known.cover(bins).all()
    for channel in range(3):
        for change in ("low_v", "high_v", "span_v", "relative_span"):
            beyond = getattr(bins, change).clone()
            beyond[4, channel] += {"low_v": -9, "high_v": 9}.get(change, -9)
            assert known.cover(bins._replace(**{change: beyond})).tolist() == [True] * 4 + [
                False,
                True,
            ]


def test_channels_of_a_kind_share_a_range_and_others_do_not():
    calm = np.tile(np.array([-1.0, 1.0]), (1, 3, 1)) * np.array([1.0, 5.0, 2.0])[:, None]
    known = KnownInputs(covered(calm, calm), KINDS)
    for place, size, expected in (
        (0, 4.9, True),
        (0, 5.1, False),
        (2, 4.9, False),
        (2, 1.9, False),
    ):
        louder = calm.copy()
        louder[0, place] = [-size, size]
        assert known.cover(covered(louder, louder)).tolist() == [expected]


def test_a_channel_that_is_not_used_does_not_matter(rng):
    samples, filtered = drawn(rng)
    bins = covered(samples, filtered)
    known = KnownInputs(bins, KINDS, used=["SG1"])
    far = bins._replace(high_v=bins.high_v + torch.tensor([0.0, 99.0, 99.0]))
    assert known.cover(far).all()
    assert not known.cover(bins._replace(high_v=bins.high_v + 99)).any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_dtype_is_that_of_the_filtered_bins(dtype):
    bins = coverage(torch.zeros(2, 1, 5), torch.zeros(2, 1, 3, dtype=dtype))
    assert {part.dtype for part in bins} == {dtype}
