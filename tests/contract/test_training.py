"""What a fit may depend on."""

import pytest
import torch

from . import names
from .recordings import HELD_OUT as HELD_OUT_MATERIALS
from .recordings import SEEN, TRIALS, bins_of, samples_of, write_set
from .running import train


def scores_of(detector):
    """Scores of raw bins of a recording that no set holds."""
    return detector.score_raw(bins_of(detector, samples_of("E", 1)))


def trained_on(detector):
    """Names of the training recordings, as "material/trial"."""
    return {name.split("|")[0] for name in detector.info[names.TRAINING_RECORDINGS]}


# Nothing of a held-out recording is learned ------------------------------------------------------


@pytest.fixture
def with_other_recordings(command, tmp_path):
    """Trains once more on the set with other samples in some recordings."""

    def again(trained, changed):
        root = write_set(tmp_path / "set", dict.fromkeys(changed, 1))
        return train(command, tmp_path, trained.overrides, root=root, cache=tmp_path / "cache")

    return again


def test_held_out_recordings_change_no_number_of_the_fit(trained_or_slow, with_other_recordings):
    """Neither those of held-out materials nor the test trials; their own scores do change."""
    trained = trained_or_slow
    everything = {f"{m}/{t}" for m in (*SEEN, *HELD_OUT_MATERIALS) for t in TRIALS}
    training = trained_on(trained.detector)
    assert training < everything
    other = with_other_recordings(trained, everything - training)
    assert trained_on(other.detector) == training
    torch.testing.assert_close(
        scores_of(other.detector), scores_of(trained.detector), rtol=1e-12, atol=1e-12
    )
    for key in names.FIT_FACTS:
        assert other.metrics[key] == trained.metrics[key], key
    assert other.metrics[names.SPLITS][names.TRAIN] == trained.metrics[names.SPLITS][names.TRAIN]
    told, found = (t.metrics[names.SPLITS] for t in (trained, other))
    assert told[names.TEST] != found[names.TEST] or told[names.HELD_OUT] != found[names.HELD_OUT]


@pytest.mark.slow
def test_a_training_recording_does_change_the_fit(paper, with_other_recordings):
    """So that the test above would notice a leak."""
    other = with_other_recordings(paper, {min(trained_on(paper.detector))})
    assert (scores_of(other.detector) - scores_of(paper.detector)).abs().max() > 1e-6
