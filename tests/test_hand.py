import pytest

from tactslip_torch import Channel, HandLayout

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
        ({"adapting": ""}, "adapting must be slow or fast, got ''"),
        ({"kind": "two words"}, "kind must be one word, .* got 'two words'"),
        ({"kind": ""}, "kind must be one word, .* got ''"),
        ({"kind": " SG"}, "kind must be one word, .* got ' SG'"),
        ({"kind": 3}, "kind must be text, got 3"),
        ({"finger": None}, "finger must be text, got None"),
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
