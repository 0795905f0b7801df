import pytest
import torch

from tactslip_torch import Recording
from tactslip_torch.data.recording import RecordingId


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
        ({"samples": torch.zeros(1, 3, 500)}, r"samples must be \[C, T\], got"),
        ({"sample_rate_hz": 0.0}, "sample_rate_hz must be positive"),
        ({"sample_rate_hz": float("nan")}, "sample_rate_hz must be positive"),
        ({"speeds_mm_s": (20.0,)}, r"as many speeds as onsets.*got \[.*1.*\]"),
        ({"onsets_s": (0.05,)}, r"as many speeds as onsets.*got \[.*1.*\]"),
        ({"sliding_s": ((0.05, 0.1),)}, r"as many speeds as onsets.*got \[.*1.*\]"),
        ({"released_s": ((0.04, 0.06),)}, "empty or one of each of 2 onsets, got 1"),
        ({"released_s": ((0.04, 0.06), (0.16, 0.2))}, r"at 0\.15 s must .* releases, 0\.16-0\.2 s"),
        ({"released_s": ((0.04, 0.06), (0.14, float("nan")))}, r"at 0\.15 s must lie between"),
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
