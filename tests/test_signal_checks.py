"""Simulated recordings look as the paper describes its signals, and shuffled ones do not."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.signal_checks import (
    SIGNAL_CHECKS,
    Signals,
    check_signals,
    filtered,
    pvdf_slide_over_rest,
    pvdf_speed_growth,
    sg_variation,
)
from tactslip_torch.hand import HandLayout
from tactslip_torch.simulation import SEEN_MATERIALS, Scene, simulate

HAND = HandLayout.paper24()
RATE_HZ = 2000.0
BY_NAME = {check.name: check for check in SIGNAL_CHECKS}


@pytest.fixture(scope="module")
def recordings():
    return {
        material: [filtered(simulate(Scene(material, cycle=cycle)), HAND) for cycle in range(3)]
        for material in SEEN_MATERIALS
    }


def changed(recordings, change):
    return {
        material: [replace(s, sg=change(s.sg), pvdf=change(s.pvdf)) for s in seen]
        for material, seen in recordings.items()
    }


def shuffled(samples):
    """The same values of every channel in another order."""
    return samples[:, np.random.default_rng(0).permutation(samples.shape[1])]


@pytest.mark.slow
def test_checks_hold_on_recordings_and_fail_on_shuffled_ones(recordings):
    for of, holds in ((recordings, True), (changed(recordings, shuffled), False)):
        results = {check["name"]: check for check in check_signals(of)}
        assert set(results) == set(BY_NAME)
        for name, found in results.items():
            values = BY_NAME[name].values(of)
            assert found["values"] == values
            assert {BY_NAME[name].allows(value) for value in values.values()} == {holds}, name
            assert found["holds"] == holds
    assert results["d1"]["values"].keys() == recordings.keys()


@pytest.mark.slow
def test_checks_of_materials_that_are_not_there_are_left_out(recordings):
    names = {check["name"] for check in check_signals({"M1": recordings["M1"]})}
    gone = {"pvdf_abrupt", "pvdf_abrupt_contrast", "barely"}
    assert names == set(BY_NAME) - gone


def made(sg=None, pvdf=None, seconds=16.0):
    """A recording with onsets at 2, 9 and 13.5 s as the paper's; one channel each."""
    silent = np.zeros((1, round(seconds * RATE_HZ)))
    sliding_s = ((2.0, 7.0), (9.0, 11.5), (13.5, 15.2))
    onsets_s = tuple(start for start, _ in sliding_s)
    return Signals(
        silent if sg is None else sg, silent if pvdf is None else pvdf, RATE_HZ, onsets_s, sliding_s
    )


def tone(level_at_rest, levels_in_slides, hertz=50.0, seconds=16.0):
    """A sine of the given rms at rest and in each slide, one channel."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    level = np.full(t.shape, level_at_rest)
    for (start_s, end_s), value in zip(made().sliding_s, levels_in_slides, strict=True):
        level[(t >= start_s) & (t < end_s)] = value
    return (level * np.sqrt(2) * np.sin(2 * np.pi * hertz * t))[None]


def test_statistics_of_tones_are_their_levels():
    seen = [made(pvdf=tone(0.5, (2.0, 3.0, 6.0)))]
    assert pvdf_slide_over_rest(seen) == pytest.approx(6.0, rel=1e-3)
    assert pvdf_speed_growth(seen) == pytest.approx(1.5, rel=1e-3)
    assert sg_variation([made(sg=tone(0.5, (2.0, 3.0, 6.0)))]) == pytest.approx(6.0, rel=1e-3)


def test_recordings_that_cannot_be_checked_are_refused():
    short = simulate(Scene("M1", strokes=Scene("M1").strokes[:2]), channels=["PVDF1"])
    with pytest.raises(ValueError, match="checks need three strokes, got 2"):
        filtered(short, HAND)
    ramp = np.arange(32000.0)[None] / RATE_HZ  # its value is its time
    early = replace(made(sg=ramp), onsets_s=(1.1, 1.2, 9.0))
    with pytest.raises(ValueError, match=r"^checks need 1\.2 s of rest .* onset 1 is at 1\.100 s"):
        early.rest(early.sg)
    np.testing.assert_allclose(early.rest(early.sg, 1)[0, [0, -1]], [0.0, 0.8995], atol=1e-9)
    np.testing.assert_allclose(early.rest(early.sg, 2)[0, [0, -1]], [7.8, 8.6995], atol=1e-9)
