"""Bristles look as the paper describes too: ``facts`` on few recordings of one and of many."""

from dataclasses import replace

import pytest
from scene_files import BRISTLES, CONTACTS
from test_facts import BY_NAME, HAND, changed, shuffled

from tactslip_torch.analysis.signal_checks import filtered
from tactslip_torch.simulation import SEEN_MATERIALS, paper_scenes, simulate_many

GENTLE = {"many": {"pvdf_abrupt": 1.25}}
"""A patch lets go bristle by bristle, so its bursts are weaker; shuffled ones are 1."""


@pytest.fixture(scope="module", params=BRISTLES)
def bristles(request):
    scenes = paper_scenes(cycles=3, materials=SEEN_MATERIALS, **CONTACTS[request.param])
    recordings = {material: [] for material in SEEN_MATERIALS}
    for recording in simulate_many(scenes):
        recordings[recording.material].append(filtered(recording, HAND))
    return request.param, recordings


@pytest.mark.parametrize("name", BY_NAME)
def test_a_fact_holds_with_bristles_and_fails_on_shuffled_signals(bristles, name):
    model, recordings = bristles
    fact = BY_NAME[name]
    fact = replace(fact, low=GENTLE.get(model, {}).get(name, fact.low))
    values = fact.values(recordings)
    assert values
    assert all(map(fact.allows, values.values())), values
    spoilt = fact.values(changed(recordings, shuffled))
    assert not any(map(fact.allows, spoilt.values())), spoilt
