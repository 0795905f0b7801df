"""The figure of recordings: what its lines, marks and words are."""

import numpy as np
import pytest
import torch
from matplotlib.colors import to_rgba
from PIL import Image

from tactslip_torch.hand import Channel, HandLayout
from tactslip_torch.report.onset import lane_height
from tactslip_torch.report.recordings import (
    DrawnRecording,
    channel_colours,
    draw_signals,
    signals_figure,
)

HAND = HandLayout.paper24()
CHANNELS = HAND.to_rows()
RATE_HZ = 2000.0
GAUGES, FILMS = HAND.names[:14], HAND.names[14:]


def row(title="M1", num_samples=16000, seed=0, **truth):
    """Noise around an offset per channel, with a burst of one sample in each."""
    rng = np.random.default_rng(seed)
    volts = 0.01 * rng.standard_normal((24, num_samples)) + np.linspace(-1, 2, 24)[:, None]
    volts[np.arange(24), rng.integers(0, num_samples, 24)] += 0.7
    return DrawnRecording(title, torch.from_numpy(volts), RATE_HZ, **truth)


def lines_of(axes):
    """Lines of channels: those with a channel's name."""
    return {line.get_label(): line for line in axes.lines if line.get_label() in HAND.names}


def spans_of(axes):
    """Start and end of every shaded stretch, with its colour."""
    return [(p.get_x(), p.get_x() + p.get_width(), p.get_facecolor()) for p in axes.patches]


def lasting(axes):
    """Times of the onset lines."""
    return [line.get_xdata()[0] for line in axes.lines if line.get_linestyle() == "-."]


# What is drawn -------------------------------------------------------------------------------


def test_gauges_stand_left_films_right_one_recording_a_row():
    figure = draw_signals([row("M1"), row("M6", seed=1)], CHANNELS, title="SIMULATED, kinematic")
    panels = np.array(figure.axes).reshape(2, 3)
    for recording, name in zip(panels, ("M1", "M6"), strict=True):
        assert recording[0].get_ylabel() == f"{name}\nvolts"
        assert tuple(lines_of(recording[0])) == tuple(lines_of(recording[1])) == GAUGES
        assert tuple(lines_of(recording[2])) == FILMS
    assert [axes.get_title().split(",")[0] for axes in panels[0]] == ["SG", "SG", "PVDF"]
    assert {axes.get_xlabel() for axes in panels[1]} == {"time, s"}
    assert figure.get_suptitle() == "SIMULATED, kinematic"


def test_lines_hold_the_samples_and_their_extremes():
    drawn = row()
    figure = draw_signals([drawn], CHANNELS, title="")
    measured, gauges, films = figure.axes
    volts, scales = drawn.samples.numpy(), {}
    for index, name in enumerate(HAND.names):
        own = volts[index]
        if name in GAUGES:
            line = lines_of(measured)[name]
            places = np.rint(line.get_xdata() * RATE_HZ).astype(int)
            np.testing.assert_array_equal(line.get_ydata(), own[places])
            assert (line.get_ydata().min(), line.get_ydata().max()) == (own.min(), own.max())
            assert (places[0] < 20, places[-1] > len(own) - 20) == (True, True)
        panel = gauges if name in GAUGES else films
        lane = lines_of(panel)[name].get_ydata()
        scale = np.ptp(own) / np.ptp(lane)  # the burst is there, all lanes on one scale
        assert scale == pytest.approx(scales.setdefault(panel, scale), rel=1e-12)
        assert len(lane) < len(own) / 5


def test_lanes_have_their_offset_removed_and_one_scale():
    drawn = row()
    films = draw_signals([drawn], CHANNELS, title="").axes[2]
    ticks = dict(
        zip([t.get_text() for t in films.get_yticklabels()], films.get_yticks(), strict=True)
    )
    assert tuple(ticks) == FILMS
    steps = np.diff([ticks[name] for name in FILMS])
    np.testing.assert_allclose(steps, steps[0])
    assert steps[0] < 0  # the first lane on top
    for name in FILMS:
        middle = np.median(lines_of(films)[name].get_ydata())
        assert middle == pytest.approx(ticks[name], abs=0.05)
    (bar,) = [line for line in films.lines if line.get_linewidth() == 2]
    (words,) = [text.get_text() for text in films.texts]
    height = lane_height(list(drawn.samples[14:].numpy()))
    assert words == f"{height * np.ptp(bar.get_ydata()):g} V"
    assert set(words) <= set("0125. V")


def test_quiet_and_missing_channels_are_drawn_without_a_warning():
    drawn = row(num_samples=2000)
    drawn.samples[3] = torch.nan
    drawn.samples[14:] = 0.25
    drawn.samples[20, 100:200] = torch.inf
    _, gauges, films = draw_signals([drawn], CHANNELS, title="").axes
    assert np.isnan(lines_of(gauges)[HAND.names[3]].get_ydata()).all()
    lanes = lines_of(films)
    assert all(np.nanmax(np.ptp(lanes[name].get_ydata()[:50])) == 0 for name in FILMS)
    assert np.isnan(lanes[HAND.names[20]].get_ydata()).sum() == 100


def test_onsets_are_marked_and_slides_and_handling_shaded_apart():
    truth = {
        "onsets_s": (2.125, 5.0),
        "slip_s": ((2.125, 4.0), (5.0, 6.5)),
        "non_slip_s": ((6.75, 7.5),),
    }
    figure = draw_signals([row(**truth)], CHANNELS, title="")
    for axes in figure.axes:
        assert lasting(axes) == [2.125, 5.0]
        (first, second, handled) = spans_of(axes)
        assert first[:2] == pytest.approx((2.125, 4.0))
        assert second[:2] == pytest.approx((5.0, 6.5))
        assert handled[:2] == pytest.approx((6.75, 7.5))
        assert first[2] == second[2] != handled[2]
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert words[:5] == ["little", "ring", "middle", "index", "thumb"]
    assert words[-3:] == ["onset of slip", "slip", "non-slip"]


def test_a_view_shows_its_stretch_alone():
    truth = {"onsets_s": (2.0, 5.0), "slip_s": ((2.0, 4.0), (5.0, 6.5))}
    drawn = row(**truth)
    axes = draw_signals([drawn], CHANNELS, title="", views=[(3.0, 4.5)]).axes[0]
    assert axes.get_xlim() == (3.0, 4.5)
    assert lasting(axes) == []
    assert [span[:2] for span in spans_of(axes)] == [pytest.approx((3.0, 4.0))]
    for line in lines_of(axes).values():
        assert line.get_xdata().min() >= 3.0
        assert line.get_xdata().max() < 4.5


@pytest.mark.parametrize(
    ("truth", "stroke", "view"),
    [
        ({"onsets_s": (2.5, 5.0)}, 1, (0.5, 5.5)),
        ({"onsets_s": (2.5, 5.0)}, 2, (3.0, 8.0)),
        ({"onsets_s": (2.5, 5.0)}, 7, (3.0, 8.0)),
        ({"onsets_s": (1.0, 7.0)}, 1, (0.0, 4.0)),
        ({"onsets_s": (1.0, 7.0)}, 2, (5.0, 8.0)),
        ({"onsets_s": (4.0,), "non_slip_s": ((1.0, 2.0),)}, 1, (2.0, 7.0)),
        ({"non_slip_s": ((2.5, 3.0), (4.5, 5.0))}, 2, (2.5, 7.5)),
        ({}, 1, (0.0, 8.0)),
    ],
)
def test_five_seconds_around_a_stroke(truth, stroke, view):
    slides = tuple((onset, onset + 0.5) for onset in truth.get("onsets_s", ()))
    assert row(slip_s=slides, **truth).around(stroke, 2.0, 3.0) == view


def test_fingers_are_told_apart_by_colour_and_segments_by_paleness():
    colours = dict(zip(HAND.names, channel_colours(CHANNELS), strict=True))
    assert len(set(colours.values())) == 14  # a gauge and a film of one place share theirs
    assert sum(colours["SG1"]) < sum(colours["SG2"]) < sum(colours["SG3"])
    assert colours["SG1"] == colours["PVDF1"]
    full = [to_rgba(colours[name])[:3] for name in ("SG1", "SG4", "SG7", "SG10", "SG13")]
    apart = [np.abs(np.subtract(a, b)).sum() for i, a in enumerate(full) for b in full[:i]]
    assert min(apart) > 0.3


def test_other_kinds_stand_in_columns_by_how_they_adapt():
    ways = {"electrode": "fast", "force": "slow", "SG": None, "PVDF": None}
    channels = [
        Channel(f"{kind}{i}", kind, "index", "distal", way)
        for i in range(2)
        for kind, way in ways.items()
    ]
    volts = torch.randn(8, 200)
    rows = HandLayout(channels).to_rows()
    axes = draw_signals([DrawnRecording("a", volts, RATE_HZ, units="counts")], rows, title="").axes
    kinds = ["force", "force", "SG", "SG", "electrode", "PVDF"]
    assert [one.get_title().split(",")[0] for one in axes] == kinds
    for one, kind in zip(axes, kinds, strict=True):
        names = [line.get_label() for line in one.lines]
        assert [name for name in names if name.startswith(kind)] == [f"{kind}0", f"{kind}1"]
    assert axes[0].get_ylabel() == "a\ncounts"
    assert {text.get_text().split()[1] for one in axes for text in one.texts} == {"counts"}


def test_rows_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="no recording to draw"):
        draw_signals([], CHANNELS, title="")
    with pytest.raises(ValueError, match="M1 has 3 channels, not 24"):
        draw_signals([DrawnRecording("M1", torch.zeros(3, 200), RATE_HZ)], CHANNELS, title="")
    with pytest.raises(ValueError, match="views must be one per row, got 0 for 1"):
        draw_signals([row()], CHANNELS, title="", views=[])


def test_the_file_is_a_small_picture_of_the_figure(tmp_path):
    path = tmp_path / "signals.png"
    path.write_bytes(b"before")
    rows = [row(f"M{i}", 30000, i, onsets_s=(3.0,), slip_s=((3.0, 9.0),)) for i in range(1, 7)]
    signals_figure(rows, CHANNELS, path, title="SIMULATED")
    assert path.stat().st_size < 1e6
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"), dtype=int).reshape(-1, 3)
    for colour in channel_colours(CHANNELS)[:1]:
        wanted = np.rint(255 * np.array(colour))
        assert (np.abs(pixels - wanted).max(axis=1) < 12).sum() > 1000
    assert list(tmp_path.iterdir()) == [path]
