"""Broken channels and lost samples, held against the recording that has none."""

import numpy as np
import pytest
import torch
from scene_files import NAMES, RATE_HZ, scene_of

from tactslip_torch.simulation import Scene, simulate, timeline
from tactslip_torch.simulation.faults import losses

TWO = ("M3", "M6")
NO_FAULTS = {"dead": [], "saturated": [], "swapped": [], "drops_per_s": 0.0}


def samples(scene: Scene, **asked: object) -> torch.Tensor:
    return simulate(scene, dtype=torch.float64, **asked).samples


def rows(scene: Scene, *names: str) -> list[int]:
    return [scene.hand.names.index(name) for name in names]


@pytest.mark.parametrize("material", TWO)
@pytest.mark.parametrize(
    ("name", "channel", "value"),
    [("dead_channel", "PVDF7", 0.0), ("saturated_channel", "SG10", 5.0 - 10.0 / 2**16)],
)
def test_a_stuck_channel_holds_its_value_and_the_others_theirs(name, channel, value, material):
    scene = scene_of(name, material)
    broken, sound = samples(scene), samples(scene_of(name, material, **NO_FAULTS))
    (row,) = rows(scene, channel)
    assert torch.all(broken[row] == value)
    assert sound[row].std() > 1e-3  # it is the fault that stills it
    others = [index for index in range(24) if index != row]
    assert torch.equal(broken[others], sound[others])


def test_several_faults_at_once_and_all_channels_broken():
    scene = scene_of("paper", "M1", dead=["SG1", "SG2"], saturated=["PVDF1"], rail_v=2.0)
    some = samples(scene, windows=[(2.0, 2.3)], channels=["SG1", "PVDF1"])
    asked = some.isfinite()
    assert int(asked.sum()) == 2 * 600
    assert some[0][asked[0]].unique().tolist() == [0.0]
    assert some[14][asked[14]].unique().tolist() == [2.0 - 4.0 / 2**16]


@pytest.mark.parametrize("material", TWO)
def test_swapped_cables_exchange_two_rows_and_nothing_else(material):
    scene = scene_of("swapped_channels", material)
    broken = samples(scene)
    sound = samples(scene_of("swapped_channels", material, **NO_FAULTS))
    order = list(range(24))
    one, other = rows(scene, "PVDF7", "PVDF1")
    order[one], order[other] = other, one
    assert torch.equal(broken, sound[order])
    assert not torch.equal(broken, sound)
    alone = samples(scene, channels=["PVDF7"])
    assert torch.equal(alone[one], sound[other])
    assert alone[other].isnan().all()


def repeated(sound: np.ndarray, lost: set[int]) -> np.ndarray:
    """What a logger writes that repeats its last sample while it loses some."""
    written = sound.copy()
    for index in range(1, sound.shape[1]):
        if index in lost:
            written[:, index] = written[:, index - 1]
    return written


@pytest.mark.parametrize("material", TWO)
@pytest.mark.parametrize("drops", [{}, {"drops_per_s": 20.0, "drop_ms": [100.0, 200.0]}])
def test_lost_samples_repeat_the_last_one_in_all_channels(material, drops):
    scene = scene_of("dropped_samples", material, **drops)
    stretches = losses(scene, timeline(scene).num_samples)
    lost = {index for first, end in stretches for index in range(first, end)}
    sound = samples(scene_of("dropped_samples", material, **NO_FAULTS)).numpy()
    broken = samples(scene).numpy()
    np.testing.assert_array_equal(broken, repeated(sound, lost))
    is_lost = np.isin(np.arange(sound.shape[1]), sorted(lost))
    assert is_lost.any()
    assert np.all(np.diff(broken)[:, is_lost[1:]] == 0)
    assert np.mean(np.any(np.diff(broken)[:, ~is_lost[1:]] != 0, axis=0)) > 0.99


@pytest.mark.parametrize("drops", [{}, {"drops_per_s": 20.0, "drop_ms": [100.0, 200.0]}])
def test_a_window_in_a_loss_knows_the_sample_before_it(drops):
    """Losses that overlap hold one sample for longer than a block of 256 ms."""
    scene = scene_of("dropped_samples", "M4", **drops)
    truth, whole = timeline(scene), samples(scene)
    for first, end in losses(scene, truth.num_samples)[:40]:
        window = ((end - 1) / RATE_HZ, end / RATE_HZ)
        part = samples(scene, windows=[window], channels=["SG2", "PVDF7"])
        index = round(window[0] * RATE_HZ)
        assert torch.equal(part[rows(scene, "SG2", "PVDF7"), index], whole[[1, 20], index])
        assert first <= index


def test_losses_come_at_their_rate_and_length():
    counts, lengths = [], []
    for cycle in range(30):
        scene = scene_of("dropped_samples", "M2", cycle, drop_ms=[5.0, 50.0])
        stretches = losses(scene, 30000)
        assert list(stretches) == sorted(stretches)
        assert all(1 <= first < end <= 30000 for first, end in stretches)
        counts.append(len(stretches))
        lengths += [end - first for first, end in stretches if end < 30000]
    assert abs(sum(counts) - 30 * 30) < 4 * np.sqrt(30 * 30)  # 2 a second for 15 s
    assert 10 <= min(lengths) < 15
    assert 90 < max(lengths) <= 101
    assert np.median(lengths) == pytest.approx(2 * np.sqrt(5 * 50), rel=0.1)  # log-uniform
    assert losses(scene_of("paper", "M2"), 30000) == ()


@pytest.mark.parametrize(
    "name", [n for n in NAMES if n.endswith(("channel", "channels", "samples"))]
)
def test_faults_leave_the_truth_alone(name):
    assert timeline(scene_of(name, "M5")) == timeline(scene_of(name, "M5", **NO_FAULTS))
