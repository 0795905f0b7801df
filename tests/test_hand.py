"""Hands, recordings and their identities: what follows from what is said, and what is refused."""

import pytest
import torch

from tactslip_torch import Channel, HandLayout, Recording
from tactslip_torch.data.recording import RecordingId

ROWS = [
    {"name": "pad", "kind": "SG", "finger": "thumb", "segment": "distal"},
    {"name": "film", "kind": "PVDF", "finger": "thumb", "segment": "distal"},
]


def test_the_papers_hand_is_in_file_order_and_its_rows_go_round():
    hand = HandLayout.paper24()
    gauges, films = [f"SG{i}" for i in range(1, 15)], [f"PVDF{i}" for i in range(1, 11)]
    assert list(hand.names) == gauges + films
    assert hand.slow == hand.indices("SG") == tuple(range(14))
    assert hand.fast == hand.indices("PVDF") == tuple(range(14, 24))
    again = HandLayout.from_rows(hand.to_rows())
    assert (again, hash(again)) == (hand, hash(hand))
    assert HandLayout.from_rows(ROWS).to_rows() == ROWS


def test_a_channel_is_found_by_name():
    assert HandLayout.paper24().channel("PVDF9") == Channel("PVDF9", "PVDF", "thumb", "distal")
    with pytest.raises(KeyError, match=r"no channel 'PVDF11' in this hand; it has SG1, .*PVDF10"):
        HandLayout.paper24().channel("PVDF11")


def test_slow_and_fast_part_a_hand_whatever_its_kinds():
    kinds = [("electrode", "fast"), ("SG", "fast"), ("PVDF", None), ("force", "slow"), ("SG", None)]
    channels = [Channel(f"c{i}", kind, "f", "s", way) for i, (kind, way) in enumerate(kinds)]
    hand = HandLayout(channels)
    assert (hand.fast, hand.slow) == ((0, 1, 2), (3, 4))
    assert hand.kinds == ("electrode", "SG", "PVDF", "force")
    assert (hand.indices("SG"), hand.indices("IMU")) == ((1, 4), ())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "FSR"}, "channel 'film': of kind 'FSR' .* say adapting: slow .* or .*fast"),
        ({"kind": "FSR", "adapting": "quick"}, "adapting must be slow or fast, got 'quick'"),
        ({"kind": "two words"}, "kind must be one word, .* got 'two words'"),
        ({"kind": 3}, "kind must be text, got 3"),
        ({"name": 7}, "channel 7: name must be text, got 7"),
        ({"gain": "2"}, "expected name, kind"),
    ],
)
def test_what_is_no_channel_is_refused_with_its_row(change, message):
    with pytest.raises(ValueError, match=f"^channel row 2: .*{message}") as refused:
        HandLayout.from_rows([ROWS[0], ROWS[1] | change])
    assert "\n" not in str(refused.value)


def test_rows_that_make_no_hand_are_refused():
    with pytest.raises(ValueError, match=r"must be unique, got \['pad'\] more than once"):
        HandLayout.from_rows([ROWS[0], ROWS[1], ROWS[0]])
    with pytest.raises(ValueError, match="channel row 2: expected name, kind"):
        HandLayout.from_rows([ROWS[1], {"name": "pad", "finger": "thumb"}])


def recording(**changes):
    values = {
        "samples": torch.zeros(3, 500),
        "sample_rate_hz": 2000.0,
        "material": "M1",
        "speeds_mm_s": (20.0, 40.0),
        "onsets_s": (0.05, 0.15),
        "sliding_s": ((0.05, 0.1), (0.15, 0.2)),
    }
    return Recording(**(values | changes))


def test_what_follows_from_what_is_said():
    plain = recording()
    assert (plain.duration_s, plain.annotated_onsets_s, plain.released_s) == (
        0.25,
        (0.05, 0.15),
        (),
    )
    assert recording(sample_rate_hz=500.0).duration_s == 1.0
    assert recording(speeds_mm_s=(), onsets_s=(), sliding_s=()).annotated_onsets_s == ()
    said = {"annotated_onsets_s": (0.06, 0.14), "released_s": ((0.04, 0.05), (0.15, 0.15))}
    assert {name: getattr(recording(**said), name) for name in said} == said


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"samples": torch.zeros(500)}, r"samples must be \[C, T\], got"),
        ({"sample_rate_hz": 0.0}, "sample_rate_hz must be positive"),
        ({"speeds_mm_s": (20.0,)}, r"as many speeds as onsets.*got \[.*1.*\]"),
        ({"released_s": ((0.04, 0.06),)}, "empty or one of each of 2 onsets, got 1"),
        ({"released_s": ((0.04, 0.06), (0.16, 0.2))}, r"at 0\.15 s must .* releases, 0\.16-0\.2 s"),
    ],
)
def test_what_cannot_be_is_refused(change, said):
    with pytest.raises(ValueError, match=said):
        recording(**change)


def test_ids_sort_by_material_then_cycle_and_read_well():
    ids = [RecordingId("wood", 0), RecordingId("M1", 10), RecordingId("M1", 2, session="2")]
    ids += [RecordingId("M1", 2), RecordingId("M1", 2, "taps")]
    assert [str(i) for i in sorted(ids)] == ["M1/2", "M1/2@2", "M1/2/taps", "M1/10", "wood/0"]
    assert len({RecordingId("M1", 2), RecordingId("M1", 2)}) == 1
