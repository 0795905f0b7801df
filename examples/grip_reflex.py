"""A simulated grip that tightens when the alarm comes: how far the object slides until it is held.

    python -m tactslip_torch.train +exp=onset hydra.run.dir=RUN
    python examples/grip_reflex.py RUN --out grip_reflex.png

An object is pulled until it slides (``scene=pulled``), on materials and with mountings
that the training did not have, over friction and load. Three alarms of one training watch the same
samples, each at the threshold that training gave it (``metrics.json``). What is sensed is a hand
that does not react; the motion of the object in one that does is computed behind the onset, when
half of the load has let go. Everything is simulated, and the numbers of ``slid_mm`` are ours.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping
from dataclasses import fields
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from tactslip_torch import AlarmSettings, HandLayout, SlipDetector
from tactslip_torch.commands.configuration import presets
from tactslip_torch.onset.baselines import BaselineDetector
from tactslip_torch.onset.events import first_releases
from tactslip_torch.report import style
from tactslip_torch.simulation import MATERIALS, Contact
from tactslip_torch.simulation.simulate import SimulatedRecordings
from tactslip_torch.training.alarm import OURS, Timing, decide, score_streams

DETAIL, KINETIC_RATIO, REACH_MM = "largest detail", 0.85, 100.0
AT_ONCE = "alarm at the onset itself"
METHODS = {
    "CUSUM of bins (published)": (OURS, style.BLUE),
    "largest wavelet detail": (DETAIL, style.ORANGE),
    "onset alarm": (OURS, style.GREEN),
}


def slid_mm(grip_n: float, mu_s: float, speed_m_s: float, alarm_s: float) -> float:
    """How far an object slides until it is held; infinite beyond ``REACH_MM``: it is dropped.

    A weight pulls with what static friction could just hold. The sliding contact holds back with
    kinetic friction, so object (0.2 kg) and weight become faster, until the grip force rises: 10 ms
    behind the alarm, by 100 N/s, up to twice what it was.

    Args:
        grip_n: sum of the normal forces before.
        mu_s: static friction.
        speed_m_s: of the object at the onset.
        alarm_s: behind the onset; infinite for none.
    """
    step_s, pull_n = 1e-5, mu_s * grip_n
    time_s = np.arange(0.0, 1.0, step_s)
    normal_n = np.clip(grip_n + 100.0 * (time_s - alarm_s - 0.010), grip_n, 2 * grip_n)
    force_n = pull_n - KINETIC_RATIO * mu_s * normal_n
    speed = speed_m_s + np.cumsum(force_n / (0.2 + pull_n / 9.81)) * step_s
    num_moving = int((speed <= 0).argmax()) or len(speed)
    slid = 1e3 * step_s * float(speed[:num_moving].sum())
    return slid if num_moving < len(speed) and slid <= REACH_MM else math.inf


def grip_per_load(hand: HandLayout) -> float:
    """Grip force for 1 N on an element of relative load 1."""
    loads = dict(Contact().finger_loads)
    elements = {(channel.finger, channel.segment) for channel in hand.channels}
    return sum(loads.get(finger, 1.0) for finger, _ in elements)


def alarms_of(run: Path) -> tuple[SlipDetector, dict[str, AlarmSettings]]:
    """The detector that ``+exp=onset`` left in a folder, and the settings of the three alarms.

    Raises:
        ValueError: if the training was another.
    """
    detector = SlipDetector.load(run / "detector.pt")
    joint, hand = AlarmSettings.of(detector), detector.pool.hand
    metrics = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
    methods: Mapping[str, Any] = metrics.get("alarm", {}).get("methods", {})
    if joint.onset is None or DETAIL not in methods:
        raise ValueError(f"{run} has no onset alarm beside others; train with +exp=onset")
    names = [each.name for each in fields(AlarmSettings) if each.name != "onset"]
    others = [
        AlarmSettings.from_dict(
            {name: value for name, value in methods[method].items() if name in names},
            hand,
            detector.pool.sample_rate_hz,
        )
        for method in (joint.rule.name, DETAIL)
    ]
    return detector, dict(zip(METHODS, [*others, joint], strict=True))


def watch(
    detector: SlipDetector,
    alarms: Mapping[str, AlarmSettings],
    source: SimulatedRecordings,
    num_workers: int | None,
) -> list[dict[str, float]]:
    """Of every slip its speed, and how late each alarm is: infinite for none, NaN if it stood."""
    plain = BaselineDetector("largest_detail", detector.pool, detector.channel_filter)
    scorers = {OURS: detector, DETAIL: plain}
    hops = {scorer: alarms[name].hop_samples for name, (scorer, _) in METHODS.items()}
    onset = alarms["onset alarm"].onset
    streams = score_streams(source, source.ids, scorers, hops, onset, num_workers)
    slips: dict[tuple[str, int], dict[str, float]] = {}
    for name, (scorer, _) in METHODS.items():
        parts = detector.pool.bin_samples, scorers[scorer].look_ahead
        timing = Timing(detector.pool.sample_rate_hz, hops[scorer], *parts)
        for stream, made in decide(streams[scorer], alarms[name], timing):
            times, time_s = stream.times, made.available_s.numpy()
            firsts = first_releases(times.onsets_s, times.released_s)
            for place, (first_s, onset_s) in enumerate(zip(firsts, times.onsets_s, strict=True)):
                slip = slips.setdefault((str(stream.recording), place), {AT_ONCE: 0.0})
                slip["speed_m_s"] = 1e-3 * times.speeds_mm_s[place]
                is_in = (time_s >= first_s) & (time_s <= times.sliding_s[place][1])
                raised = time_s[made.is_alarm.numpy() & is_in]
                stood = bool(made.is_on.numpy()[time_s < first_s][-1:].any())
                none = math.nan if stood else math.inf
                slip[name] = float(raised[0]) - onset_s if len(raised) and not stood else none
    return list(slips.values())


@style.styled
def main(
    run: str | Path,
    out: str | Path = "grip_reflex.png",
    *,
    quick: bool = False,
    num_workers: int | None = None,
) -> list[dict[str, object]]:
    """Simulate, print a table, write a figure; a row for each load, friction and alarm."""
    detector, alarms = alarms_of(Path(run))
    hand, trained = detector.pool.hand, detector.info.get("train_materials", ())
    held_out = [name for name in MATERIALS if name not in trained] or list(MATERIALS)
    loads_n = (1.0,) if quick else (0.5, 1.0, 2.0)
    frictions = (0.4, 1.2) if quick else (0.4, 0.6, 0.8, 1.0, 1.2)
    pulled = presets()["scene"]["pulled"]
    figure = style.new_figure(
        11, 5, "A grip that tightens when the alarm comes: sliding until held", simulated=True
    )
    panels = figure.subplots(1, len(loads_n), sharey=True, squeeze=False)[0]
    colours = {name: colour for name, (_, colour) in METHODS.items()} | {AT_ONCE: style.GREY}
    rows: list[dict[str, object]] = []
    for (place, load_n), mu_s in product(enumerate(loads_n), frictions):
        source = SimulatedRecordings(
            seed=1000 + detector.info.get("seed", 0),
            cycles=1 if quick else 4,
            materials=held_out[:1] if quick else held_out,
            channels=hand.to_rows(),
            scene=pulled | {"load_n": load_n, "mu_s": mu_s, "mu_k": KINETIC_RATIO * mu_s},
        )
        slips, grip_n = watch(detector, alarms, source, num_workers), load_n * grip_per_load(hand)
        for number, (name, colour) in enumerate(colours.items()):
            own = [slip for slip in slips if not math.isnan(slip[name])]  # not where one stood
            mm = [slid_mm(grip_n, mu_s, slip["speed_m_s"], slip[name]) for slip in own] or [
                math.nan
            ]
            low, middle, high = np.quantile(mm, [0.05, 0.5, 0.95], method="inverted_cdf")
            dropped = style.percent(float(np.isinf(mm).mean()), 1)
            row = {"load N": f"{load_n:g}", "friction": f"{mu_s:g}", "alarm": name}
            row |= {"slips": str(len(own)), "of": str(len(slips)), "dropped %": dropped}
            rows.append(row | {"mm, median": f"{middle:.1f}", "95 %": f"{high:.1f}"})
            at, shown = mu_s + 0.025 * (number - 1.5), np.minimum([low, middle, high], REACH_MM)
            panels[place].vlines(at, shown[0], shown[2], color=colour, linewidth=4, alpha=0.3)
            panels[place].plot(at, shown[1], "o", color=colour, markersize=5)
        panels[place].set_title(f"{load_n:g} N an element, grip {grip_n:.1f} N")
    for panel in panels:
        panel.set(yscale="log", ylim=(0.1, 1.1 * REACH_MM), xticks=frictions)
        panel.set_xlabel("static friction")
    text = f"mm until held, median and 90 % of slips ({REACH_MM:g}: dropped)"
    panels[0].set_ylabel(text)
    handles = [Line2D([], [], color=c, linewidth=4, label=name) for name, c in colours.items()]
    style.legend_below(figure, handles, len(handles))
    print(style.marked(True, style.table(rows, num_left=3, merged=3)))
    style.save(figure, out)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", help="folder of a training with +exp=onset")
    parser.add_argument("--out", default="grip_reflex.png", help="the figure to write")
    parser.add_argument("--quick", action="store_true", help="few pulls")
    given = parser.parse_args()
    main(given.run, given.out, quick=given.quick)
