import pytest

from tactslip_torch import Channel, HandLayout

FINGERS = ("little", "ring", "middle", "index")
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


def test_the_papers_channels_sit_in_the_papers_fingers():
    hand = HandLayout.paper24()
    numbers = {"little": (1, 3, 1, 2), "ring": (4, 6, 3, 4), "middle": (7, 9, 5, 6)}
    numbers |= {"index": (10, 12, 7, 8), "thumb": (13, 14, 9, 10)}
    for finger, (first_gauge, last_gauge, first_film, last_film) in numbers.items():
        expected = [f"SG{i}" for i in range(first_gauge, last_gauge + 1)]
        expected += [f"PVDF{i}" for i in range(first_film, last_film + 1)]
        assert [c.name for c in hand.channels if c.finger == finger] == expected


def test_fingers_carry_films_on_two_segments_and_the_thumb_on_both():
    hand = HandLayout.paper24()
    for finger in FINGERS:
        own = [c for c in hand.channels if c.finger == finger]
        assert [c.segment for c in own if c.kind == "SG"] == ["distal", "middle", "proximal"]
        assert [c.segment for c in own if c.kind == "PVDF"] == ["distal", "middle"]
    thumb = [c for c in hand.channels if c.finger == "thumb"]
    films = {c.segment for c in thumb if c.kind == "PVDF"}
    assert films == {c.segment for c in thumb if c.kind == "SG"}
    assert len(films) == 2


def test_rows_go_round():
    hand = HandLayout.from_rows(ROWS)
    assert hand.to_rows() == ROWS
    assert hand == HandLayout((Channel(**ROWS[0]), Channel(**ROWS[1])))
    paper = HandLayout.paper24()
    assert HandLayout.from_rows(paper.to_rows()) == paper
    assert hash(HandLayout.from_rows(paper.to_rows())) == hash(paper)


def test_channels_may_come_in_any_order_of_kinds():
    hand = HandLayout.from_rows([ROWS[1], ROWS[0]])
    assert hand.indices("PVDF") == (0,)
    assert hand.indices("SG") == (1,)
    assert hand != HandLayout.from_rows(ROWS)


def test_a_list_of_channels_becomes_a_tuple():
    channels = list(HandLayout.from_rows(ROWS).channels)
    hand = HandLayout(channels)
    channels.clear()
    assert len(hand) == 2


def test_a_channel_is_found_by_name():
    assert HandLayout.paper24().channel("PVDF9") == Channel("PVDF9", "PVDF", "thumb", "distal")
    with pytest.raises(KeyError, match=r"no channel 'PVDF11' in this hand; it has SG1, .*PVDF10"):
        HandLayout.paper24().channel("PVDF11")


def test_no_channel_is_refused():
    with pytest.raises(ValueError, match="at least one channel, got none"):
        HandLayout(())


def test_a_name_that_occurs_twice_is_refused():
    with pytest.raises(ValueError, match=r"must be unique, got \['pad'\] more than once"):
        HandLayout.from_rows([ROWS[0], ROWS[1], ROWS[0]])


def test_an_unknown_kind_is_refused():
    with pytest.raises(ValueError, match=r"channel 'pad': kind must be .*'SG', 'PVDF'.*got 'FSR'"):
        HandLayout.from_rows([ROWS[0] | {"kind": "FSR"}])


@pytest.mark.parametrize("row", [{"name": "pad", "kind": "SG"}, ROWS[0] | {"gain": "2"}])
def test_a_row_with_other_keys_is_refused_with_its_number(row):
    with pytest.raises(ValueError, match="channel row 2: expected name, kind, finger, segment"):
        HandLayout.from_rows([ROWS[1], row])
