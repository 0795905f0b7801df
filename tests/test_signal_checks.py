"""Simulated recordings look as the paper describes its signals, and shuffled ones do not."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.signal_checks import (
    SIGNAL_CHECKS,
    check_signals,
    filtered,
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
