"""The fit of the onset classifier: what it learns from, how it is chosen, and what it can tell."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from small_set import SMALL_HAND, SmallTimeline

from tactslip_torch.data.recording import Recording, RecordingId
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.training.onset import OnsetTraining, kinds_of

RATE = 1000.0
FILMS = HandLayout(SMALL_HAND.channels[1:])


def ms(*spans):
    return [t for first, last in spans for t in range(first, last + 1, 5)]


def test_hops_are_learned_as_what_they_are():
    """Edges lie 1 ms off the ends of hops."""
    times = SmallTimeline(
        onsets_s=(1.021, 1.651),
        released_s=((1.001, 1.07), (1.651, 1.66)),
        sliding_s=((1.021, 1.501), (1.651, 1.801)),
        non_slip_s=((0.201, 0.401),),
        slip_s=((2.001, 2.201),),
    )
    expected = {
        "onset paper": ms((1025, 1050), (1655, 1680)),  # 2 to 30 ms behind
        "before": ms((705, 1000), (1605, 1650)),  # 300 ms, but not what is still sliding or unclear
        "slide": ms((1125, 1500), (1755, 1800)),  # from 100 ms on
        "handled paper": ms((205, 400)),
        # unclear: until 100 ms behind onset, slide and slip
        "rest paper": ms((5, 200), (405, 700), (1905, 2000), (2305, 2400)),
    }
    at = np.arange(5, 2401, 5)
    found = kinds_of(times, at / 1000, "paper")
    assert {kind: at[mask].tolist() for kind, mask in found.items()} == expected
    of_onsets = kinds_of(
        SmallTimeline(onsets_s=(1.021,), sliding_s=((1.021, 1.5),)), at / 1000, "x"
    )
    assert at[of_onsets["before"]].tolist() == ms((725, 1020))
    assert at[of_onsets["onset x"]].tolist() == ms((1025, 1050))


@dataclass(frozen=True)
class Bursts:
    """Noise; on paper a burst at the onset and a little more in the slide, else a knock."""

    materials: str = "abc"
    cycles: int = 3
    hand: HandLayout = SMALL_HAND
    burst: float = 4.0
    sample_rate_hz = RATE
    is_simulated = True

    @property
    def ids(self):
        return [
            RecordingId(m, c, scene)
            for scene in ("paper", "taps")
            for m in self.materials
            for c in range(self.cycles)
        ]

    def timeline(self, recording):
        if recording.scene == "taps":
            return SmallTimeline(onsets_s=(), sliding_s=(), non_slip_s=((1.3, 1.4),))
        onset_s = 1.3 + 0.05 * recording.cycle
        return SmallTimeline(onsets_s=(onset_s,), sliding_s=((onset_s, 1.95),))

    def load(self, recording, windows=None):
        times = self.timeline(recording)
        generator = torch.Generator().manual_seed(sum(str(recording).encode()) * 7919)
        noise = torch.randn(2, 2000, generator=generator)
        for start_s, end_s in times.sliding_s:
            onset = round(start_s * RATE)
            noise[:, onset : round(end_s * RATE)] *= 1.3
            noise[:, onset : onset + 40] *= self.burst + 0.2 * ord(recording.material) % 1
        if times.non_slip_s:
            noise[:, 1310:1312] *= 2.5 * self.burst
        noise = noise[-len(self.hand) :]
        speeds = (20.0,) * len(times.onsets_s)
        return Recording(noise, RATE, recording.material, speeds, times.onsets_s, times.sliding_s)


def fitted(source=None, ids=None, **numbers):
    source = source or Bursts()
    values = {"penalty": 1e3} | numbers
    return OnsetTraining(**values)(source, source.ids if ids is None else ids, num_workers=0)


def hops_of(source, evidence, most=10**6, likeness=None, without=()):
    """Columns and kinds of hops at even places, and 60 of each recording by likeness."""
    columns, kinds = [], []
    for recording in (one for one in source.ids if one.material not in without):
        found, _ = evidence.columns(evidence.blocks_of_recording(source.load(recording).samples))
        ends_s = (evidence.first_hop + 1 + np.arange(len(found))) * evidence.hop_samples / RATE
        for kind, mask in kinds_of(source.timeline(recording), ends_s, recording.scene).items():
            own = found[torch.from_numpy(mask)]
            if likeness and not kind.startswith("onset"):
                columns.append(own[likeness(own).argsort(descending=True, stable=True)][:60])
                kinds += [f"like {kind}"] * len(columns[-1])
            own = own[np.linspace(0, len(own) - 1, most).astype(int)] if len(own) > most else own
            columns.append(own)
            kinds += [kind] * len(own)
    return torch.cat(columns), np.array(kinds)


def kernel_ridge(columns, kinds):
    """Scores of a machine on hops, whose kinds weigh alike."""
    scaler = FeatureScaler.fit(columns, tail=0.001)
    z, is_onset = scaler(columns).numpy(), np.char.startswith(kinds, "onset")
    weight = np.zeros(len(z))
    for mask in (is_onset, ~is_onset):
        for kind in (of_mask := set(kinds[mask])):
            weight[kinds == kind] = 0.5 / len(of_mask) / (kinds == kind).sum()  # of all: 1
    system = (0.5 + z @ z.T) ** 2 + np.diag(1 / (1e3 * weight))
    beta = np.linalg.solve(system, np.where(is_onset, 1.0, -1.0))
    return lambda hops: torch.from_numpy((0.5 + scaler(hops).numpy() @ z.T) ** 2 @ beta)


def test_the_machine_is_kernel_ridge_on_hops_that_a_first_machine_finds_most_like_a_slip():
    source = Bursts(burst=2.0)
    classifier, left_out, counts = fitted(source)
    evidence = classifier.evidence
    first = kernel_ridge(*hops_of(source, evidence, 100))
    fresh, _ = hops_of(Bursts("d"), evidence)
    for without, own in {(): classifier, **left_out}.items():
        columns, kinds = hops_of(source, evidence, 20, first, without)
        score = own.head(own.scaler(fresh))
        expected = kernel_ridge(columns, kinds)(fresh)
        torch.testing.assert_close(score, expected, rtol=1e-6, atol=1e-6)
        if not without:
            assert counts == {kind: int((kinds == kind).sum()) for kind in dict.fromkeys(kinds)}
    assert set(left_out) == set(source.materials)


def test_knees_are_a_tenth_of_the_usual_power_and_the_usual_step():
    source = Bursts(cycles=2)
    evidence = fitted(source)[0].evidence
    plain = type(evidence)(source.hand, RATE, 5)
    blocks = [plain.blocks_of_recording(source.load(r).samples) for r in source.ids]
    fast = np.median([np.median(own.power[0].sqrt(), -1) for own in blocks], 0)
    assert evidence.fast_knee == pytest.approx(0.1 * fast, rel=0.02)
    means = [own.mean[0, 96:].numpy() for own in blocks]  # the longest step takes 100 blocks
    steps = [np.median(np.abs(m[3:] + m[2:-1] - m[1:-2] - m[:-3])) / 2 for m in means]
    assert evidence.slow_knee[0] == pytest.approx(np.median(steps), rel=0.02)


def test_a_classifier_finds_onsets_of_recordings_it_never_saw_and_no_knocks():
    classifier, *_ = fitted(comb_periods=2)
    assert classifier.evidence.comb_periods == 2
    assert classifier.threshold == float("inf")
    fresh = Bursts("de")
    columns, kinds = hops_of(fresh, classifier.evidence)
    scores = classifier.head(classifier.scaler(columns)).numpy()
    onsets = scores[kinds == "onset paper"]
    for kind in ("before", "slide", "handled taps", "rest paper", "rest taps"):
        auc = np.mean(onsets[:, None] > scores[kinds == kind])
        assert auc > 0.8, kind


def test_a_hand_of_films_alone_learns():
    classifier, *_ = fitted(Bursts(hand=FILMS))
    columns, kinds = hops_of(Bursts("d", hand=FILMS), classifier.evidence)
    scores = classifier.head(classifier.scaler(columns)).numpy()
    others = np.quantile(scores[kinds == "rest paper"], 0.9)
    assert classifier.evidence.num_columns == 12
    assert np.median(scores[kinds == "onset paper"]) > others


@pytest.mark.parametrize(
    ("source", "scene", "numbers", "match"),
    [
        (Bursts(), "taps", {}, "no slip begins in the recordings that onsets are learned from"),
        (Bursts(), "none", {}, "no recording is left to learn onsets from; give onset.streams"),
        (Bursts(), "paper", {"hop_ms": 5.6}, "a hop of 6 samples at 1000 Hz is no hop of at most"),
    ],
)
def test_what_nothing_can_be_learned_from_is_refused_in_one_line(source, scene, numbers, match):
    with pytest.raises(ValueError, match=match) as caught:
        fitted(source, [r for r in source.ids if r.scene == scene], **numbers)
    assert "\n" not in str(caught.value)
