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


def test_duration_is_samples_over_rate():
    assert recording().duration_s == 0.25
    assert recording(sample_rate_hz=500.0).duration_s == 1.0


def test_annotations_default_to_the_exact_onsets():
    assert recording().annotated_onsets_s == (0.05, 0.15)
    assert recording(annotated_onsets_s=(0.06, 0.14)).annotated_onsets_s == (0.06, 0.14)
    assert recording(annotated_onsets_s=(0.06, 0.14)).onsets_s == (0.05, 0.15)


def test_a_recording_without_strokes_is_one():
    rest = recording(speeds_mm_s=(), onsets_s=(), sliding_s=())
    assert rest.annotated_onsets_s == ()


@pytest.mark.parametrize("shape", [(500,), (1, 3, 500)])
def test_samples_of_another_rank_are_refused(shape):
    with pytest.raises(ValueError, match=r"samples must be \[C, T\], got"):
        recording(samples=torch.zeros(shape))


@pytest.mark.parametrize("rate", [0.0, -2000.0, float("nan")])
def test_a_rate_that_is_not_positive_is_refused(rate):
    with pytest.raises(ValueError, match="sample_rate_hz must be positive"):
        recording(sample_rate_hz=rate)


@pytest.mark.parametrize(
    "change",
    [
        {"speeds_mm_s": (20.0,)},
        {"onsets_s": (0.05,)},
        {"sliding_s": ((0.05, 0.1),)},
        {"annotated_onsets_s": (0.05,)},
    ],
)
def test_counts_that_disagree_are_refused(change):
    with pytest.raises(ValueError, match=r"as many speeds as onsets.*got \[.*1.*\]"):
        recording(**change)


def test_ids_sort_by_material_then_cycle_and_read_well():
    ids = [RecordingId("wood", 0), RecordingId("M1", 10), RecordingId("M1", 2)]
    assert [str(i) for i in sorted(ids)] == ["M1/2", "M1/10", "wood/0"]
    assert len({RecordingId("M1", 2), RecordingId("M1", 2)}) == 1


def test_a_session_is_said_where_there_are_several():
    ids = [RecordingId("M1", 2, session="2"), RecordingId("M1", 2), RecordingId("M1", 2, "taps")]
    assert [str(i) for i in sorted(ids)] == ["M1/2", "M1/2@2", "M1/2/taps"]
