"""Hands, recordings and their identities: what follows from what is said, and what is refused."""

import pytest
import torch

from tactslip_torch import Channel, HandLayout, Recording
from tactslip_torch.data.recording import RecordingId

ROWS = [
    {"name": "pad", "kind": "SG", "finger": "thumb", "segment": "distal"},
    {"name": "film", "kind": "PVDF", "finger": "thumb", "segment": "distal"},
]


def test_the_papers_hand_is_in_file_order():
    hand = HandLayout.paper24()
    gauges, films = [f"SG{i}" for i in range(1, 15)], [f"PVDF{i}" for i in range(1, 11)]
    assert list(hand.names) == gauges + films
    assert len(hand) == 24
    assert hand.indices("SG") == tuple(range(14))
    assert hand.indices("PVDF") == tuple(range(14, 24))


def test_rows_go_round():
    hand = HandLayout.from_rows(ROWS)
    assert hand.to_rows() == ROWS
    assert hand == HandLayout((Channel(**ROWS[0]), Channel(**ROWS[1])))
    paper = HandLayout.paper24()
    assert HandLayout.from_rows(paper.to_rows()) == paper
    assert hash(HandLayout.from_rows(paper.to_rows())) == hash(paper)


def test_a_channel_is_found_by_name():
    assert HandLayout.paper24().channel("PVDF9") == Channel("PVDF9", "PVDF", "thumb", "distal")
    with pytest.raises(KeyError, match=r"no channel 'PVDF11' in this hand; it has SG1, .*PVDF10"):
        HandLayout.paper24().channel("PVDF11")


def test_a_name_that_occurs_twice_is_refused():
    with pytest.raises(ValueError, match=r"must be unique, got \['pad'\] more than once"):
        HandLayout.from_rows([ROWS[0], ROWS[1], ROWS[0]])


@pytest.mark.parametrize(
    ("kind", "adapting", "known"), [("SG", None, "slow"), ("PVDF", None, "fast")]
    + [(kind, way, way) for kind in ("SG", "PVDF", "electrode") for way in ("slow", "fast")],
)  # fmt: skip
def test_how_a_channel_adapts_is_said_or_known(kind, adapting, known):
    assert Channel("a", kind, "index", "distal", adapting).adapting == known


def test_slow_and_fast_part_a_hand_whatever_its_kinds():
    kinds = [("electrode", "fast"), ("SG", "fast"), ("PVDF", None), ("force", "slow"), ("SG", None)]
    channels = [Channel(f"c{i}", kind, "f", "s", way) for i, (kind, way) in enumerate(kinds)]
    hand = HandLayout(channels)
    assert (hand.fast, hand.slow) == ((0, 1, 2), (3, 4))
    assert hand.kinds == ("electrode", "SG", "PVDF", "force")
    assert (hand.indices("SG"), hand.indices("IMU")) == ((1, 4), ())
    paper = HandLayout.paper24()
    assert (paper.slow, paper.fast) == (paper.indices("SG"), paper.indices("PVDF"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "FSR"}, "channel 'film': of kind 'FSR' .* say adapting: slow .* or .*fast"),
        ({"kind": "FSR", "adapting": "quick"}, "adapting must be slow or fast, got 'quick'"),
        ({"kind": "two words"}, "kind must be one word, .* got 'two words'"),
        ({"kind": 3}, "kind must be text, got 3"),
        ({"name": 7}, "channel 7: name must be text, got 7"),
    ],
)
def test_what_is_no_channel_is_refused_with_its_row(change, message):
    with pytest.raises(ValueError, match=f"^channel row 2: .*{message}") as refused:
        HandLayout.from_rows([ROWS[0], ROWS[1] | change])
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("row", [{"name": "pad", "kind": "SG"}, ROWS[0] | {"gain": "2"}])
def test_a_row_with_other_keys_is_refused_with_its_number(row):
    with pytest.raises(ValueError, match="channel row 2: expected name, kind, finger, segment"):
        HandLayout.from_rows([ROWS[1], row])


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
    assert recording().duration_s == 0.25
    assert recording(sample_rate_hz=500.0).duration_s == 1.0
    assert recording().annotated_onsets_s == (0.05, 0.15)
    assert recording(annotated_onsets_s=(0.06, 0.14)).annotated_onsets_s == (0.06, 0.14)
    rest = recording(speeds_mm_s=(), onsets_s=(), sliding_s=())
    assert rest.annotated_onsets_s == ()
    assert recording().released_s == ()
    released_s = ((0.04, 0.05), (0.15, 0.15))
    assert recording(released_s=released_s).released_s == released_s


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"samples": torch.zeros(500)}, r"samples must be \[C, T\], got"),
        ({"sample_rate_hz": 0.0}, "sample_rate_hz must be positive"),
        ({"speeds_mm_s": (20.0,)}, r"as many speeds as onsets.*got \[.*1.*\]"),
        ({"released_s": ((0.04, 0.06),)}, "empty or one of each of 2 onsets, got 1"),
        ({"released_s": ((0.04, 0.06), (0.16, 0.2))}, r"at 0\.15 s must .* releases, 0\.16-0\.2 s"),
        ({"annotated_onsets_s": (0.05,)}, r"as many speeds as onsets.*got \[.*1.*\]"),
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
