"""What is kept of a stream for the page, how it is drawn, and what the table says."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_hex
from PIL import Image

from tactslip_torch.report.onset import (
    ALARM,
    COLUMNS,
    REST,
    SLIP,
    DecisionCounts,
    StreamSummary,
    Traces,
    _RunningEnvelope,
    _spans,
    _status_at,
    alarm_outcome,
    draw_onsets,
    envelope,
    onset_figure,
    onset_rows,
    onsets_summary,
    onsets_table,
    onsets_title,
    view_of,
)

RATE_HZ, HOP_S = 2000.0, 0.01
seeds = st.integers(0, 2**32 - 1)


def pieces(rng, total, most):
    """Cuts of 0 to ``total`` into pieces of 0 to ``most``."""
    at = 0
    while at < total:
        size = int(rng.integers(0, most + 1))
        yield slice(at, at + size)
        at += size


# The envelope of a stream ----------------------------------------------------------------------


@given(num_samples=st.integers(0, 300), num_stretches=st.integers(1, 60), seed=seeds)
def test_an_envelope_of_pieces_is_that_of_the_whole(num_samples, num_stretches, seed):
    rng = np.random.default_rng(seed)
    values = rng.standard_normal((2, num_samples))
    values[rng.random(values.shape) < rng.choice([0, 0.3, 1])] = rng.choice([np.nan, np.inf])
    running = _RunningEnvelope(2, num_samples, num_stretches)
    for piece in pieces(rng, num_samples, 40):
        running.add(values[:, piece])
    found, wanted = running.points(), envelope(values, num_stretches)
    np.testing.assert_array_equal(found[0], wanted[0])
    np.testing.assert_array_equal(found[1], wanted[1])


# The traces ------------------------------------------------------------------------------------


def test_short_traces_are_the_stream_itself(rng):
    volts = rng.standard_normal((3, 2400))
    times = 0.07 + HOP_S * np.arange(110)
    probability = rng.random(110)
    flags = [rng.random(110) < share for share in (0.5, 0.9, 0.2)]
    traces = Traces({"b": 2, "a": 0}, RATE_HZ, HOP_S, (0.0, 1.2))
    for piece in pieces(rng, 2400, 700):
        traces.add_samples(volts[:, piece])
    for piece in pieces(rng, 110, 30):
        traces.add_decisions(times[piece], probability[piece], *(flag[piece] for flag in flags))
    heard = traces.summary([(0.5, 0.4)], [0.45], [(0.45, 0.9)], is_known=True)
    assert list(heard.channels) == ["b", "a"]
    for name, row in (("b", 2), ("a", 0)):
        np.testing.assert_allclose(heard.channels[name][0], np.arange(2400) / RATE_HZ)
        np.testing.assert_array_equal(heard.channels[name][1], volts[row])
    for line, wanted in zip(
        (heard.probability, heard.is_slip, heard.is_valid, heard.abstains),
        (probability, *flags),
        strict=True,
    ):
        np.testing.assert_allclose(line[0], times, atol=1e-9)
        np.testing.assert_array_equal(line[1], wanted)
    assert (heard.alarms, heard.onsets_s, heard.is_known) == ([(0.5, 0.4)], [0.45], True)


def test_a_view_takes_its_stretch_and_the_status_it_begins_with(rng):
    volts = rng.standard_normal((1, 4000))
    times = 0.065 + HOP_S * np.arange(190)
    traces = Traces({"a": 0}, RATE_HZ, HOP_S, (0.5, 0.8))
    for piece in pieces(rng, 4000, 300):
        traces.add_samples(volts[:, piece])
    for piece in pieces(rng, 190, 9):
        now = times[piece]
        traces.add_decisions(now, now, now < 1, now > 0, now < 0)
    heard = traces.summary([], [], [], is_known=False)
    np.testing.assert_allclose(heard.channels["a"][0], np.arange(1000, 1600) / RATE_HZ)
    np.testing.assert_array_equal(heard.channels["a"][1], volts[0, 1000:1600])
    np.testing.assert_allclose(heard.probability[0], times[(times > 0.494) & (times < 0.8)])
    np.testing.assert_allclose(heard.probability[1], heard.probability[0])
    assert heard.is_slip[0][0] == pytest.approx(0.495)


def test_the_memory_of_traces_does_not_grow_with_the_stream(rng):
    def held(seconds):
        traces = Traces({"a": 0, "b": 1}, RATE_HZ, HOP_S, (0.0, float(seconds)))
        for second in range(seconds):
            traces.add_samples(rng.standard_normal((2, 2000)).astype(np.float32))
            times = second + HOP_S * np.arange(100)
            traces.add_decisions(times, rng.random(100), times > 3, times > 0, times < 0)
        running = (traces._samples, traces._decisions)
        return sum(p.nbytes for r in running for p in [r._rest, *r._indices, *r._values])

    assert held(900) <= 1.1 * held(150)


@pytest.mark.parametrize(
    ("given", "wanted"),
    [(None, (0.0, 9.5)), ([1, 2.5], (1.0, 2.5)), ([-3, 99], (0.0, 9.5)), ((0, 9.5), (0.0, 9.5))],
)
def test_a_view_lies_within_the_recording(given, wanted):
    assert view_of(given, 9.5) == wanted


@pytest.mark.parametrize("given", ["1", 3.0, [1], [1, 2, 3], ["a", "b"], [True, 2], [None, 1]])
def test_what_is_no_view_is_refused(given):
    with pytest.raises(ValueError, match=r"view must be \[start, end\] in seconds"):
        view_of(given, 9.5)


@pytest.mark.parametrize("given", [[2, 1], [3, 3], [10, 11], [-2, -1], [math.nan, 3.0]])
def test_a_view_of_nothing_is_refused(given):
    with pytest.raises(ValueError, match=r"shows nothing of 9\.5 s"):
        view_of(given, 9.5)


@given(seed=seeds, num=st.integers(0, 30))
def testspans_and_status_are_those_of_a_loop(seed, num):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.integers(1, 4, num)).astype(float)
    on = rng.random(num) < 0.5
    end = times[-1] + 1 if num else 1.0
    wanted, since = [], None
    for time, now in zip([*times, end], [*on, False], strict=True):
        if now and since is None:
            since = time
        elif not now and since is not None:
            wanted.append((since, time))
            since = None
    found = _spans((times, on.astype(float)), end)
    assert found == wanted
    asked = rng.uniform(-1, end, 20)
    inside = [any(start <= time < stop for start, stop in wanted) for time in asked]
    np.testing.assert_array_equal(_status_at((times, on.astype(float)), asked), inside)


# The figure ------------------------------------------------------------------------------------


def heard(rng, **changes):
    """Two seconds of three films; slip is decided from 0.5 to 1.2 s, 0.2 s of it not valid.

    From 0.9 to 1 s the answer is unsure.
    """
    times = np.arange(4000) / RATE_HZ
    decided = np.round(0.07 + HOP_S * np.arange(190), 6)
    slip = (decided >= 0.5) & (decided < 1.2)
    valid = ~((decided >= 0.6) & (decided < 0.8))
    values = {
        "view": (0.0, 2.0),
        "channels": {f"PVDF{i}": (times, i + rng.standard_normal(4000)) for i in (1, 2, 3)},
        "probability": (decided, 0.9 * slip + 0.05),
        "is_slip": (decided, slip.astype(float)),
        "is_valid": (decided, valid.astype(float)),
        "abstains": (decided, ((decided >= 0.9) & (decided < 1.0)).astype(float)),
        "alarms": [(0.5, 0.43), (1.9, 1.88)],
        "onsets_s": [0.42],
        "sliding_s": [(0.42, 1.1)],
        "is_known": True,
    }
    return StreamSummary(**(values | changes))


def of(axes, gid):
    """The collection of that name."""
    (found,) = [part for part in axes.collections if part.get_gid() == gid]
    return found


def times_of(collection):
    return [float(path.vertices[0, 0]) for path in collection.get_paths()]


def stretches_of(collection):
    boxes = [path.vertices[:, 0] for path in collection.get_paths()]
    return [(pytest.approx(box.min()), pytest.approx(box.max())) for box in boxes]


def legend_of(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_films_are_blue_and_yellow_by_the_decided_status(rng):
    drawn = heard(rng)
    films, _, _ = draw_onsets(drawn, title="").axes
    for place, (times, volts) in enumerate(drawn.channels.values()):
        rest, slip = [line for line in films.lines if line.get_gid() == f"channel {place}"]
        assert (to_hex(rest.get_color()), to_hex(slip.get_color())) == (REST.lower(), SLIP.lower())
        lane = rest.get_ydata()[0] - volts[0]
        is_slip = (times >= 0.5) & (times < 1.2)
        for line, own in ((rest, ~is_slip), (slip, is_slip)):
            y = np.asarray(line.get_ydata())
            np.testing.assert_allclose(y[own], volts[own] + lane)
            assert np.isfinite(y).sum() <= own.sum() + 2  # where the colours meet, no hole
    assert [text.get_text() for text in films.get_yticklabels()] == ["PVDF1", "PVDF2", "PVDF3"]
    assert stretches_of(of(films, "slip")) == [(0.5, 1.2)]


def test_marks_stand_where_things_happened(rng):
    figure = draw_onsets(heard(rng), title="SIMULATED recording a.npz")
    films, status, chance = figure.axes
    assert figure.get_suptitle() == "SIMULATED recording a.npz"
    assert times_of(of(films, "alarm")) == [0.5, 1.9]
    assert times_of(of(films, "onset")) == times_of(of(chance, "onset")) == [0.42]
    assert times_of(of(chance, "estimate")) == [0.43, 1.88]
    (markers,) = [line for line in films.lines if line.get_marker() == "v"]
    assert list(markers.get_xdata()) == [0.5, 1.9]
    assert to_hex(of(films, "alarm").get_color()[0]) == ALARM.lower()
    for axes in (films, status, chance):
        assert stretches_of(of(axes, "invalid")) == [(0.6, 0.8)]
        assert of(axes, "invalid").get_hatch() == "////"
    assert stretches_of(of(status, f"decided {SLIP}")) == [(0.5, 1.2)]
    assert stretches_of(of(status, f"decided {REST}")) == [(0.07, 2.0)]
    assert stretches_of(of(status, f"truth {SLIP}")) == [(0.42, 1.1)]
    assert stretches_of(of(status, f"truth {REST}")) == [(0.0, 2.0)]
    line = chance.lines[0]
    np.testing.assert_allclose(line.get_ydata().max(), 0.95)
    assert line.get_drawstyle() == "steps-post"  # a decision holds until the next
    assert {"decided: slip", "onset, true", "not to be relied on"} <= set(legend_of(figure))
    assert chance.get_xlim() == (0.0, 2.0)


def test_where_it_abstains_lie_behind_the_probability_alone(rng):
    drawn = heard(rng)
    films, status, chance = draw_onsets(drawn, title="").axes
    assert stretches_of(of(chance, "abstains")) == [(0.9, 1.0)]
    assert "abstains" not in {
        part.get_gid() for axes in (films, status) for part in axes.collections
    }
    assert "abstains" in legend_of(draw_onsets(drawn, title=""))
    sure = heard(rng, abstains=(drawn.abstains[0], 0 * drawn.abstains[1]))
    assert "abstains" not in legend_of(draw_onsets(sure, title=""))


def test_what_is_out_of_view_is_not_drawn(rng):
    figure = draw_onsets(heard(rng, view=(0.45, 1.0)), title="")
    films, status, chance = figure.axes
    assert times_of(of(films, "alarm")) == [0.5]
    named = {part.get_gid() for axes in figure.axes for part in axes.collections}
    assert not {"onset", "estimate"} & named
    assert stretches_of(of(status, f"truth {SLIP}")) == [(0.45, 1.0)]
    assert chance.get_xlim() == (0.45, 1.0)


def test_without_truth_none_is_drawn(rng):
    drawn = heard(rng, onsets_s=(), sliding_s=(), is_known=False)
    figure = draw_onsets(drawn, title="")
    _, status, _ = figure.axes
    assert [text.get_text() for text in status.get_yticklabels()] == ["decided"]
    assert "onset, true" not in legend_of(figure)
    assert not any("truth" in str(part.get_gid()) for part in status.collections)
    known = draw_onsets(heard(rng, onsets_s=(), sliding_s=()), title="")  # truly no slip
    assert "truth" in [text.get_text() for text in known.axes[1].get_yticklabels()]


@pytest.mark.parametrize("level", [np.nan, 0.0, 3e38])
def test_dead_films_and_few_decisions_are_drawn_without_a_warning(tmp_path, rng, level):
    times = np.arange(100) / RATE_HZ
    one = (np.array([0.04]), np.array([0.5]))
    films = {"PVDF1": (times, np.full(100, level)), "PVDF2": (times, np.zeros(100))}
    drawn = heard(
        rng, view=(0.0, 0.05), channels=films, probability=one, is_slip=one, is_valid=one, alarms=[]
    )
    onset_figure(drawn, tmp_path / "a.png", title="")
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_the_file_is_a_picture_however_many_alarms_there_are(tmp_path, rng):
    times = rng.uniform(0, 2, 20_000)
    onset_figure(heard(rng, alarms=list(zip(times, times, strict=True))), tmp_path / "a", title="")
    with Image.open(tmp_path / "a") as image:
        assert image.format == "PNG"
        assert image.size[0] == 1440
    few, many = (
        of(draw_onsets(heard(rng, alarms=a), title="").axes[0], "alarm").get_linewidth()[0]
        for a in ([(1.0, 1.0)], [(t, t) for t in times[:200]])
    )
    assert many < few / 2


@pytest.mark.parametrize(("num", "bottom"), [(200, 0.0), (300, 0.97)])
def test_marks_that_would_hide_the_films_are_short(rng, num, bottom):
    figure = draw_onsets(heard(rng, alarms=[(t, t) for t in rng.uniform(0, 2, num)]), title="")
    films = figure.axes[0]
    paths = of(films, "alarm").get_paths()
    assert len(paths) == num
    assert {float(path.vertices[0, 1]) for path in paths} == {bottom}
    assert any(line.get_marker() == "v" for line in films.lines) == (bottom == 0)


# The counts -------------------------------------------------------------------------------------


@given(seed=seeds, num=st.integers(0, 60))
def test_alarms_end_where_a_loop_says(seed, num):
    rng = np.random.default_rng(seed)
    times = HOP_S * np.arange(1, num + 1)
    on = rng.random(num) < 0.5
    llr = rng.standard_normal(num)
    valid = rng.random(num) < 0.8
    onsets = sorted(rng.uniform(0, HOP_S * (num + 2), 3))
    alarms, was = [], False
    for time, now in zip(times, on, strict=True):
        if now and not was:
            alarms.append({"alarm_s": float(time), "end_s": None})
        if was and not now:
            alarms[-1]["end_s"] = float(time)
        was = now
    counts = DecisionCounts(onsets)
    for piece in pieces(rng, num, 7):
        own = [
            {"alarm_s": a["alarm_s"]} for a in alarms if a["alarm_s"] in set(times[piece].tolist())
        ]
        counts.add(times[piece], llr[piece], valid[piece], on[piece], own)
    assert counts.alarms == alarms
    assert (counts.num_decisions, counts.num_invalid) == (num, int((~valid).sum()))
    for onset, found in zip(onsets, counts.first_positive_s, strict=True):
        wanted = [t for t, v in zip(times, llr, strict=True) if t >= onset and v > 0]
        assert found == wanted[0] if wanted else math.isnan(found)


# The table -------------------------------------------------------------------------------------


def entry(name="a.npz", *, truth=True, **changes):
    onsets = [
        {"onset_s": 1.0, "outcome": "found", "delay_s": 0.05},
        {"onset_s": 3.0, "outcome": "early", "delay_s": None},
        {"onset_s": 5.0, "outcome": "missed", "delay_s": None},
    ]
    known = {"onsets": onsets, "false_alarms_s": [0.3], "early_s": 0.2}
    alarms = [
        {"alarm_s": t, "onset_s": t - 0.01, "end_s": t + 0.1, "score": 1.0}
        | {"probability": 0.9, "statistic": 2.0, "is_valid": t != 1.5}
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


def test_every_alarm_has_its_outcome():
    outcomes = {a["alarm_s"]: (a["outcome"], a["true_onset_s"]) for a in entry()["alarms"]}
    assert outcomes == {
        0.3: ("false", None),
        1.05: ("found", 1.0),
        1.5: ("repeated", 1.0),
        2.9: ("early", 3.0),
        5.7: ("late", 5.0),
    }
    delays = [a["delay_s"] for a in entry()["alarms"]]
    assert delays == [None, *map(pytest.approx, (0.05, 0.5, -0.1, 0.7))]


def test_rows_are_alarms_and_missed_onsets_in_order_of_time():
    rows = onset_rows({"recordings": [entry(), entry("b.npy", truth=False)]})
    assert [row["outcome"] for row in rows] == [
        *("false", "found", "repeated", "early", "missed", "late"),
        *(None,) * 5,
    ]
    assert all(tuple(row) == COLUMNS for row in rows)
    assert rows[4]["true_onset_s"] == 5.0
    assert rows[4]["alarm_s"] is None


def test_the_table_says_what_is_simulated_what_is_wrong_and_what_it_leaves_out():
    rows = onset_rows({"recordings": [entry()]})
    table = onsets_table(rows, simulated=True).splitlines()
    assert table[0].startswith("SIMULATED")
    assert table[1].split()[5:7] == ["P(slip)", "valid"]
    assert table[2].split() == ["a.npz", "0.300", "0.290", "0.90", "yes", "-", "-", "false"]
    assert table[3].split() == ["1.050", "1.040", "0.90", "yes", "1.000", "0.050", "found"]
    assert table[4].split()[3] == "NO"
    assert table[6].split() == ["-", "-", "-", "-", "5.000", "-", "missed"]
    assert "SIMULATED" not in onsets_table(rows, simulated=False)
    many = onsets_table(rows * 20, simulated=False).splitlines()
    assert many[-1] == "and 80 more, see onsets.csv"
    assert onsets_table([], simulated=False) == "no alarm, and no slip missed"


def test_the_summary_says_how_fast_how_well_and_what_cannot_be_relied_on():
    content = {"recordings": [entry()], "events": None}
    said = onsets_summary(content, 0.5)
    assert "5 alarms in 6.0 s of 1 recordings; took 0.5 s, 12 times real time" in said
    assert "0.5 % of the decisions are not valid" in said
    whole = entry(decisions={"number": 600, "invalid": 0})
    assert "not valid" not in onsets_summary(content | {"recordings": [whole]}, 0.5)
    events = {
        "num_onsets": 3,
        "num_found": 1,
        "num_early": 1,
        "num_missed": 1,
        "num_false_alarms": 1,
        "quiet_hours": 0.05,
        "delay_ms": {"median": {"value": 50.0}},
    }
    said = onsets_summary(content | {"events": events}, 0.5)
    assert (
        "of 3 slips 1 found, median delay 50.0 ms, 1 early, 1 missed; 1 false alarms in 3.00"
        in said
    )
    assert "delay" not in onsets_summary(content | {"events": events | {"delay_ms": None}}, 0.5)


def test_titles_say_what_is_simulated():
    assert onsets_title(entry(), of_simulated=True) == (
        "SIMULATED recording a.npz, material M1, 5 alarms, 1 of 3 slips found, 1 false, "
        "detector trained on simulated data"
    )
    real = entry("b.npy", truth=False, simulated=None, material=None)
    assert onsets_title(real, of_simulated=False) == "Recording b.npy, 5 alarms"
