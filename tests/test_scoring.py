"""Prediction of whole recordings against bins cut, filtered and judged one by one."""

import numpy as np
import oracles
import pytest
import torch
from small_detector import small_detector
from streams import detector_of, signal

from tactslip_torch.model.missing_channels import Prediction
from tactslip_torch.onset.decisions import score_stream

HOP = 20
LENGTHS = (51, 51, 11, 11)


def assert_scores(found: Prediction, expected: Prediction) -> None:
    spread = float(expected.score.double().std())
    close = 1e-9 if found.score.dtype == torch.float64 else 1e-4
    torch.testing.assert_close(found.score, expected.score, rtol=0, atol=close * spread)
    assert torch.equal(found.is_valid, expected.is_valid)
    assert torch.equal(found.is_missing, expected.is_missing)


def test_every_bin_of_the_filtered_recording_is_judged():
    detector, samples = small_detector(), signal(333)
    filtered = np.stack(
        [oracles.savgol(x, w) for x, w in zip(samples.numpy(), LENGTHS, strict=True)]
    )
    starts = [s for s in range(333) if s % HOP == 0 and s + 100 <= 333]
    one_by_one = [detector.predict(torch.from_numpy(filtered[:, s : s + 100])) for s in starts]
    found = score_stream(detector, samples, HOP)
    assert len(found.score) == 12
    assert found.score.std() > 1
    assert_scores(found, Prediction(*map(torch.stack, zip(*one_by_one, strict=True))))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("kind", ["all", "PVDF"])
@pytest.mark.parametrize("align", ["centred", "causal", "trailing"])
def test_bins_with_context_score_as_predict_raw_says(dtype, kind, align):
    detector, samples = detector_of(kind, align), signal(500, 3, dtype)
    samples[3, 220], samples[2, 300:] = torch.nan, 0.25
    found = score_stream(detector, samples, HOP)
    assert found.score.dtype == dtype
    before, after = detector.context_before, detector.context_after
    judged = [
        detector.predict_raw(samples[:, s - before : s + 100 + after])
        for s in range(60, 500 - 100 - after, HOP)
    ]
    expected = Prediction(*map(torch.stack, zip(*judged, strict=True)))
    assert_scores(Prediction(*(x[3 : 3 + len(judged)] for x in found)), expected)
    assert expected.is_valid.any()
    assert not expected.is_valid.all()


def test_a_nan_spoils_the_bins_that_its_frame_reaches():
    detector, samples = small_detector(), signal(600)
    samples[1, 300] = torch.nan
    found = score_stream(detector, samples, HOP)
    starts = HOP * torch.arange(len(found.score))
    is_reached = (starts <= 325) & (starts + 100 > 275)
    assert torch.equal(found.is_missing[:, 1], is_reached)
    assert not found.is_missing[:, [0, 2, 3]].any()
    assert torch.equal(found.is_valid, ~is_reached)
    assert found.score.isfinite().all()


def test_a_channel_that_no_feature_is_of_spoils_nothing():
    detector, samples = detector_of("PVDF"), signal(400)
    clean = score_stream(detector, samples, HOP)
    samples[0], samples[1, 200] = 0.0, torch.nan
    found = score_stream(detector, samples, HOP)
    assert torch.equal(found.score, clean.score)
    assert found.is_valid.all()
    starts = HOP * torch.arange(len(found.score))
    assert torch.equal(found.is_missing[:, 1], (starts <= 225) & (starts + 100 > 175))


@pytest.mark.parametrize(("num_samples", "num_scores"), [(99, 0), (119, 1), (120, 2)])
def test_every_bin_that_fits_has_a_score(num_samples, num_scores):
    for dtype in (torch.float32, torch.float64):
        found = score_stream(small_detector(), signal(num_samples, dtype=dtype), HOP)
        assert found.score.shape == found.is_valid.shape == (num_scores,)
        assert found.is_missing.shape == (num_scores, 4)
        assert found.score.dtype == dtype


def test_errors_are_one_line():
    detector = small_detector()
    with pytest.raises(ValueError, match=r"^expected a recording \[4, T\].*got \(1, 4, 300\)$"):
        score_stream(detector, signal(300)[None], HOP)
    with pytest.raises(ValueError, match=r"^expected a recording \[4, T\].*got \(300, 4\)$"):
        score_stream(detector, signal(300).T, HOP)
    with pytest.raises(ValueError, match=r"positive, got 0 and 1024$"):
        score_stream(detector, signal(300), 0)
    with pytest.raises(ValueError, match=r"positive, got 20 and 0$"):
        score_stream(detector, signal(300), HOP, 0)
    with pytest.raises(ValueError, match=r"float32 or float64.*torch.float16"):
        score_stream(detector, signal(300, dtype=torch.float16), HOP)
