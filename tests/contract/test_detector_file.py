"""A detector's file: what it scores after it was saved and loaded, and what is refused."""

import pytest
import torch

from .names import SlipDetector, predict_raw, score_raw
from .recordings import samples_of


@pytest.fixture(scope="module")
def bins(trained):
    """Raw bins of a held-out recording with their context, ``[N, C, n]``, volts."""
    detector = trained.detector
    length = detector.context_before + detector.pool.bin_samples + detector.context_after
    return torch.from_numpy(samples_of("D", 1).T.copy()).unfold(1, length, 97).transpose(0, 1)


def test_a_saved_detector_scores_as_before(trained, bins, tmp_path):
    before = predict_raw(trained.detector, bins.double())
    trained.detector.save(tmp_path / "again.pt")
    loaded = SlipDetector.load(tmp_path / "again.pt")
    after = predict_raw(loaded, bins.double())
    torch.testing.assert_close(after.score, before.score, rtol=1e-12, atol=1e-12)
    assert torch.equal(after.is_valid, before.is_valid)
    assert loaded.info == trained.detector.info
    assert loaded.selected_names == trained.detector.selected_names
    assert before.score.std() > 0.1  # it says something


def test_bins_score_alone_as_together_and_plain_as_with_validity(trained, bins):
    x = bins.double()
    together = score_raw(trained.detector, x)
    alone = torch.stack([score_raw(trained.detector, each) for each in x])
    torch.testing.assert_close(alone, together, rtol=1e-9, atol=1e-9)
    predicted = predict_raw(trained.detector, x)
    torch.testing.assert_close(predicted.score, together, rtol=1e-9, atol=1e-9)


def test_single_precision_scores_to_its_rounding(trained, bins):
    double, single = (
        score_raw(trained.detector, bins.to(d)) for d in (torch.float64, torch.float32)
    )
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), double, rtol=1e-4, atol=1e-4 * double.std().item())


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_broken_channel_is_flagged_and_the_score_stays_finite(trained, bins, bad):
    x = bins.double()
    x[3, 2, 40] = bad
    predicted = predict_raw(trained.detector, x)
    assert predicted.score.isfinite().all()
    assert not predicted.is_valid[3]
    assert predicted.is_valid[torch.arange(len(x)) != 3].all()


def test_scores_have_gradients_to_the_volts(trained, bins):
    """Along a line through the volts the derivative is what central differences say."""
    x = bins[5:6].double().requires_grad_()
    (slope,) = torch.autograd.grad(score_raw(trained.detector, x).sum(), x)
    direction = torch.from_numpy(samples_of("A", 1)[: x.shape[-1]].T.copy()).double()[None]
    direction = direction - direction.mean(-1, keepdim=True)
    step = 1e-6
    with torch.no_grad():
        ahead, behind = (score_raw(trained.detector, x + s * step * direction) for s in (1, -1))
    expected = (ahead - behind) / (2 * step)
    found = (slope * direction).sum()
    assert found.item() == pytest.approx(expected.item(), rel=1e-3, abs=1e-6)
    assert slope.abs().max() > 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda content: content[: len(content) // 2], ("broken.pt",)),
        (lambda content: b"volts\n", ("broken.pt",)),
        (lambda content: b"", ("broken.pt",)),
    ],
    ids=["truncated", "text", "empty"],
)
def test_a_file_that_holds_no_detector_is_refused_by_name(trained, tmp_path, change, words):
    (tmp_path / "broken.pt").write_bytes(change(trained.file.read_bytes()))
    with pytest.raises((ValueError, OSError)) as caught:
        SlipDetector.load(tmp_path / "broken.pt")
    for word in words:
        assert word in str(caught.value)


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
