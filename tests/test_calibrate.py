"""A detector calibrated on recordings of its use: the rate holds, what is worse is not written."""

import json
import math
from dataclasses import replace

import numpy as np
import onnxruntime
import pytest
import torch
from contract.names import settings as overrides
from contract.recordings import CHANNELS, NAMES, RATE_HZ, SLIDE_S, samples_of, write_recording

from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingId, Timeline
from tactslip_torch.deploy.export import export_detector, read_sidecar
from tactslip_torch.model.calibration import Platt
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.model.kernels import KernelSum, Polynomial, QuadraticForm
from tactslip_torch.onset.decisions import AlarmSettings, Decider, score_stream
from tactslip_torch.onset.rules import Budget, Cusum, KOfN
from tactslip_torch.training.alarm import Stream, Timing
from tactslip_torch.training.calibrate import (
    Calibrator,
    Change,
    decision_threshold,
    in_stretches,
)

TIMING = Timing(1000.0, 500, 1000, 0)
"""A decision every half second, on the second before."""
SETTINGS = AlarmSettings(500, Platt(1.0, 0.0), KOfN(1, 1), 0.0, None, rearm_s=1.0, refractory_s=1.0)
STRETCH_H = 0.1


def calibrator(settings=SETTINGS, per_hour=None, **changes):
    return Calibrator(settings, TIMING, LabelRule(bin_ms=1000.0), per_hour, **changes)


def stream_of(score, name="a", cycle=0, **times):
    """Scores of valid decisions as those of a recording without slip, unless ``times`` say more."""
    duration_s = (len(score) + 1) * TIMING.hop_s
    times = times or {"non_slip_s": ((0.0, duration_s),)}
    score = torch.as_tensor(score, dtype=torch.float32)
    valid, none = score.isfinite(), torch.empty(0).double()
    truth = Timeline(**times, duration_s=duration_s)
    return Stream(RecordingId(name, cycle), truth, score, valid, none)


def bunched_scores(rng, hours, bunches_per_hour=40.0, mean_size=4.0, spacing_s=8.0):
    """Decisions of noise in which disturbances come in bunches of like height."""
    num = round(hours * 3600 / TIMING.hop_s)
    score = rng.normal(-4.0, 0.5, num)
    for _ in range(rng.poisson(bunches_per_hour * hours)):
        at, height = rng.uniform(0, num), rng.exponential(2.0)
        for _ in range(rng.geometric(1 / mean_size)):
            if at < num:
                score[int(at)] = max(score[int(at)], height + rng.normal(0.0, 0.3))
            at += 2.0 / TIMING.hop_s + rng.exponential(spacing_s / TIMING.hop_s)
    return score


def drawn_sets(dispersed, num_sets=60, num_stretches=40, seed=3):
    """How often a stated rate does not hold on the stretches that a set was not drawn from."""
    rng = np.random.default_rng(seed)
    made = calibrator(per_hour=10.0)
    pieces = in_stretches(stream_of(bunched_scores(rng, 30.0)), TIMING, round(30.0 / STRETCH_H))
    scored = [made.scored(piece) for piece in pieces]
    broken = 0
    for _ in range(num_sets):
        order = rng.permutation(len(scored))
        own = [scored[i] for i in order[:num_stretches]]
        budget = made.budget(made.dispersion(own) if dispersed else 1.0)
        alarm = made.fit(own, budget).alarm
        others = [made.outcome(scored[i], Change(0.0, None, alarm)) for i in order[num_stretches:]]
        rate = sum(each["false_alarms"] for each in others) / sum(each["hours"] for each in others)
        broken += rate > 10.0
    return broken / num_sets


def test_a_stated_rate_holds_although_false_alarms_come_in_bunches():
    assert drawn_sets(dispersed=True) <= 0.05
    assert drawn_sets(dispersed=False) > 0.1  # so the process has bunches that matter
