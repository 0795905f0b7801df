"""A stream decides what the whole recording is judged as, however it is cut."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from tactslip_torch.onset.decisions import joined_decisions

from .names import StreamingDetector
from .recordings import RATE_HZ, samples_of

SAMPLES = samples_of("D", 1)[1500:4500].astype(np.float64)


def pushed(stream, samples, cuts=()):
    """What all pushes and the flush returned, by field, in one tensor each."""
    parts = [stream.push(samples[a:b]) for a, b in pairwise([0, *cuts, len(samples)])]
    parts.append(stream.flush())
    found = joined_decisions(parts)._asdict()
    return {name: values for name, values in found.items() if name != "channels"}


def assert_same(found, expected):
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9, equal_nan=True)


def in_double(trained):
    return StreamingDetector(trained.detector, dtype=torch.float64)


@pytest.fixture(scope="module")
def whole(trained):
    decisions = pushed(in_double(trained), SAMPLES)
    assert 0 < decisions["is_alarm"].sum() < len(decisions["is_alarm"])
    return decisions


@pytest.mark.parametrize("size", [1, 7, 150, 2000])
def test_pieces_of_a_size_decide_as_the_whole(trained, whole, size):
    assert_same(pushed(in_double(trained), SAMPLES, range(size, len(SAMPLES), size)), whole)


def test_a_stream_scores_the_bins_of_the_recording(trained, whole):
    """The score of decision ``i`` is that of the raw bin that begins at ``i`` hops."""
    detector, stream = trained.detector, in_double(trained)
    hop, before = round(stream.hop_s * RATE_HZ), detector.context_before
    length = before + detector.pool.bin_samples + detector.context_after
    for number in range(len(whole["score"])):
        start = number * hop - before
        if start < 0 or start + length > len(SAMPLES):
            continue
        raw = torch.from_numpy(SAMPLES[start : start + length].T.copy())
        predicted = detector.predict_raw(raw[None])
        assert predicted.score.item() == pytest.approx(whole["score"][number].item(), abs=1e-7)
        assert predicted.is_valid.item() == whole["is_valid"][number].item()
        ready_s = (number * hop + detector.pool.bin_samples + detector.look_ahead) / RATE_HZ
        assert whole["available_s"][number].item() == pytest.approx(ready_s, abs=1e-9)


def test_samples_behind_the_look_ahead_change_no_decision(trained, whole):
    changed = SAMPLES.copy()
    changed[1500:] = 7.0
    found = pushed(in_double(trained), changed)
    is_before = whole["available_s"] * RATE_HZ <= 1500
    assert is_before.sum() > 10
    assert_same(
        {k: v[is_before] for k, v in found.items()}, {k: v[is_before] for k, v in whole.items()}
    )


def test_missing_samples_are_flagged_while_they_matter(trained, whole):
    broken = SAMPLES.copy()
    broken[1000:1005] = np.nan
    found = pushed(in_double(trained), broken, [777, 1003])
    reach_s = (trained.detector.context_after + 5) / RATE_HZ
    start_s = whole["available_s"] - in_double(trained).look_ahead_s - in_double(trained).bin_s
    is_far = (whole["available_s"] < 1000 / RATE_HZ) | (start_s > 1000 / RATE_HZ + reach_s)
    assert found["is_valid"][is_far].all()
    assert not found["is_valid"].all()
    assert_same(found["score"][is_far], whole["score"][is_far])


def test_a_masked_channel_counts_as_missing(trained):
    used = trained.detector.pool.hand.names[trained.detector.needed_index[0]]
    masked = StreamingDetector(trained.detector, masked_channels=[used], dtype=torch.float64)
    without = SAMPLES.copy()
    without[:, trained.detector.pool.hand.names.index(used)] = np.nan
    found, expected = pushed(masked, SAMPLES), pushed(in_double(trained), without)
    assert_same(found, expected)
    assert found["is_valid"].all()
    place = trained.detector.pool.hand.names.index(used)
    assert found["channels_lost"][:, place].all()


def test_gaps_in_time_are_filled_or_begin_another_stream(trained, whole):
    stream = in_double(trained)
    short, long = 40, 600
    holed = SAMPLES.copy()
    holed[1000 : 1000 + short] = np.nan
    expected = pushed(in_double(trained), holed)["score"]
    parts = [
        stream.push(SAMPLES[:1000], 0.0),
        stream.push(SAMPLES[1000 + short :], (1000 + short) / RATE_HZ),
    ]
    found = torch.cat([part.score for part in [*parts, stream.flush()]])
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9, equal_nan=True)
    stream.reset()
    stream.push(SAMPLES[:1000], 0.0)
    behind = stream.push(SAMPLES, (1000 + long) / RATE_HZ)
    assert stream.num_gaps == 1
    scores = torch.cat([behind.score[behind.number.argmin().item() :], stream.flush().score])
    assert len(scores) >= len(whole["score"])
    assert_same(scores[-len(whole["score"]) :], whole["score"])


@pytest.mark.parametrize(
    ("samples", "time_s", "words"),
    [
        (np.zeros((3, 5)), None, r"\[n, 4\].*\(3, 5\)"),
        (np.zeros((3, 4), np.int16), None, "floating.*int16"),
        (np.zeros((3, 4)), [0.1, 0.2], r"time_s.*3.*\(2,\)"),
        (np.zeros((3, 4)), -5.0, "goes back"),
    ],
)
def test_what_cannot_be_pushed_is_refused_and_changes_nothing(
    trained, whole, samples, time_s, words
):
    stream = in_double(trained)
    first = stream.push(SAMPLES[:700], 0.0)
    with pytest.raises(ValueError, match=words):
        stream.push(samples, time_s)
    rest = [stream.push(SAMPLES[700:]), stream.flush()]
    scores = torch.cat([part.score for part in (first, *rest)])
    assert_same(scores, whole["score"])
