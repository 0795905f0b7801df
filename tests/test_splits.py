"""Who is trained on and who is not: every split, its folds, and what it refuses."""

import math

import pytest
import torch

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import (
    Split,
    confound,
    evaluated_once,
    have_same_bins,
    leave_one_material_out,
    leave_one_session_out,
    random_bins,
    seen6,
    unseen4,
)

SEEN = ["M1", "M2", "M3"]
UNSEEN = ["iron", "wood"]
ALL = [*SEEN, *UNSEEN]


def recordings(materials=ALL, cycles=28, scenes=("paper",)):
    return [
        RecordingId(material, cycle, scene)
        for scene in scenes
        for material in materials
        for cycle in range(cycles)
    ]


def with_others():
    """Ten cycles of the paper's scene, the first six of them in two others as well."""
    return recordings(cycles=10) + recordings(cycles=6, scenes=("taps", "carried"))


def of_role(split, role, material=None):
    return {r for r, own in split.roles.items() if own == role and material in (None, r.material)}


def drawn(whole=None, **changes):
    return unseen4(whole or recordings(), **({"seen": SEEN, "unseen": UNSEEN} | changes))[0]


# By cycle ------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [drawn, lambda **o: random_bins(recordings(), seen=SEEN, **o)[0]])
def test_the_seed_of_a_split_decides_who_is_drawn(make):
    def drawn_by(split):
        masks = [split.bin_roles(r, 50)["test"].tolist() for r in split.having("train", "test")]
        return split.roles, masks

    assert drawn_by(make(seed=1)) == drawn_by(make(seed=1))
    assert drawn_by(make(seed=1)) != drawn_by(make(seed=2))


def test_each_session_is_drawn_by_itself():
    """Its draw is the same without the others, and not theirs."""
    whole = [
        RecordingId("M1", cycle, session=session)
        for session in ("1", "2", "3")
        for cycle in range(20)
    ]
    tested = {}
    for session in ("1", "2", "3"):
        alone = [r for r in whole if r.session == session]
        of_all, own = (seen6(each, seen=["M1"], seed=4)[0] for each in (whole, alone))
        tested[session] = {r.cycle for r in of_role(of_all, "test") if r.session == session}
        assert tested[session] == {r.cycle for r in of_role(own, "test")}
    assert tested["1"] != tested["2"] != tested["3"]


def test_unseen4_stratifies_by_material_and_gives_every_recording_one_role():
    split = drawn()
    for material in SEEN:
        counts = [len(of_role(split, role, material)) for role in ("train", "test", "unseen")]
        assert counts == [22, 6, 0]
    for material in UNSEEN:
        assert len(of_role(split, "unseen", material)) == 28
    assert set(split.roles) == set(recordings())
    for recording, role in split.roles.items():  # never divided
        masks = split.bin_roles(recording, 7)
        assert {name: int(mask.sum()) for name, mask in masks.items() if mask.any()} == {role: 7}
    both = split.having("train", "test")
    assert both == sorted(recordings(SEEN))
    assert split.having("unseen") == sorted(recordings(UNSEEN))
    only_seen = seen6(recordings(), seen=SEEN)[0]
    assert only_seen.name == "seen6"
    assert only_seen.roles == {r: role for r, role in split.roles.items() if role != "unseen"}
    few = drawn(seen=["M1"], unseen=["wood"])
    assert {r.material for r in few.roles} == {"M1", "wood"}
    masks = few.bin_roles(RecordingId("M2", 0), 5)  # of no side
    assert not any(bool(mask.any()) for mask in masks.values())


# Scenes --------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(2))
def test_a_cycle_is_on_one_side_in_all_its_scenes_and_every_scene_has_its_share(seed):
    tapped = drawn(recordings(scenes=("taps",)), seed=seed).roles
    plain = drawn(seed=seed).roles
    assert tapped == {RecordingId(r.material, r.cycle, "taps"): role for r, role in plain.items()}
    split = drawn(with_others(), seed=seed)
    for folds in ([split], leave_one_material_out(with_others(), materials=SEEN, seed=seed)):
        for fold in folds:
            sides = {}
            for recording, role in fold.roles.items():
                sides.setdefault((recording.material, recording.cycle), set()).add(role)
            assert all(len(roles) == 1 for roles in sides.values())
    for scene, *expected in (("paper", 5 + 3, 1 + 1), ("taps", 5, 1), ("carried", 5, 1)):
        for material in SEEN:
            roles = [of_role(split, role, material) for role in ("train", "test")]
            assert [sum(r.scene == scene for r in own) for own in roles] == expected


def confounded(**changes):
    whole = {"recordings": with_others(), "seen": SEEN, "unseen": UNSEEN}
    return confound(**(whole | {"trained_scenes": ["carried"]} | changes))


# By bin --------------------------------------------------------------------------------------


def test_random_bins_sends_bins_of_every_recording_to_both_sides():
    split = random_bins(recordings(), seen=SEEN)[0]
    assert split.having("train") == split.having("test") == sorted(recordings(SEEN))
    assert split.having("unseen") == []
    num_test = 0
    for recording in split.roles:
        masks = split.bin_roles(recording, 243)
        assert [bool(masks[role].any()) for role in ("train", "test", "unseen")] == [1, 1, 0]
        assert torch.equal(masks["train"], ~masks["test"])
        num_test += int(masks["test"].sum())
    total = 84 * 243
    assert abs(num_test - 0.2 * total) < 5 * math.sqrt(total * 0.2 * 0.8)  # five sigma
    a, b = RecordingId("M1", 0), RecordingId("M2", 0)
    other = random_bins(recordings(), seen=SEEN, seed=1)[0]
    masks = [one.bin_roles(r, 243)["test"] for one, r in ((split, a), (split, b), (other, a))]
    assert not any(torch.equal(masks[0], mask) for mask in masks[1:])
    assert torch.equal(masks[0], split.bin_roles(a, 243)["test"])


# One material or session out -------------------------------------------------------------------


def test_one_fold_for_every_material():
    folds = leave_one_material_out(recordings(), materials=ALL)
    assert [fold.name for fold in folds] == [f"without_{material}" for material in ALL]
    for fold, left_out in zip(folds, ALL, strict=True):
        assert of_role(fold, "unseen") == set(recordings([left_out]))
        for material in ALL:
            assert len(of_role(fold, "train", material)) == (0 if material == left_out else 22)
    tests = [of_role(fold, "test", "M2") for fold in folds if "M2" not in fold.name]
    assert all(test == tests[0] for test in tests)
    mixed = recordings(["iron", "M2", "M1"])
    named = leave_one_material_out(mixed, materials=["iron", "M2", "M1"])
    assert leave_one_material_out(mixed, materials=None) == named


# Folds together ------------------------------------------------------------------------------


@pytest.mark.parametrize("is_compared", [True, False])
def test_one_detector_meets_a_recording_once_in_each_role(is_compared):
    folds = confounded() if is_compared else leave_one_material_out(recordings(), materials=ALL)
    assert have_same_bins(folds) == is_compared
    assert have_same_bins([*folds, Split("again", folds[1].roles)])
    kept = evaluated_once(folds)
    pairs = [pair for fold in kept for pair in fold.roles.items()]
    assert len(pairs) == len(set(pairs)) < sum(len(fold.roles) for fold in folds)
    assert set(pairs) == {pair for fold in folds for pair in fold.roles.items()}
    assert evaluated_once([*folds, folds[0]]) == kept  # nothing is left of the last one
    by_bin = random_bins(recordings(), seen=SEEN) * 2
    assert evaluated_once(by_bin) == by_bin  # their draws hang on all of their recordings


# Errors --------------------------------------------------------------------------------------


def left_out(whole=None, **options):
    return leave_one_material_out(whole or recordings(), **options)


SET, TAPS = {"recordings": recordings()}, recordings(cycles=3, scenes=("taps",))
KNOWN = r"no recording of material 'M9'; the set has M1, M2, M3, iron, wood"


REFUSED = [
    (drawn, {"unseen": ["M9"]}, KNOWN),
    (left_out, {"materials": ["M1", "M9"]}, KNOWN),
    (drawn, {"unseen": ["wood", "M3", "M2"]}, "materials M2, M3 are both seen and unseen"),
    (drawn, {"seen": []}, "split unseen4: no recording has the role 'train'"),
    (drawn, {"unseen": []}, "split unseen4: no recording has the role 'unseen'"),
    (drawn, {"whole": recordings(cycles=1)}, "no recording has the role 'test'"),
    *((drawn, {"train_fraction": s}, "must lie between 0 and 1") for s in (0.0, 1.0, math.nan)),
    (left_out, {"train_fraction": 1.5}, r"train_fraction must lie between 0 and 1, got 1\.5"),
    (left_out, {"materials": ["M1"]}, r"at least two, each named once, got \['M1'\]"),
    (left_out, {"materials": ["M1", "M1", "M2"]}, "at least two, each named once"),
    (left_out, {"whole": recordings(["M1"])}, r"at least two, .* got \['M1'\]"),
    (seen6, {"recordings": [], "seen": ["M1"]}, "the set has none"),
    (random_bins, SET | {"seen": []}, "split random_bins: no recording has the role 'train'"),
    (random_bins, SET | {"seen": SEEN, "train_fraction": 1.5}, r"train_fraction must lie betw"),
    (leave_one_session_out, SET | {"seen": SEEN}, r"at least two, got 1; .*data\.sessions=2"),
    (confounded, {"trained_scenes": []}, r"must name a scene .* got \[\]; the set has paper"),
    (confounded, {"trained_scenes": ["paper"]}, r"must name a scene beside the paper's"),
    (confounded, {"trained_scenes": ["taps", "wet"]}, "scene wet; the set has paper, taps"),
    (confounded, {"recordings": TAPS}, "of scene paper, carried; the set has taps: add them"),
]


@pytest.mark.parametrize(("make", "options", "said"), REFUSED)
def test_what_cannot_be_split_is_said(make, options, said):
    with pytest.raises(ValueError, match=said):
        make(**options)
