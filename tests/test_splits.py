import math

import pytest
import torch

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import (
    Split,
    are_rivals,
    confound,
    judged_once,
    leave_one_material_out,
    leave_one_session_out,
    random_bins,
    seen6,
    unseen4,
)

SEEN = ["M1", "M2", "M3"]
UNSEEN = ["iron", "wood"]


def recordings(materials=(*SEEN, *UNSEEN), cycles=28):
    return [RecordingId(material, cycle) for material in materials for cycle in range(cycles)]


def of_role(split, role, material=None):
    return {r for r, own in split.roles.items() if own == role and material in (None, r.material)}


def drawn(**changes):
    return unseen4(recordings(), **({"seen": SEEN, "unseen": UNSEEN} | changes))[0]


# By cycle ------------------------------------------------------------------------------------


def test_unseen4_stratifies_by_material():
    split = drawn()
    for material in SEEN:
        assert len(of_role(split, "train", material)) == 22
        assert len(of_role(split, "test", material)) == 6
        assert not of_role(split, "unseen", material)
    for material in UNSEEN:
        assert len(of_role(split, "unseen", material)) == 28


def test_every_recording_has_one_role():
    split = drawn()
    assert set(split.roles) == set(recordings())
    having = [split.having(role) for role in ("train", "test", "unseen")]
    assert sum(len(part) for part in having) == len(set().union(*having)) == 5 * 28


def test_having_is_sorted_and_takes_several_roles():
    split = drawn()
    both = split.having("train", "test")
    assert both == sorted(both)
    assert {r.material for r in both} == set(SEEN)
    assert len(both) == 3 * 28


def test_materials_of_no_side_are_not_used():
    split = drawn(seen=["M1"], unseen=["wood"])
    assert {r.material for r in split.roles} == {"M1", "wood"}
    masks = split.bin_roles(RecordingId("M2", 0), 5)
    assert not any(bool(mask.any()) for mask in masks.values())


def test_the_draw_depends_on_the_seed_alone():
    assert drawn(seed=4).roles == drawn(seed=4).roles
    assert drawn(seed=4).roles != drawn(seed=5).roles
    shuffled = list(reversed(recordings()))
    assert unseen4(shuffled, seen=SEEN, unseen=UNSEEN, seed=4)[0].roles == drawn(seed=4).roles


def test_materials_draw_on_their_own():
    """Another material more, less, or in another place does not move a cycle."""
    for seen in (["M2"], ["M2", "M1"], ["M3", "M2"]):
        split = drawn(seen=seen)
        assert of_role(split, "test", "M2") == of_role(drawn(), "test", "M2")
    cycles = [sorted(r.cycle for r in of_role(drawn(), "test", m)) for m in SEEN]
    assert cycles[0] != cycles[1] or cycles[1] != cycles[2]


def test_the_draw_does_not_follow_the_order_of_cycles():
    """Wear and session drift go with the cycle's number: the last six must not be the test."""
    tests = [sorted(r.cycle for r in of_role(drawn(seed=s), "test", "M1")) for s in range(5)]
    assert all(cycles not in (list(range(6)), list(range(22, 28))) for cycles in tests)
    assert len({tuple(cycles) for cycles in tests}) == 5


@pytest.mark.parametrize(
    ("cycles", "share", "num_train"), [(2, 0.99, 1), (2, 0.01, 1), (5, 0.8, 4)]
)
def test_both_sides_have_a_cycle_if_there_are_two(cycles, share, num_train):
    split = seen6(recordings(cycles=cycles), seen=SEEN, train_share=share)[0]
    for material in SEEN:
        assert len(of_role(split, "train", material)) == num_train
        assert len(of_role(split, "test", material)) == cycles - num_train


def test_seen6_is_unseen4_without_the_unseen():
    split = seen6(recordings(), seen=SEEN)[0]
    assert split.name == "seen6"
    assert split.roles == {r: role for r, role in drawn().roles.items() if role != "unseen"}


def test_grouped_splits_never_divide_a_recording():
    folds = [drawn(), seen6(recordings(), seen=SEEN)[0]]
    folds += leave_one_material_out(recordings(), materials=SEEN)
    for split in folds:
        for recording, role in split.roles.items():
            masks = split.bin_roles(recording, 7)
            assert bool(masks[role].all())
            assert sum(int(mask.sum()) for mask in masks.values()) == 7


# By cycle, of several scenes --------------------------------------------------------------------


def with_others(kinds=("taps", "carried"), cycles=10, others=6):
    paper = recordings(cycles=cycles)
    return paper + [
        RecordingId(r.material, r.cycle, k) for k in kinds for r in paper if r.cycle < others
    ]


@pytest.mark.parametrize("make", [unseen4, seen6])
def test_a_set_of_another_scene_is_split_as_the_papers_is(make):
    materials = {"seen": SEEN} | ({"unseen": UNSEEN} if make is unseen4 else {})
    tapped = [RecordingId(r.material, r.cycle, "taps") for r in recordings()]
    for seed in (0, 1):
        plain = make(recordings(), **materials, seed=seed)[0].roles
        roles = make(tapped, **materials, seed=seed)[0].roles
        assert roles == {RecordingId(r.material, r.cycle, "taps"): plain[r] for r in plain}


@pytest.mark.parametrize("seed", range(4))
def test_a_cycle_is_on_one_side_in_all_its_scenes(seed):
    whole = with_others()
    for split in (
        *unseen4(whole, seen=SEEN, unseen=UNSEEN, seed=seed),
        *seen6(whole, seen=SEEN, seed=seed),
        *leave_one_material_out(whole, materials=SEEN, seed=seed),
    ):
        sides = {}
        for recording, role in split.roles.items():
            sides.setdefault((recording.material, recording.cycle), set()).add(role)
        assert all(len(roles) == 1 for roles in sides.values())


@pytest.mark.parametrize("seed", range(4))
def test_every_scene_has_its_share_of_both_sides(seed):
    split = unseen4(with_others(), seen=SEEN, unseen=UNSEEN, seed=seed)[0]
    for scene, num_train, num_test in (("paper", 5 + 3, 1 + 1), ("taps", 5, 1), ("carried", 5, 1)):
        for material in SEEN:
            counts = [
                sum(r.scene == scene for r in of_role(split, role, material))
                for role in ("train", "test")
            ]
            assert counts == [num_train, num_test]


# The confounded protocol -------------------------------------------------------------------------


def both(**changes):
    whole = {"recordings": with_others(), "seen": SEEN, "unseen": UNSEEN}
    return confound(**(whole | {"trained_scenes": ["carried"]} | changes))


def test_the_folds_of_confound_are_judged_on_the_same_recordings():
    protocol, with_scenes = both()
    assert [protocol.name, with_scenes.name] == ["protocol", "with_scenes"]
    grouped = unseen4(with_others(), seen=SEEN, unseen=UNSEEN)[0]
    for role in ("test", "unseen"):
        assert of_role(protocol, role) == of_role(with_scenes, role) == of_role(grouped, role)
        assert {r.scene for r in of_role(protocol, role)} == {"paper", "taps", "carried"}


def test_the_folds_of_confound_differ_in_the_scenes_trained_on():
    protocol, with_scenes = both()
    trained, more = of_role(protocol, "train"), of_role(with_scenes, "train")
    assert {r.scene for r in trained} == {"paper"}
    assert {r.scene for r in more} == {"paper", "carried"}
    assert {r for r in more if r.scene == "paper"} == trained
    cycles = {(r.material, r.cycle) for r in trained}
    assert {(r.material, r.cycle) for r in more if r.scene == "carried"} <= cycles
    judged = {(r.material, r.cycle) for r in with_scenes.having("test", "unseen")}
    assert not judged & {(r.material, r.cycle) for r in more}


def test_what_confound_trains_on_can_be_chosen():
    _, with_scenes = both(trained_scenes=["taps", "carried", "paper"])
    assert {r.scene for r in of_role(with_scenes, "train")} == {"paper", "taps", "carried"}
    assert both(seed=1)[0].roles == both(seed=1)[0].roles != both(seed=2)[0].roles


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        (
            {"trained_scenes": []},
            r"trained_scenes must name a scene .* got \[\]; the set has paper",
        ),
        ({"trained_scenes": ["paper"]}, r"trained_scenes must name a scene beside the paper's"),
        (
            {"trained_scenes": ["taps", "wet"]},
            "needs recordings of scene wet; the set has paper, taps",
        ),
        (
            {"recordings": [RecordingId(m, c, "taps") for m in SEEN + UNSEEN for c in range(3)]},
            "needs recordings of scene paper, carried; the set has taps: add them, as others=",
        ),
        ({"unseen": []}, "no recording has the role 'unseen'"),
        ({"seen": ["M9"]}, "no recording of material 'M9'"),
    ],
)
def test_confound_says_what_it_lacks(changes, line):
    with pytest.raises(ValueError, match=line):
        both(**changes)


# By bin --------------------------------------------------------------------------------------


def test_random_bins_sends_bins_of_every_recording_to_both_sides():
    split = random_bins(recordings(), seen=SEEN)[0]
    assert {r.material for r in split.roles} == set(SEEN)
    num_test = 0
    for recording in split.roles:
        masks = split.bin_roles(recording, 243)
        assert bool(masks["train"].any())
        assert bool(masks["test"].any())
        assert not bool((masks["train"] & masks["test"]).any())
        assert bool((masks["train"] | masks["test"]).all())
        assert not bool(masks["unseen"].any())
        num_test += int(masks["test"].sum())
    total = 84 * 243
    assert abs(num_test - 0.2 * total) < 5 * math.sqrt(total * 0.2 * 0.8)  # five sigma


def test_random_bins_draws_anew_for_every_recording_and_seed():
    def mask(seed, recording):
        return random_bins(recordings(), seen=SEEN, seed=seed)[0].bin_roles(recording, 243)["test"]

    a, b = RecordingId("M1", 0), RecordingId("M2", 0)
    assert torch.equal(mask(1, a), mask(1, a))
    assert not torch.equal(mask(1, a), mask(1, b))
    assert not torch.equal(mask(1, a), mask(2, a))


def test_recordings_of_random_bins_are_in_both_loaders():
    split = random_bins(recordings(), seen=SEEN)[0]
    assert split.having("train") == split.having("test") == sorted(recordings(SEEN))
    assert split.having("unseen") == []


# One material out ----------------------------------------------------------------------------


def test_one_fold_for_every_material():
    materials = [*SEEN, *UNSEEN]
    folds = leave_one_material_out(recordings(), materials=materials)
    assert [fold.name for fold in folds] == [f"without_{material}" for material in materials]
    for fold, left_out in zip(folds, materials, strict=True):
        assert of_role(fold, "unseen") == set(recordings([left_out]))
        others = [material for material in materials if material != left_out]
        assert {r.material for r in fold.having("train", "test")} == set(others)
        for material in others:
            assert len(of_role(fold, "train", material)) == 22


def test_folds_keep_a_materials_draw():
    folds = leave_one_material_out(recordings(), materials=[*SEEN, *UNSEEN])
    tests = [of_role(fold, "test", "M2") for fold in folds if "M2" not in fold.name]
    assert len(tests) == 4
    assert all(test == tests[0] for test in tests)


def test_all_materials_of_the_set_where_none_are_named():
    mixed = recordings(["iron", "M2", "M1"])
    folds = leave_one_material_out(mixed, materials=None)
    assert [fold.name for fold in folds] == ["without_iron", "without_M2", "without_M1"]
    named = leave_one_material_out(mixed, materials=["iron", "M2", "M1"])
    assert [fold.roles for fold in folds] == [fold.roles for fold in named]


def test_all_of_the_others_can_be_trained_on():
    """Small sets have no cycle to spare, and are judged on what was left out alone."""
    one_each = recordings(SEEN, cycles=1)
    for whole in (one_each, recordings(SEEN)):
        for fold, left_out in zip(leave_one_material_out(whole, train_share=1), SEEN, strict=True):
            assert of_role(fold, "unseen") == {r for r in whole if r.material == left_out}
            assert of_role(fold, "train") == {r for r in whole if r.material != left_out}
            assert fold.having("test") == []
    with pytest.raises(ValueError, match="no recording has the role 'test'"):
        leave_one_material_out(one_each)


# Folds together ------------------------------------------------------------------------------


def several_scenes():
    kinds = ("paper", "taps", "pulled")
    whole = [RecordingId(r.material, r.cycle, k) for r in recordings(cycles=4) for k in kinds]
    return confound(whole, seen=SEEN, unseen=UNSEEN, trained_scenes=["pulled"])


def test_rivals_hold_out_the_same_recordings():
    rest = leave_one_material_out(recordings(), materials=[*SEEN, *UNSEEN])
    assert are_rivals(several_scenes())
    assert are_rivals([*rest, Split("again", rest[1].roles)])
    assert not are_rivals(rest)
    assert not are_rivals([drawn()])


@pytest.mark.parametrize("rivals", [True, False])
def test_one_detector_meets_a_recording_once_in_each_role(rivals):
    plain = leave_one_material_out(recordings(), materials=[*SEEN, *UNSEEN])
    folds = several_scenes() if rivals else plain
    kept = judged_once(folds)
    pairs = [pair for fold in kept for pair in fold.roles.items()]
    assert len(pairs) == len(set(pairs)) < sum(len(fold.roles) for fold in folds)
    assert set(pairs) == {pair for fold in folds for pair in fold.roles.items()}
    assert judged_once([*folds, folds[0]]) == kept  # nothing is left of the last one


def test_folds_by_bin_keep_their_draws():
    folds = random_bins(recordings(), seen=SEEN) * 2
    assert judged_once(folds) == folds


# Errors --------------------------------------------------------------------------------------


def test_an_unknown_material_is_named_with_those_there_are():
    known = r"no recording of material 'M9'; the set has M1, M2, M3, iron, wood"
    for make in (
        lambda: drawn(seen=["M1", "M9"]),
        lambda: drawn(unseen=["M9"]),
        lambda: seen6(recordings(), seen=["M9"]),
        lambda: random_bins(recordings(), seen=["M9"]),
        lambda: leave_one_material_out(recordings(), materials=["M1", "M9"]),
    ):
        with pytest.raises(ValueError, match=known):
            make()
    with pytest.raises(ValueError, match="the set has none"):
        seen6([], seen=["M1"])


def test_a_material_on_both_sides_is_refused():
    with pytest.raises(ValueError, match="materials M2, M3 are both seen and unseen"):
        drawn(unseen=["wood", "M3", "M2"])


@pytest.mark.parametrize(
    ("changes", "role"),
    [({"seen": []}, "train"), ({"unseen": []}, "unseen")],
)
def test_an_empty_role_is_named(changes, role):
    with pytest.raises(ValueError, match=f"split unseen4: no recording has the role '{role}'"):
        drawn(**changes)


def test_one_cycle_leaves_no_test():
    with pytest.raises(ValueError, match="split seen6: no recording has the role 'test'"):
        seen6(recordings(cycles=1), seen=SEEN)
    with pytest.raises(ValueError, match="split random_bins: no recording has the role 'train'"):
        random_bins(recordings(), seen=[])


@pytest.mark.parametrize("share", [0.0, 1.0, -0.1, 1.5, float("nan")])
def test_a_share_outside_zero_to_one_is_refused(share):
    for make in (
        lambda: drawn(train_share=share),
        lambda: random_bins(recordings(), seen=SEEN, train_share=share),
    ):
        with pytest.raises(ValueError, match=r"split\.train_share must lie between 0 and 1"):
            make()


def test_one_material_cannot_be_left_out():
    for materials in (["M1"], ["M1", "M1"]):
        with pytest.raises(ValueError, match=r"needs at least two, each named once, got \['M1'"):
            leave_one_material_out(recordings(), materials=materials)
    with pytest.raises(
        ValueError, match=r"needs at least two, each named once, got \['M1', 'M1', 'M2'\]"
    ):
        leave_one_material_out(recordings(), materials=["M1", "M1", "M2"])
    with pytest.raises(ValueError, match=r"needs at least two, each named once, got \['M1'\]"):
        leave_one_material_out(recordings(["M1"]), materials=None)
    with pytest.raises(ValueError, match=r"train_share must lie between 0 and 1, got 1\.5"):
        leave_one_material_out(recordings(), train_share=1.5)


def test_a_split_without_shares_ignores_the_seed():
    recording = RecordingId("M1", 0)
    masks = [Split("s", {recording: "train"}, seed=s).bin_roles(recording, 9) for s in (0, 1)]
    assert all(bool(mask["train"].all()) for mask in masks)


# By session ----------------------------------------------------------------------------------


def mounted(sessions=("", "2", "3"), cycles=10, materials=SEEN):
    return [
        RecordingId(r.material, r.cycle, session=s)
        for s in sessions
        for r in recordings(materials, cycles)
    ]


def test_cycles_of_a_session_are_drawn_on_their_own():
    one = seen6(recordings(SEEN, 10), seen=SEEN)[0]
    three = seen6(mounted(), seen=SEEN)[0]
    assert {r: role for r, role in three.roles.items() if not r.session} == one.roles
    tests = {
        (m, s): frozenset(r.cycle for r in of_role(three, "test", m) if r.session == s)
        for m in SEEN
        for s in ("", "2", "3")
    }
    assert {len(cycles) for cycles in tests.values()} == {2}
    assert len(set(tests.values())) > 3  # not the same cycles in every session
    fewer = seen6(mounted(("2",)), seen=SEEN)[0]
    assert fewer.roles == {r: role for r, role in three.roles.items() if r.session == "2"}


def test_one_fold_for_every_session():
    folds = leave_one_session_out(mounted(), seen=SEEN)
    assert [fold.name for fold in folds] == [f"without_session_{n}" for n in (1, 2, 3)]
    for fold, left_out in zip(folds, ("", "2", "3"), strict=True):
        assert of_role(fold, "unseen") == {r for r in mounted() if r.session == left_out}
        assert {r.session for r in fold.having("train", "test")} == {"", "2", "3"} - {left_out}
        assert len(fold.having("train")) == 2 * len(SEEN) * 8
    assert not are_rivals(folds)


def test_the_first_session_can_be_trained_on_alone():
    alone, *rest = leave_one_session_out(mounted(), seen=SEEN, first_alone=True)
    assert alone.name == "session_1_alone"
    assert {r.session for r in alone.having("train", "test")} == {""}
    assert of_role(alone, "unseen") == {r for r in mounted() if r.session}
    assert rest == leave_one_session_out(mounted(), seen=SEEN)
    assert are_rivals([alone, *rest])  # what is unseen in both is not summed


def test_a_material_of_the_left_out_session_alone_is_no_second_session():
    extra = [*mounted(("", "2")), *mounted(("2",), materials=["wood"])]
    without_1, without_2 = leave_one_session_out(extra, seen=[*SEEN, "wood"])
    assert {r.material for r in of_role(without_2, "unseen")} == set(SEEN)
    assert {r.material for r in of_role(without_1, "train")} == {*SEEN, "wood"}


def test_one_session_cannot_be_left_out():
    with pytest.raises(ValueError, match=r"needs at least two, got 1; .*data\.sessions=2"):
        leave_one_session_out(recordings(SEEN), seen=SEEN)
