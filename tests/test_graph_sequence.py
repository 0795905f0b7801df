"""Calibration, rules and latch as nodes, against those in torch."""

import math
from functools import cache

import numpy as np
import onnxruntime
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tactslip_torch.graph.sequence import (
    LATCH_START,
    latched,
    latest,
    llr_of,
    probability_of,
    rule_start,
    statistic_of,
)
from tactslip_torch.graph.value import BOOL, F32, F64
from tactslip_torch.graph.writer import Graph
from tactslip_torch.model.calibration import LARGEST_LLR, Isotonic, Platt, probability
from tactslip_torch.onset.rules import Cusum, KOfN, latch, latch_start

DTYPES = {F32: torch.float32, F64: torch.float64}
LARGEST = {F32: float(np.finfo(np.float32).max), F64: float(np.finfo(np.float64).max)}
CALIBRATIONS = (
    Platt(2.0, -0.7),
    Platt(0.0, 0.3),
    Platt(1 + 1e-9, 0.0),
    Platt(1e12, -3.0),
    Isotonic((-1.0, -0.25, 0.0, 0.1, 3.0), (-4.0, -4.0, -0.5, 0.0, 5.0)),
    Isotonic((-1e300, 1e300), (-1e30, 1e30)),
    Isotonic((0.5,), (0.0,)),
)
RULES = (
    KOfN(1, 1),
    KOfN(1, 4),
    KOfN(2, 3),
    KOfN(5, 5),
    Cusum(),
    Cusum(0.5, 0.2, 3.0),
    Cusum(-0.1, 1 - 1e-9),
)


def session_of(graph):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(graph.model({}).SerializeToString(), options)


def scores(dtype):
    """Any finite score, and often one of a few."""
    largest = LARGEST[dtype]
    width = dtype.itemsize * 8
    usual = st.floats(-4, 4, width=width) | st.sampled_from([0.0, -0.25, 0.1, 3.0])
    any_ = st.floats(-largest, largest, width=width, allow_nan=False)
    return arrays(dtype, st.integers(1, 30), elements=usual | any_)


# Calibration -----------------------------------------------------------------------------------


@cache
def calibrating(calibration, dtype, slip_share):
    graph = Graph()
    llr = llr_of(graph.input("score", dtype, ("k",)), calibration)
    graph.output("llr", llr, ("k",))
    graph.output("probability", probability_of(llr, slip_share), ("k",))
    return session_of(graph)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("calibration", CALIBRATIONS)
@given(data=st.data(), slip_share=st.sampled_from([0.5, 0.02]))
def test_scores_become_the_same_ratios_and_probabilities(calibration, dtype, data, slip_share):
    score = data.draw(scores(dtype))
    expected = calibration.llr(torch.from_numpy(score))
    llr, found = calibrating(calibration, dtype, slip_share).run(None, {"score": score})
    assert llr.dtype == found.dtype == dtype
    if isinstance(
        calibration, Platt
    ):  # a slope next to 1 is halved and doubled, so denormals round
        np.testing.assert_allclose(llr, expected.numpy(), rtol=0, atol=1e-300)
    else:  # of which torch.lerp rounds some once less
        tiny = 4 * np.finfo(dtype).eps
        most = tiny * max(1.0, *map(abs, (*calibration.llrs, 0.0)))
        np.testing.assert_allclose(llr, expected.numpy(), rtol=tiny, atol=most)
    close = 1e-12 if dtype == F64 else 2e-7
    np.testing.assert_allclose(found, probability(expected, slip_share), rtol=0, atol=close)


@pytest.mark.parametrize("calibration", CALIBRATIONS)
def test_knots_and_ends_are_met_exactly(calibration):
    ends = [-LARGEST[F64], LARGEST[F64], 0.0]
    score = np.array([*getattr(calibration, "scores", ()), *ends])
    llr, _ = calibrating(calibration, F64, 0.5).run(None, {"score": score})
    np.testing.assert_array_equal(llr, calibration.llr(torch.from_numpy(score)).numpy())
    assert np.abs(llr).max() <= LARGEST_LLR


def test_another_calibration_is_refused():
    with pytest.raises(ValueError, match="Platt or Isotonic, got 'line'"):
        llr_of(Graph().input("score", F64, ("k",)), "line")


# What held last --------------------------------------------------------------------------------


@given(mask=arrays(bool, st.integers(1, 20)))
def test_latest_is_where_a_mask_held_last(mask):
    graph = Graph()
    given_mask, values = graph.input("mask", BOOL, ("k",)), graph.input("values", F64, ("k",))
    graph.output("found", latest(given_mask, graph.constant([-1], F64), values), ("k",))
    numbers = np.arange(len(mask), dtype=np.float64)
    expected = np.maximum.accumulate(np.where(mask, numbers, -1))
    (found,) = session_of(graph).run(None, {"mask": mask, "values": numbers})
    np.testing.assert_array_equal(found, expected)


# Rules -----------------------------------------------------------------------------------------


@cache
def ruling(rule, dtype):
    graph = Graph()
    llr, memory = graph.input("llr", dtype, ("k",)), graph.input("memory", F64, ("m",))
    statistic, after = statistic_of(graph, rule, llr, memory)
    graph.output("statistic", statistic, ("k",))
    graph.output("after", after, (len(rule_start(rule)),))
    return session_of(graph)


def in_pieces(rule, dtype, llr, cuts):
    memory, parts = np.array(rule_start(rule)), []
    for piece in np.split(llr, sorted(cuts)):
        if len(piece):
            inputs = {"llr": piece, "memory": memory}
            statistic, memory = ruling(rule, dtype).run(None, inputs)
            parts.append(statistic)
    return np.concatenate(parts)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("rule", RULES, ids=str)
@given(data=st.data())
def test_rules_make_the_same_statistic_in_any_pieces(rule, dtype, data):
    llr = data.draw(scores(dtype)).clip(-LARGEST_LLR, LARGEST_LLR)
    cuts = data.draw(st.lists(st.integers(0, len(llr)), max_size=4))
    given_llr = torch.from_numpy(llr)
    expected, _ = rule.scan(given_llr, rule.start(given_llr[0]))
    found = in_pieces(rule, dtype, llr, cuts)
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, expected.numpy())


# The latch -------------------------------------------------------------------------------------


@cache
def latching(dtype, rearm, refractory):
    graph = Graph()
    statistic, number = graph.input("statistic", dtype, ("k",)), graph.input("number", F64, ("k",))
    level, memory = graph.input("level", dtype, (1,)), graph.input("memory", F64, (3,))
    times = {"rearm": rearm, "refractory": refractory}
    made = latched(graph, statistic, level, number, memory, **times)
    graph.output("alarm", made.alarm, ("k",))
    graph.output("on", made.on, ("k",))
    graph.output("memory_after", made.memory, (3,))
    return session_of(graph)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@given(
    data=st.data(),
    rearm=st.sampled_from([0, 1, 3]),
    refractory=st.sampled_from([0, 1, 4, 9]),
    threshold=st.sampled_from([0.5, 0.1, 0.8, math.inf, -math.inf]),
    first=st.sampled_from([0, 10**12]),
)
def test_the_latch_raises_the_same_alarms_in_any_pieces(
    dtype, rearm, refractory, threshold, first, data
):
    level = np.array([threshold], dtype)
    below = np.nextafter(level[0], -dtype.type(np.inf))
    exact = [float(level[0]), float(below), 0.0, 1.0]
    values = st.sampled_from([value for value in exact if math.isfinite(value)])
    statistic = data.draw(arrays(dtype, st.integers(1, 40), elements=values))
    cuts = data.draw(st.lists(st.integers(0, len(statistic)), max_size=5))
    times = {"rearm": rearm, "refractory": refractory}
    state = latch_start(torch.zeros(()))
    session, memory, number = latching(dtype, **times), np.array(LATCH_START), first
    for piece in np.split(statistic, sorted(cuts)):
        if not len(piece):
            continue
        given_piece = torch.from_numpy(piece)
        alarm, on, state = latch(given_piece, threshold, state=state, **times)
        inputs = {"statistic": piece, "level": level, "memory": memory}
        inputs["number"] = number + np.arange(len(piece), dtype=np.float64)
        found_alarm, found_on, memory = session.run(None, inputs)
        np.testing.assert_array_equal(found_alarm, alarm.numpy())
        np.testing.assert_array_equal(found_on, on.numpy())
        assert memory[0] == float(state.is_on)
        number += len(piece)
