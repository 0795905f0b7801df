"""Sessions left out in turn: is it the material that a detector learned, or the mounting?

A session is another mounting of the same hand and materials: another noise floor, other gains,
offsets and loads. Cycles of one session are no evidence about the next.
"""

from __future__ import annotations

from collections.abc import Sequence

from tactslip_torch.data.recording import RecordingId
from tactslip_torch.data.splits import ROLES, Split, by_cycle, checked, cycles_of


def leave_one_session_out(
    recordings: Sequence[RecordingId],
    *,
    seen: Sequence[str],
    first_alone: bool = False,
    train_share: float = 0.8,
    seed: int = 0,
) -> list[Split]:
    """One fold per session: train on the others, judge the same materials in the one left out.

    ``test`` are held-out cycles of the sessions trained on, ``unseen`` all cycles of the session
    left out, of materials that the others have too.

    Args:
        recordings: of several sessions.
        seen: materials to train on and to judge.
        first_alone: put a fold before them that trains on the first session alone and judges the
            same materials in all others: what a user gets who trains on one day's recordings.
        train_share: of the cycles of each session trained on.
        seed: of the draw.

    Raises:
        ValueError: if the set has one session, a material is not in it, or a role stays empty.
    """
    own = [r for material in seen for r in cycles_of(recordings, material)]
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
        roles = by_cycle(trained, known, train_share, seed)
        away = [r for r in own if r.session in left_out and r.material in known]
        splits.append(checked(Split(name, roles | dict.fromkeys(away, "unseen")), ROLES))
    return splits
