"""Splits of recordings into training, test and held-out ones.

The default groups by cycle, stratified by material; the authors' split, random over bins, shows
what that leaks.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import torch
from torch import Tensor

from tactslip_torch.data.recording import PAPER_SCENE, RecordingId
from tactslip_torch.runtime import check_choice, check_number, check_share

GroupBy = Literal["material", "session", "recording"]
ROLES = ("train", "test", "unseen")


@dataclass(frozen=True)
class Split:
    """Roles of recordings, or of their bins.

    Args:
        name: of the split or fold, for folders and tables.
        roles: recording to ``"train"``, ``"test"`` or ``"unseen"``; others are not used.
        test_fraction: if given, bins of ``train`` recordings are sent to ``test`` at
            random with this fraction (``random_bins``).
        seed: of that draw.
    """

    name: str
    roles: Mapping[RecordingId, str]
    test_fraction: float | None = None
    seed: int = 0

    def bin_roles(self, recording: RecordingId, num_bins: int) -> dict[str, Tensor]:
        """For each role, which bins of a recording have it: ``[num_bins]``, bool."""
        role = self.roles.get(recording)
        masks = {name: torch.full((num_bins,), name == role) for name in ROLES}
        if role == "train" and self.test_fraction is not None:
            place = sorted(self.roles).index(recording)
            generator = torch.Generator().manual_seed(self.seed * 1_000_003 + place)
            to_test = torch.rand(num_bins, generator=generator) < self.test_fraction
            masks["train"], masks["test"] = ~to_test, to_test
        return masks

    def having(self, *roles: str) -> list[RecordingId]:
        """Recordings with any of the roles, sorted; those split by bin have train and test."""
        wanted = set(roles)
        if self.test_fraction is not None and "test" in wanted:
            wanted.add("train")
        return sorted(recording for recording, role in self.roles.items() if role in wanted)


def unseen4(
    recordings: Sequence[RecordingId],
    *,
    seen: Sequence[str],
    unseen: Sequence[str],
    train_fraction: float = 0.8,
    seed: int = 0,
) -> list[Split]:
    """Train and test on cycles of the seen materials, evaluate on all cycles of the unseen ones.

    Raises:
        ValueError: if a material is not in the set, is on both sides, or a role stays empty.
    """
    both = sorted(set(seen) & set(unseen))
    if both:
        raise ValueError(f"materials {', '.join(both)} are both seen and unseen; choose one side")
    roles = _by_cycle(recordings, seen, train_fraction, seed)
    for material in unseen:
        roles |= dict.fromkeys(_cycles_of(recordings, material), "unseen")
    return [_checked(Split("unseen4", roles), ("train", "test", "unseen"))]


def seen6(
    recordings: Sequence[RecordingId],
    *,
    seen: Sequence[str],
    train_fraction: float = 0.8,
    seed: int = 0,
) -> list[Split]:
    """Train and test on cycles of the seen materials only.

    Raises:
        ValueError: if a material is not in the set or a role stays empty.
    """
    roles = _by_cycle(recordings, seen, train_fraction, seed)
    return [_checked(Split("seen6", roles), ("train", "test"))]


def random_bins(
    recordings: Sequence[RecordingId],
    *,
    seen: Sequence[str],
    train_fraction: float = 0.8,
    seed: int = 0,
) -> list[Split]:
    """The authors' split: bins of the seen materials at random, which leaks.

    Neighbouring bins of one slide are on both sides, so its test score says little about
    recordings that were never seen; the difference to ``seen6`` is the leak.

    Raises:
        ValueError: if a material is not in the set or the fraction is not in (0, 1).
    """
    check_share("split.train_fraction", train_fraction)
    roles = {
        recording: "train" for material in seen for recording in _cycles_of(recordings, material)
    }
    return [_checked(Split("random_bins", roles, 1 - train_fraction, seed), ("train",))]


def leave_one_material_out(
    recordings: Sequence[RecordingId],
    *,
    materials: Sequence[str] | None = None,
    train_fraction: float = 0.8,
    seed: int = 0,
) -> list[Split]:
    """One fold per material: train and test on the others' cycles, evaluate on its own.

    Args:
        recordings: of the set.
        materials: to leave out and train on; ``None`` for all of the set, in its order.
        train_fraction: of the others' cycles; 1 trains on all of them, and no role is ``test``.
        seed: of the draw.

    Raises:
        ValueError: if a material is not in the set or named twice, there are fewer than two, or a
            role stays empty.
    """
    if materials is None:
        materials = list(dict.fromkeys(recording.material for recording in recordings))
    if len(set(materials)) < max(2, len(materials)):
        raise ValueError(
            f"leaving one material out needs at least two, each named once, got {list(materials)}"
        )
    folds = []
    for left_out in materials:
        others = [material for material in materials if material != left_out]
        if train_fraction == 1:
            roles = {r: "train" for material in others for r in _cycles_of(recordings, material)}
            roles |= dict.fromkeys(_cycles_of(recordings, left_out), "unseen")
        else:
            sides = {"seen": others, "unseen": [left_out]}
            roles = dict(
                unseen4(recordings, **sides, train_fraction=train_fraction, seed=seed)[0].roles
            )
        folds.append(Split(f"without_{left_out}", roles))
    return folds


def leave_groups_out(
    recordings: Sequence[RecordingId], *, by: GroupBy | None = None, folds: int = 10
) -> list[Split]:
    """Each group left out once, the others train; of many groups several are left out together.

    Args:
        recordings: of the set.
        by: what a group is: a ``"material"`` (an object), a ``"session"``, or a ``"recording"``.
            ``None``: the material where there are three or more, else the recording.
        folds: so many at most. Groups are dealt out so that folds have about as many recordings.

    Returns:
        Folds in which what is left out is ``unseen``; single recordings, of whose group others
        train, are ``test``.

    Raises:
        ValueError: if there are not two groups, or ``by`` or ``folds`` cannot be.
    """
    check_choice("split.by", by, (*get_args(GroupBy), None))
    check_number("split.folds", folds, least=2, whole=True)
    if by is None:
        by = "material" if len({r.material for r in recordings}) > 2 else "recording"
    role = "test" if by == "recording" else "unseen"
    groups: dict[str, list[RecordingId]] = {}
    for recording in sorted(recordings):
        name = str(recording) if by == "recording" else str(getattr(recording, by) or 1)
        groups.setdefault(name, []).append(recording)
    if len(groups) < 2:
        raise ValueError(
            f"split.by={by} leaves groups out and needs two, got {len(groups)} "
            f"({', '.join(groups)}); give split.by={'session' if by == 'material' else 'material'} "
            "or split.by=recording, or add recordings of another"
        )
    left_out: list[dict[str, list[RecordingId]]] = [{} for _ in range(min(folds, len(groups)))]
    for name, members in sorted(groups.items(), key=lambda group: -len(group[1])):
        emptiest = min(left_out, key=lambda fold: sum(map(len, fold.values())))
        emptiest[name] = members
    splits = []
    for number, fold in enumerate(left_out, 1):
        away = {recording for members in fold.values() for recording in members}
        roles = {r: role if r in away else "train" for r in sorted(recordings)}
        is_one = len(fold) == 1 and by != "recording"  # whose names have strokes
        splits.append(Split(f"without_{next(iter(fold))}" if is_one else f"fold_{number}", roles))
    return splits


def everything(recordings: Sequence[RecordingId], *, role: str = "test") -> list[Split]:
    """One fold in which every recording has the same role.

    Raises:
        ValueError: if there is no such role.
    """
    check_choice("split.role", role, ROLES)
    return [Split("all", dict.fromkeys(sorted(recordings), role))]


def confound(
    recordings: Sequence[RecordingId],
    *,
    seen: Sequence[str],
    unseen: Sequence[str],
    trained_scenes: Sequence[str],
    train_fraction: float = 0.8,
    seed: int = 0,
) -> list[Split]:
    """Two folds that differ in the scenes trained on, and are evaluated on the same recordings.

    ``protocol`` trains on the paper's scene alone, ``with_scenes`` on the same cycles of the
    trained scenes as well. Both are evaluated on the test cycles of the seen materials and all
    cycles of the unseen ones, of every scene; training cycles of other scenes are not used.

    Args:
        recordings: of the paper's scene and of others.
        seen: materials to train and test on, by cycle.
        unseen: materials to evaluate on only.
        trained_scenes: kinds of scenes that ``with_scenes`` trains on beside the paper's.
        train_fraction: of the cycles.
        seed: of the draw.

    Raises:
        ValueError: as ``unseen4``; or if the set lacks the paper's scene or a trained one, or no
            scene is to be trained on.
    """
    grouped = unseen4(
        recordings, seen=seen, unseen=unseen, train_fraction=train_fraction, seed=seed
    )[0]
    there = list(dict.fromkeys(recording.scene for recording in recordings))
    added = [scene for scene in trained_scenes if scene != PAPER_SCENE]
    if not added:
        raise ValueError(
            "split.trained_scenes must name a scene beside the paper's to train on, got "
            f"{list(trained_scenes)}; the set has {', '.join(there)}"
        )
    missing = [scene for scene in (PAPER_SCENE, *added) if scene not in there]
    if missing:
        raise ValueError(
            f"split confound needs recordings of scene {', '.join(missing)}; the set has "
            f"{', '.join(there)}: add them, as extra_scenes=confound does"
        )
    folds = []
    for name, scenes in (("protocol", [PAPER_SCENE]), ("with_scenes", [PAPER_SCENE, *added])):
        roles = {
            recording: role
            for recording, role in grouped.roles.items()
            if role != "train" or recording.scene in scenes
        }
        folds.append(_checked(Split(name, roles), ROLES))
    return folds


def have_same_bins(folds: Sequence[Split]) -> bool:
    """Whether any two folds hold out the same recordings, or leave one out that both call unseen.

    Each then evaluates its own detector on the same bins, and a sum over them is neither's score.
    """
    held_out = [tuple(fold.having("test", "unseen")) for fold in folds]
    unseen = [recording for fold in folds for recording in fold.having("unseen")]
    return len(set(held_out)) < len(held_out) or len(set(unseen)) < len(unseen)


def evaluated_once(folds: Sequence[Split]) -> list[Split]:
    """The folds for one and the same detector: each recording once in each of its roles.

    A recording stays in the first fold that gives it the role; folds that lose all are left out.
    Those split by bin keep theirs, since their draws hang on all of their recordings.
    """
    known: set[tuple[RecordingId, str]] = set()
    kept = []
    for fold in folds:
        roles = dict(fold.roles)
        if fold.test_fraction is None:
            roles = {r: role for r, role in roles.items() if (r, role) not in known}
            known |= roles.items()
        if roles:
            kept.append(replace(fold, roles=roles))
    return kept


def _by_cycle(
    recordings: Sequence[RecordingId], materials: Sequence[str], train_fraction: float, seed: int
) -> dict[RecordingId, str]:
    """``train`` and ``test`` drawn within each material and session, at least one cycle each.

    The draw of a session depends on the seed and its place among its own cycles alone, so leaving
    another session or material out does not change it. A cycle is on one side in all its scenes;
    cycles that are there in different scenes are drawn apart, each kind as above, so that each
    scene has its part. A session's only cycle falls by the fraction alone.
    """
    check_share("split.train_fraction", train_fraction)
    roles: dict[RecordingId, str] = {}
    mountings: dict[str, dict[int, list[RecordingId]]] = {}
    for material in materials:
        for recording in _cycles_of(recordings, material):
            mounting = f"{material}@{recording.session}" if recording.session else material
            cycles = mountings.setdefault(mounting, {})
            cycles.setdefault(recording.cycle, []).append(recording)
    for mounting, cycles in mountings.items():
        alike: dict[tuple[str, ...], list[int]] = {}
        for cycle, members in cycles.items():
            alike.setdefault(tuple(member.scene for member in members), []).append(cycle)
        generator = torch.Generator().manual_seed(seed * 1_000_003 + zlib.crc32(mounting.encode()))
        for numbers in alike.values():
            num_train = round(train_fraction * len(numbers))
            if len(numbers) > 1:
                num_train = min(max(num_train, 1), len(numbers) - 1)
            order = torch.randperm(len(numbers), generator=generator).tolist()
            for place, index in enumerate(order):
                role = "train" if place < num_train else "test"
                roles |= dict.fromkeys(cycles[numbers[index]], role)
    return roles


def _cycles_of(recordings: Sequence[RecordingId], material: str) -> list[RecordingId]:
    """The recordings of a material, sorted; an error if there are none."""
    cycles = sorted(recording for recording in recordings if recording.material == material)
    if not cycles:
        known = ", ".join(sorted({recording.material for recording in recordings}))
        raise ValueError(
            f"no recording of material {material!r}; the set has {known or 'none'}; name those in "
            "split.seen and split.unseen, or take split=groups, which needs no names"
        )
    return cycles


def _checked(split: Split, needed: Sequence[str]) -> Split:
    """The split itself; an error if no recording has one of the roles."""
    for role in needed:
        if role not in split.roles.values():
            raise ValueError(
                f"split {split.name}: no recording has the role {role!r}; "
                "use more cycles or another train_fraction"
            )
    return split


def leave_one_session_out(
    recordings: Sequence[RecordingId],
    *,
    seen: Sequence[str],
    first_alone: bool = False,
    train_fraction: float = 0.8,
    seed: int = 0,
) -> list[Split]:
    """One fold per session: train on the others, evaluate the same materials in the one left out.

    ``test`` are held-out cycles of the sessions trained on, ``unseen`` all cycles of the session
    left out, of materials that the others have too.

    Args:
        recordings: of several sessions.
        seen: materials to train on and to evaluate.
        first_alone: put a fold before them that trains on the first session alone and evaluates the
            same materials in all others: what a user gets who trains on one day's recordings.
        train_fraction: of the cycles of each session trained on.
        seed: of the draw.

    Raises:
        ValueError: if the set has one session, a material is not in it, or a role stays empty.
    """
    own = [r for material in seen for r in _cycles_of(recordings, material)]
    sessions = sorted({recording.session for recording in own})
    if len(sessions) < 2:
        raise ValueError(
            f"leaving one session out needs at least two, got {len(sessions)}; simulate more with "
            "data.sessions=2, or name them in the manifest's column session"
        )
    folds = [(f"without_session_{session or 1}", {session}) for session in sessions]
    if first_alone:
        folds.insert(0, (f"session_{sessions[0] or 1}_alone", set(sessions[1:])))
    splits = []
    for name, left_out in folds:
        trained = [recording for recording in own if recording.session not in left_out]
        known = [material for material in seen if material in {r.material for r in trained}]
        roles = _by_cycle(trained, known, train_fraction, seed)
        away = [r for r in own if r.session in left_out and r.material in known]
        splits.append(_checked(Split(name, roles | dict.fromkeys(away, "unseen")), ROLES))
    return splits
