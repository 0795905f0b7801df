"""A detector's file: what it scores after it was saved and loaded, and what is refused."""

import pytest
import torch

from tactslip_torch.package_files import DETECTOR, load_table, save_table

from .names import SlipDetector
from .recordings import bins_of, samples_of


@pytest.fixture(scope="module")
def bins(trained):
    """Raw bins of a held-out recording, volts."""
    return bins_of(trained.detector, samples_of("D", 1))


def test_a_saved_detector_scores_as_before(trained, bins, tmp_path):
    """With all channels, and with one replaced by what its file holds of it."""
    trained.detector.save(tmp_path / "again.pt")
    loaded = SlipDetector.load(tmp_path / "again.pt")
    for masked in (["PVDF1"], []):
        before, after = (d.predict_raw(bins, masked_channels=masked) for d in (trained[0], loaded))
        torch.testing.assert_close(after.score, before.score, rtol=1e-12, atol=1e-12)
        assert torch.equal(after.is_valid, before.is_valid)
    assert loaded.info == trained.detector.info
    assert loaded.selected_names == trained.detector.selected_names
    assert before.score.std() > 0.1  # it says something


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_broken_channel_is_left_out_and_a_broken_hand_has_no_score(trained, bins, bad):
    x = bins.clone()
    x[3, 2, 40] = bad
    x[4, :, 40] = bad
    predicted, usual = trained.detector.predict_raw(x), trained.detector.predict_raw(bins)
    assert torch.equal(predicted.score.isfinite(), predicted.is_valid)
    assert predicted.is_valid.tolist() == [row != 4 for row in range(len(x))]
    assert predicted.channels_lost[3].nonzero().tolist() == [[2]]
    is_whole = ~predicted.channels_lost.any(-1)
    torch.testing.assert_close(predicted.score[is_whole], usual.score[is_whole])


def test_scores_have_gradients_to_the_volts(trained, bins):
    """Along a line through the volts the derivative is what central differences say."""
    x = bins[5:6].clone().requires_grad_()
    (slope,) = torch.autograd.grad(trained.detector.score_raw(x).sum(), x)
    direction = torch.from_numpy(samples_of("A", 1)[: x.shape[-1]].T.copy()).double()[None]
    direction = direction - direction.mean(-1, keepdim=True)
    step = 1e-6
    with torch.no_grad():
        ahead, behind = (trained.detector.score_raw(x + s * step * direction) for s in (1, -1))
    expected = (ahead - behind) / (2 * step)
    found = (slope * direction).sum()
    assert found.item() == pytest.approx(expected.item(), rel=1e-3, abs=1e-6)
    assert slope.abs().max() > 0


NO_DETECTORS = {  # what is changed in metadata, or which tensor becomes what
    "missing": lambda content, tensors: content.pop("selected"),
    "no channels": lambda content, tensors: content.update(channels=[]),
    "channels": lambda content, tensors: content.update(channels=content["channels"] * 10**3),
    "selected": lambda content, tensors: content.update(selected=[0, 1, 2]),
    "frames": lambda content, tensors: content.update(window_lengths=[10**6 + 1] * 4),
    "bins": lambda content, tensors: content["pool"].update(bin_samples=10**9),
    "text": lambda content, tensors: content["pool"].update(sample_rate_hz="fast"),
    "shape": lambda content, tensors: tensors.update({"scaler.minimum": torch.zeros(3)}),
    "index": lambda content, tensors: tensors.update(
        {"scaler.columns": torch.arange(1, 1 + len(tensors["scaler.minimum"]))}
    ),
    "index dtype": lambda content, tensors: tensors.update(
        {"scaler.columns": torch.zeros_like(tensors["scaler.minimum"])}
    ),
    "signs": lambda content, tensors: tensors.update({"head.signs": torch.ones(3)}),
    "dtype": lambda content, tensors: tensors.update({"head.constant": torch.tensor(1)}),
    "number": lambda content, tensors: tensors.update({"head.constant": torch.tensor(torch.nan)}),
}


@pytest.mark.parametrize("change", NO_DETECTORS)
def test_what_describes_no_detector_is_refused_in_one_line(change, trained, tmp_path):
    metadata, tensors = load_table(trained.file, DETECTOR)
    NO_DETECTORS[change](metadata, tensors)
    save_table(tmp_path / "other.pt", DETECTOR, metadata, tensors)
    with pytest.raises(ValueError, match=r"other\.pt is damaged: ") as caught:
        SlipDetector.load(tmp_path / "other.pt")
    assert "\n" not in str(caught.value)


def test_a_file_of_an_earlier_version_is_named_as_such(tmp_path):
    save_table(tmp_path / "old.pt", "tactslip_torch detector 3", {}, {})
    with pytest.raises(ValueError, match=r"old\.pt was made by version 0\.2\.0 or .* make it"):
        SlipDetector.load(tmp_path / "old.pt")


@pytest.mark.parametrize("kept", [0, 7, 0.5])
def test_a_file_that_holds_no_detector_is_refused_by_name(trained, tmp_path, kept):
    content = trained.file.read_bytes()
    size = kept if kept != 0.5 else len(content) // 2
    (tmp_path / "broken.pt").write_bytes(content[:size])
    with pytest.raises((ValueError, OSError), match=r"broken\.pt"):
        SlipDetector.load(tmp_path / "broken.pt")


def test_code_in_a_file_is_not_executed(tmp_path):
    target = tmp_path / "executed"
    torch.save(_Trap(str(target)), tmp_path / "trap.pt")
    with pytest.raises((ValueError, OSError)):
        SlipDetector.load(tmp_path / "trap.pt")
    assert not target.exists()


class _Trap:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        from pathlib import Path

        return Path.touch, (Path(self.path),)
