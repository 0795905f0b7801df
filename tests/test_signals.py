"""The figures of recordings: what their lines, marks and words are."""

import numpy as np
import pytest
import torch
from drawing import assert_png

from tactslip_torch.data.recording import Recording
from tactslip_torch.hand import HandLayout
from tactslip_torch.report.recordings import (
    dataset_figure,
    ranges_table,
    signals_figure,
    trials_table,
    view_around,
)

HAND = HandLayout.paper24()
CHANNELS = HAND.to_rows()
RATE_HZ = 2000.0
GAUGES, FILMS = HAND.names[:14], HAND.names[14:]
TRUTH = {
    "onsets_s": (2.0, 5.0),
    "sliding_s": ((2.0, 4.0), (5.0, 6.5)),
    "non_slip_s": ((6.75, 7.5),),
}


def recording_of(volts, onsets_s=(), sliding_s=None, **truth):
    sliding_s = [(onset, 8.0) for onset in onsets_s] if sliding_s is None else sliding_s
    samples, speeds = torch.from_numpy(volts), [20.0] * len(onsets_s)
    return Recording(samples, RATE_HZ, "M1", speeds, onsets_s, sliding_s, **truth)


def row(num_samples=16000, seed=0, **truth):
    """Noise around an offset per channel, with a burst of one sample in each."""
    rng = np.random.default_rng(seed)
    volts = 0.01 * rng.standard_normal((24, num_samples)) + np.linspace(-1, 2, 24)[:, None]
    volts[np.arange(24), rng.integers(0, num_samples, 24)] += 0.7
    return recording_of(volts, **truth)


@pytest.fixture
def draw(drawn, tmp_path):
    """Draws recordings; their figure."""

    def drawing(*recordings, channels=CHANNELS, views=None):
        rows = list(zip(("M1", "M6"), recordings, strict=False))
        signals_figure(rows, channels, tmp_path / "a.png", title="SIMULATED", views=views)
        assert_png(tmp_path / "a.png")
        return drawn[-1]

    return drawing


def lines_of(axes):
    """Lines of channels: those with a channel's name."""
    return {line.get_label(): line for line in axes.lines if line.get_label() in HAND.names}


def test_gauges_stand_left_films_right_one_recording_a_row_with_every_extreme(draw):
    recording = row()
    figure = draw(recording, row(seed=1))
    panels = np.array(figure.axes).reshape(2, 3)
    for (measured, gauges, films), name in zip(panels, ("M1", "M6"), strict=True):
        assert measured.get_ylabel() == f"{name}\nvolts"
        assert tuple(lines_of(measured)) == tuple(lines_of(gauges)) == GAUGES
        assert tuple(lines_of(films)) == FILMS
        assert [label.get_text() for label in films.get_yticklabels()] == list(FILMS)
        assert (np.diff(films.get_yticks()) == -1).all()  # the first lane on top
    assert figure.get_suptitle() == "SIMULATED"
    scales = {}
    for own, name in zip(recording.samples.numpy(), HAND.names, strict=True):
        if name in GAUGES:
            line = lines_of(panels[0, 0])[name]
            assert np.isin(line.get_ydata(), own).all()
        panel = panels[0, 1 if name in GAUGES else 2]
        lane = lines_of(panel)[name].get_ydata()
        scale = np.ptp(own) / np.ptp(lane)  # the burst is there, all lanes on one scale
        assert scale == pytest.approx(scales.setdefault(panel, scale), rel=1e-9)
        assert panel.get_title(loc="right") == f"lanes {scale:.2g} V apart"
        assert len(lane) < len(own) / 5


def test_quiet_and_missing_channels_are_drawn_without_a_warning(draw):
    recording = row(num_samples=2000)
    recording.samples[3] = torch.nan
    recording.samples[14:] = 0.25
    recording.samples[20, 100:200] = torch.inf
    _, gauges, films = draw(recording).axes
    assert np.isnan(lines_of(gauges)[HAND.names[3]].get_ydata()).all()
    assert np.isnan(lines_of(films)[HAND.names[20]].get_ydata()).sum() == 100


@pytest.mark.parametrize(
    ("view", "onsets", "spans"),
    [(None, [2.0, 5.0], [(2.0, 4.0), (5.0, 6.5), (6.75, 7.5)]), ((3.0, 4.5), [], [(3.0, 4.0)])],
)
def test_onsets_are_marked_and_slides_and_handling_shaded_as_far_as_in_view(
    draw, view, onsets, spans
):
    figure = draw(row(**TRUTH), views=view and [view])
    for axes in figure.axes:
        marks = [line for line in axes.lines if line.get_linestyle() == "-."]
        assert [line.get_xdata()[0] for line in marks] == onsets
        ends = [(p.get_x(), p.get_x() + p.get_width()) for p in axes.patches]
        assert ends == [pytest.approx(span) for span in spans]
        assert axes.get_xlim() == (view or (0.0, 8.0))
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words[:5] == ["little", "ring", "middle", "index", "thumb"]
    assert words[-3:] == ["onset of slip", "slip", "non-slip"]


@pytest.mark.parametrize(
    ("truth", "stroke", "view"),
    [
        ({"onsets_s": (2.5, 5.0)}, 1, (0.5, 5.5)),
        ({"onsets_s": (2.5, 5.0)}, 7, (3.0, 8.0)),
        ({"onsets_s": (1.0, 7.0)}, 1, (0.0, 4.0)),
        ({"onsets_s": (4.0,), "non_slip_s": ((1.0, 2.0),)}, 1, (2.0, 7.0)),
        ({"non_slip_s": ((2.5, 3.0), (4.5, 5.0))}, 2, (2.5, 7.5)),
        ({}, 1, (0.0, 8.0)),
    ],
)
def test_five_seconds_around_a_stroke(truth, stroke, view):
    assert view_around(row(**truth), stroke, 2.0, 3.0) == view


# What a set holds --------------------------------------------------------------------------------
KNOWN = ("material", "scene", "duration_s", "slip_s", "non_slip_s", "num_onsets")
TRIALS = [
    dict(zip(KNOWN, known, strict=True))
    for known in (("wood", "paper", 8.0, 3.5, 0.75, 2), ("iron", "paper", 9.0, 10.0, 0.0, 1))
]


@pytest.mark.parametrize("level", [1.0, np.nan])
def test_a_set_is_drawn_by_material_above_the_traces_of_a_recording(drawn, tmp_path, level):
    recording = row(**TRUTH)
    recording.samples[:] *= level
    names = [f"E{i}" for i in range(40)]
    wide = recording_of(np.tile(recording.samples, (2, 1))[:40], **TRUTH)
    for example, of in ((recording, HAND.names), (wide, names)):
        dataset_figure(TRIALS, ("w/0", example), of, tmp_path / "a.png", title="a set")
    bars, traces = drawn[0].axes
    assert [label.get_text() for label in bars.get_yticklabels()] == ["wood", "iron"]
    widths = [patch.get_width() for patch in bars.patches]
    assert widths == pytest.approx([3.5, 0.75, 3.75, 10.0, 0.0, 0.0])  # labelled more than there is
    assert len(traces.get_yticklabels()) == 24
    assert "24 of 40 channels" in drawn[1].axes[1].get_title("left")


def test_tables_of_a_set():
    taps = ("wood", "taps", 4.0, 0.0, 0.0, 0)
    both = trials_table([*TRIALS, dict(zip(KNOWN, taps, strict=True))], simulated=True)
    assert both.startswith("SIMULATED")
    rows = [line.split() for line in both.splitlines()]
    assert ["wood", "2", "4.00", "8.00", "12.0", "2", "3.5", "0.8"] in rows
    assert ["taps", "1", "4.00", "4.00", "4.0", "0", "0.0", "0.0"] in rows
    assert len(trials_table(TRIALS[:1], simulated=False).splitlines()) == 2  # no sum of one row
    ranges = np.stack([np.full(24, -1.5), np.arange(24.0)], 1)
    ranges[14:] = np.nan
    rows = [line.split() for line in ranges_table(CHANNELS, ranges, "V").splitlines()]
    assert rows[1:] == [["SG", "14", "-1.5", "13"], ["PVDF", "10", "nan", "nan"]]
