"""What is kept of a stream, how it is drawn, and what the tables say."""

import math

import numpy as np
import pytest
from drawing import assert_png
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_hex

from tactslip_torch.report.onset import (
    REST,
    SLIP,
    DecisionCounts,
    Envelope,
    Traces,
    alarm_outcome,
    onset_figure,
    onsets_table,
    view_of,
)
from tactslip_torch.report.style import ALARM

RATE_HZ, HOP_S = 2000.0, 0.01
seeds = st.integers(0, 2**32 - 1)


def pieces(rng, total, most):
    """Cuts of 0 to ``total`` into pieces of 0 to ``most``."""
    at = 0
    while at < total:
        size = int(rng.integers(0, most + 1))
        yield slice(at, at + size)
        at += size


# While a stream passes -------------------------------------------------------------------------


@given(
    num_samples=st.integers(0, 400),
    num_segments=st.integers(1, 60),
    seed=seeds,
    lost=st.sampled_from([0.0, 0.3, 1.0]),
)
def test_an_envelope_of_pieces_has_every_extreme_in_order(num_samples, num_segments, seed, lost):
    rng = np.random.default_rng(seed)
    values = rng.standard_normal((3, num_samples))
    values[rng.random(values.shape) < lost] = rng.choice([np.nan, np.inf, -np.inf])
    kept = Envelope(3, num_samples, num_segments)
    for piece in pieces(rng, num_samples, 50):
        kept.add(values[:, piece])
    numbers, seen = kept.points()
    assert seen.shape == (3, len(numbers))
    assert len(numbers) <= 2 * num_segments
    assert (np.diff(numbers) >= 0).all()
    finite = np.where(np.isfinite(values), values, np.nan)
    if num_samples <= 2 * num_segments:
        np.testing.assert_array_equal(seen, finite)
        return
    size = -(-num_samples // num_segments)
    for start in range(0, num_samples, size):
        part = finite[:, start : start + size]
        expected = np.stack([np.fmin.reduce(part, 1), np.fmax.reduce(part, 1)], 1)
        np.testing.assert_array_equal(seen[:, numbers == start], expected)


@pytest.mark.parametrize("view", [(0.0, 1.2), (0.5, 0.8)])
def test_traces_take_what_is_in_view_and_the_status_it_begins_with(rng, view):
    """Of pieces of any length."""
    samples, times = rng.standard_normal((3, 4000)), 0.065 + HOP_S * np.arange(190)
    columns = np.stack([rng.random(190), *(rng.random((3, 190)) < 0.5), rng.random(190)])
    traces = Traces("abc", RATE_HZ, HOP_S, view)
    for piece in pieces(rng, 4000, 300):
        traces.add_samples(samples[:, piece])
    for piece in pieces(rng, 190, 9):
        traces.add_decisions(times[piece], *columns[:, piece])
    first, last = (round(edge * RATE_HZ) for edge in view)
    np.testing.assert_allclose(traces.samples()[0], np.arange(first, last) / RATE_HZ)
    np.testing.assert_array_equal(traces.samples()[1], samples[:, first:last])
    seen = (times > view[0] - 0.006) & (times < view[1])
    decided_s, decided = traces.decisions()
    np.testing.assert_allclose(decided_s, times[seen])
    np.testing.assert_array_equal(decided[[0, 1, 3, 4]], columns[[0, 1, 3, 4]][:, seen])
    np.testing.assert_array_equal(decided[2], 1 - columns[2, seen])


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        (None, (0.0, 9.5)),
        ([1, 2.5], (1.0, 2.5)),
        ([-3, 99], (0.0, 9.5)),
        *((given, r"view must be \[start, end\] in seconds") for given in
          ("1", 3.0, [1], [1, 2, 3], ["a", "b"], [True, 2], [None, 1])),
        *((given, r"shows nothing of 9\.5 s") for given in
          ([2, 1], [3, 3], [10, 11], [-2, -1], [math.nan, 3.0])),
    ],
)  # fmt: skip
def test_a_view_lies_within_the_recording_or_is_refused(given, wanted):
    if isinstance(wanted, str):
        with pytest.raises(ValueError, match=wanted):
            view_of(given, 9.5)
    else:
        assert view_of(given, 9.5) == wanted


@given(seed=seeds, num=st.integers(0, 60))
def test_decisions_are_counted_and_alarms_end_as_in_a_loop(seed, num):
    rng = np.random.default_rng(seed)
    times = HOP_S * np.arange(1, num + 1)
    on, valid = rng.random(num) < 0.5, rng.random(num) < 0.8
    llr = rng.standard_normal(num)
    onsets = sorted(rng.uniform(0, HOP_S * (num + 2), 3))
    alarms, was = [], False
    for time, now in zip(times.tolist(), on, strict=True):
        if now and not was:
            alarms.append({"alarm_s": time, "end_s": None})
        if was and not now:
            alarms[-1]["end_s"] = time
        was = now
    counts = DecisionCounts(onsets)
    for piece in pieces(rng, num, 7):
        own = set(times[piece].tolist())
        raised = [{"alarm_s": a["alarm_s"]} for a in alarms if a["alarm_s"] in own]
        counts.add(times[piece], llr[piece], valid[piece], on[piece], raised)
    assert counts.alarms == alarms
    assert (counts.num_decisions, counts.num_invalid) == (num, int((~valid).sum()))
    for onset, found in zip(onsets, counts.first_positive_s, strict=True):
        wanted = [t for t, v in zip(times, llr, strict=True) if t >= onset and v > 0]
        assert found == wanted[0] if wanted else math.isnan(found)


# The figure ------------------------------------------------------------------------------------
TRUTH = {"onsets": [{"onset_s": 0.42}], "sliding_s": [(0.42, 1.1)]}
ALARMS = [{"alarm_s": 0.5, "onset_s": 0.43}, {"alarm_s": 1.25, "onset_s": 1.23}]


def traces_of(films, view=(0.0, 1.4), num_decisions=130):
    """Slip is decided from 0.5 to 1.2 s, 0.2 s of it not valid; from 0.9 to 1 s it abstains."""
    times = np.round(0.07 + HOP_S * np.arange(num_decisions), 6)
    slip = (times >= 0.5) & (times < 1.2)
    valid, abstains = (times < 0.6) | (times >= 0.8), (times >= 0.9) & (times < 1.0)
    names = [f"PVDF{i}" for i in range(1, 1 + len(films))]
    traces = Traces(names, RATE_HZ, HOP_S, view)
    traces.add_samples(films)
    score = np.where(times < 0.2, math.nan, 2.0 * slip)  # not before there is a floor
    traces.add_decisions(times - 1e-9, 0.9 * slip + 0.05, slip, valid, abstains, score)
    return traces


@pytest.fixture
def films(rng):
    return np.arange(3)[:, None] + rng.standard_normal((3, 2800))


@pytest.fixture
def draw(drawn, tmp_path, films):
    """Draws traces; their figure."""

    def drawing(traces=None, *, alarms=ALARMS, truth=TRUTH, title="", **options):
        path, traces = tmp_path / "onsets.png", traces or traces_of(films)
        entry = {"alarms": alarms, "truth": truth}
        onset_figure(traces, entry, path, title=title, **options)
        assert_png(path)
        return drawn[-1]

    return drawing


def marks_of(figure):
    """By panel and name, the times of lines and the ends of shaded segments."""
    found = {}
    for place, axes in enumerate(figure.axes):
        for part in axes.collections:
            boxes = [path.vertices[:, 0] for path in part.get_paths()]
            ends = [(float(box.min()), float(box.max())) for box in boxes]
            times = [low if low == high else (low, high) for low, high in ends]
            found[place, part.get_gid()] = times
    return found


def legend_of(figure):
    return {text.get_text() for text in figure.legends[0].get_texts()}


def test_marks_stand_where_things_happened(draw):
    figure = draw(title="SIMULATED recording a.npz")
    films, _, chance = figure.axes
    assert figure.get_suptitle() == "SIMULATED recording a.npz"
    expected = {
        **{(place, "invalid"): [(0.6, 0.8)] for place in range(3)},
        (0, "slip"): [(0.5, 1.2)],
        (0, "alarm"): [0.5, 1.25],
        (0, "onset"): [0.42],
        (1, f"decided {REST}"): [(0.07, 1.4)],
        (1, f"decided {SLIP}"): [(0.5, 1.2)],
        (1, f"truth {REST}"): [(0.0, 1.4)],
        (1, f"truth {SLIP}"): [(0.42, 1.1)],
        (2, "onset"): [0.42],
        (2, "estimate"): [0.43, 1.23],
        (2, "abstains"): [(0.9, 1.0)],
    }
    assert marks_of(figure) == {key: list(map(pytest.approx, of)) for key, of in expected.items()}
    (markers,) = [line for line in films.lines if line.get_marker() == "v"]
    assert list(markers.get_xdata()) == [0.5, 1.25]
    assert to_hex(markers.get_color()) == ALARM.lower()
    np.testing.assert_allclose(chance.lines[0].get_ydata().max(), 0.95)
    assert chance.lines[0].get_drawstyle() == "steps-post"  # a decision holds until the next
    assert legend_of(figure) >= {"decided: slip", "onset, true", "not valid", "abstains"}


def test_an_onset_classifier_has_a_panel_with_its_threshold(draw):
    score, threshold = draw(onset_threshold=1.5).axes[3].lines
    times, values = (np.asarray(x) for x in (score.get_xdata(), score.get_ydata()))
    assert np.nanmin(times[np.isfinite(values)]) == pytest.approx(0.2, abs=HOP_S)
    assert (np.nanmax(values), list(threshold.get_ydata())) == (2.0, [1.5, 1.5])


@pytest.mark.parametrize("level", [np.nan, 0.0, 3e38])
@pytest.mark.parametrize("num_decisions", [0, 1])
def test_dead_films_and_few_decisions_are_drawn_without_a_warning(draw, level, num_decisions):
    films = np.stack([np.full(200, level), np.zeros(200)])
    draw(traces_of(films, (0.0, 0.1), num_decisions), alarms=[])


# Tables ----------------------------------------------------------------------------------------


def entry(name="a.npz", *, truth=True, **changes):
    onsets = [
        {"onset_s": 1.0, "outcome": "found", "delay_s": 0.05},
        {"onset_s": 3.0, "outcome": "early", "delay_s": None},
        {"onset_s": 5.0, "outcome": "missed", "delay_s": None},
    ]
    known = {"onsets": onsets, "false_alarms_s": [0.3], "early_s": 0.2}
    alarms = [
        {"alarm_s": t, "onset_s": t - 0.01, "end_s": t + 0.1, "score": 1.0}
        | {"probability": 0.9, "statistic": 2.0, "is_valid": t != 1.5, "raised_by": "onset"}
        for t in (0.3, 1.05, 1.5, 2.9, 5.7)
    ]
    if truth:
        alarms = [alarm | alarm_outcome(alarm["alarm_s"], known) for alarm in alarms]
    values = {
        "file": name,
        "material": "M1",
        "simulated": truth,
        "duration_s": 6.0,
        "decisions": {"number": 600, "invalid": 3},
        "alarms": alarms,
        "truth": known if truth else None,
    }
    return values | changes


def content(*entries, **changes):
    found = {"recordings": list(entries), "events": None, "simulated": True}
    return found | changes


def test_every_alarm_has_its_outcome():
    outcomes = [(a["outcome"], a["true_onset_s"], a["delay_s"]) for a in entry()["alarms"]]
    assert outcomes == [
        ("false", None, None),
        ("found", 1.0, pytest.approx(0.05)),
        ("repeated", 1.0, pytest.approx(0.5)),
        ("early", 3.0, pytest.approx(-0.1)),
        ("late", 5.0, pytest.approx(0.7)),
    ]


def test_the_table_says_what_is_simulated_what_is_wrong_and_what_it_leaves_out():
    lines = onsets_table(content(entry())).splitlines()
    assert lines[0].startswith("SIMULATED")
    assert lines[2].split() == ["a.npz", "0.300", "0.290", "0.90", "onset", "yes", *"--", "false"]
    assert lines[3].split() == ["1.050", "1.040", "0.90", "onset", "yes", "1.000", "0.050", "found"]
    assert lines[4].split()[4] == "NO"
    assert lines[6].split() == [*"-----", "5.000", "-", "missed"]
    many = onsets_table(content(*[entry()] * 20, simulated=False)).splitlines()
    assert many[-1] == "and 80 more, see onsets.csv"
    assert "SIMULATED" not in many[0]
    assert onsets_table(content(simulated=False)) == "no alarm, and no slip missed"
