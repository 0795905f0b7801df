"""A simulated grip that tightens when the alarm comes: how far the object slides until it is held.

    python -m tactslip_torch.train +exp=onset hydra.run.dir=RUN
    python examples/grip_reflex.py RUN --out grip_reflex.png

A hand holds an object that is pulled until the contact slides: ``conf/scene/pulled.yaml``, with
surfaces that the detector was not trained on and mountings of another seed, over friction and load.
Three alarms of one training watch the same samples: its rule on bins alone, as published, the plain
threshold on the largest wavelet detail of the fast channels, and its alarm of onset and status.
Each has the threshold that training gave it (``metrics.json``).

What the hand does about an alarm cannot change what was sensed before, so the samples are those of
a hand that does not react, and the motion of the object is computed behind its onset, when half of
the load has let go (``slide``). It becomes faster than the slide that is sensed, which keeps to 20
to 60 mm/s: what a faster slide would tell a late alarm is left out. Everything is simulated; the
numbers of ``Reflex`` are ours, of no hand that exists.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray
from omegaconf import OmegaConf
from torch import Tensor

from tactslip_torch import AlarmSettings, HandLayout, Scene, SlipDetector, StreamingDetector
from tactslip_torch.commands.configuration import conf_dir
from tactslip_torch.data.recording import Recording
from tactslip_torch.onset.baselines import BaselineDetector
from tactslip_torch.onset.decisions import Decider, Decisions, is_usable, score_stream
from tactslip_torch.report import style
from tactslip_torch.runtime import in_processes
from tactslip_torch.simulation import MATERIALS, Contact
from tactslip_torch.simulation.source import SimulatedRecordings

GRAVITY_M_S2 = 9.81
PUBLISHED, PLAIN, ONSET = "CUSUM of bins (published)", "largest wavelet detail", "onset alarm"
AT_ONCE = "alarm at the onset itself"
COLOURS = {PUBLISHED: style.BLUE, PLAIN: style.ORANGE, ONSET: style.GREEN, AT_ONCE: style.GREY}
BASELINE = "largest detail"  # its name in metrics.json
_DROPPED = 1.2  # of the reach, where those are drawn that slide beyond it
_LEAST_MM = 0.1  # what lies below is not drawn
_BESIDE = {PUBLISHED: -0.025, PLAIN: 0.0, ONSET: 0.025}  # so that bars do not cover each other
VIEW_S = (-0.06, 0.16)  # around the onset, at least


# How the object moves -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Reflex:
    """What the hand does about an alarm, and what it holds. Defaults are ours.

    Args:
        object_kg: mass of the object. The weight that pulls on it, over a pulley, has its own.
        kinetic_ratio: kinetic over static friction (materials of the simulation: 0.75 to 0.95).
        delay_s: from the alarm until the grip force rises.
        rate_n_s: by which the sum of normal forces rises, in newtons a second.
        most: times the force before, at which it stays.
        reach_mm: slid so far, the object has left the hand.
    """

    object_kg: float = 0.2
    kinetic_ratio: float = 0.85
    delay_s: float = 0.010
    rate_n_s: float = 100.0
    most: float = 2.0
    reach_mm: float = 100.0


class Piece(NamedTuple):
    """Motion of constant jerk, from ``start_s`` behind the onset; metres and seconds."""

    start_s: float
    position: float
    speed: float
    acceleration: float
    jerk: float

    def at(self, time_s: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Position and speed."""
        t = np.asarray(time_s, float) - self.start_s
        _, x, v, a, j = self
        return x + t * (v + t * (a / 2 + t * j / 6)), v + t * (a + t * j / 2)

    @property
    def stop_s(self) -> float:
        """When it comes to rest, infinite if it does not."""
        _, _, v, a, j = self
        if j < 0:
            return self.start_s - (a + math.sqrt(a * a - 2 * j * v)) / j
        return self.start_s - v / a if a < 0 else math.inf


@dataclass(frozen=True)
class Slide:
    """The motion of an object behind the onset of its slip.

    Args:
        pieces: in order.
        stop_s: when it is held, infinite if it is not.
    """

    pieces: Sequence[Piece]
    stop_s: float

    def position_mm(self, time_s: ArrayLike) -> NDArray[np.float64]:
        """How far it has slid, at times behind the onset."""
        t = np.clip(np.asarray(time_s, float), 0.0, self.stop_s)
        made = [piece.at(t)[0] for piece in self.pieces]
        known = np.searchsorted([piece.start_s for piece in self.pieces], t, side="right") - 1
        return 1e3 * np.choose(known, made)

    @property
    def slid_mm(self) -> float:
        """How far it slides until it is held, infinite if it is not."""
        return float(self.position_mm(self.stop_s)) if self.stop_s < math.inf else math.inf


def slide(reflex: Reflex, *, grip_n: float, mu_s: float, speed_m_s: float, alarm_s: float) -> Slide:
    """The motion of the object from the onset on, exact: the force is piecewise linear in time.

    A weight pulls with what static friction could just hold, ``mu_s * grip_n``, and goes on doing
    so; the sliding contact holds it back with ``mu_k * N``. The grip force N rises behind the
    alarm and ``delay_s``. So object and weight accelerate until ``mu_k * N`` exceeds the pull, and
    then come to rest.

    Args:
        reflex: of the hand, and the object.
        grip_n: sum of the normal forces before.
        mu_s: static friction.
        speed_m_s: of the object at the onset.
        alarm_s: behind the onset, negative before it, infinite for no alarm.
    """
    pull_n, mu_k = mu_s * grip_n, reflex.kinetic_ratio * mu_s
    mass_kg = reflex.object_kg + pull_n / GRAVITY_M_S2
    rises_s = alarm_s + reflex.delay_s
    full_s = rises_s + (reflex.most - 1) * grip_n / reflex.rate_n_s
    pieces = list[Piece]()
    x, v = 0.0, speed_m_s
    for start_s in [0.0, *(t for t in (rises_s, full_s) if 0 < t < math.inf)]:
        if pieces:
            if (stop_s := pieces[-1].stop_s) <= start_s:
                break
            x, v = map(float, pieces[-1].at(start_s))
        is_rising = rises_s <= start_s < full_s
        risen_s = min(max(start_s, rises_s), full_s) - rises_s if rises_s < math.inf else 0.0
        normal_n = grip_n + reflex.rate_n_s * risen_s
        jerk = -mu_k * reflex.rate_n_s / mass_kg if is_rising else 0.0
        pieces.append(Piece(start_s, x, v, (pull_n - mu_k * normal_n) / mass_kg, jerk))
        stop_s = pieces[-1].stop_s
    return Slide(pieces, stop_s)


# What is sensed, and when alarms come -------------------------------------------------------------


@dataclass(frozen=True)
class Alarms:
    """The three alarms of one training.

    Args:
        detector: fitted.
        settings: of each alarm, by name.
        baseline: the scores of the plain threshold.
    """

    detector: SlipDetector
    settings: Mapping[str, AlarmSettings]
    baseline: BaselineDetector

    @classmethod
    def of_run(cls, run: Path) -> Alarms:
        """Those that a training with ``+exp=onset`` left in its folder.

        Raises:
            ValueError: if the training was another.
        """
        detector = SlipDetector.load(run / "detector.pt")
        joint, pool = AlarmSettings.of(detector), detector.pool
        told = json.loads((run / "metrics.json").read_text(encoding="utf-8"))
        methods = told.get("alarm", {}).get("methods", {})
        names = {each.name for each in fields(AlarmSettings)} - {"onset"}

        def of_bins(method: str) -> AlarmSettings:
            if method not in methods or joint.onset is None:
                raise ValueError(f"{run} has no alarm {method!r}; train with +exp=onset")
            plain = {name: value for name, value in methods[method].items() if name in names}
            return AlarmSettings.from_dict(plain, pool.hand, pool.sample_rate_hz)

        return cls(
            detector,
            {PUBLISHED: of_bins(joint.rule.name), PLAIN: of_bins(BASELINE), ONSET: joint},
            BaselineDetector("largest_detail", pool, detector.channel_filter),
        )

    def watch(self, samples: Tensor) -> dict[str, Decisions]:
        """What each alarm decides in a recording ``[C, T]``."""
        made, scorer = dict[str, Decisions](), self.baseline
        for name, settings in self.settings.items():
            if name != PLAIN:
                made[name] = StreamingDetector(self.detector, settings).push(samples.T)
                continue
            found = score_stream(scorer, samples, settings.hop_samples)
            usable = is_usable(found.score, found.is_missing, scorer.needed_index)
            parts = scorer.pool.sample_rate_hz, scorer.pool.bin_samples, scorer.look_ahead
            made[name] = Decider(settings, *parts).decide(found.score, found.is_valid, usable)
        return made


class Grasp(NamedTuple):
    """One recording of pulls."""

    load_n: float
    mu_s: float
    material: str
    cycle: int


class Pull(NamedTuple):
    """One slip; times are behind its onset.

    Attributes:
        grasp: of the recording.
        number: of the pull in it.
        onset_s: in the recording.
        first_s: when the first element lets go, at most 0.
        speed_m_s: of the object at the onset.
        alarms_s: of each method: infinite where none comes, NaN where it stood before ``first_s``.
    """

    grasp: Grasp
    number: int
    onset_s: float
    first_s: float
    speed_m_s: float
    alarms_s: dict[str, float]


@dataclass(frozen=True)
class Study:
    """Pulls over friction, load, surfaces and cycles.

    Args:
        alarms: that watch.
        loads_n: normal forces of an element of relative load 1.
        frictions: static.
        materials: surfaces; of them all but friction counts.
        cycles: recordings of each, three pulls each.
        seed: of mountings and recordings; not that of the training.
        reflex: of the hand.
    """

    alarms: Alarms
    loads_n: Sequence[float]
    frictions: Sequence[float]
    materials: Sequence[str]
    cycles: int
    seed: int
    reflex: Reflex = field(default_factory=Reflex)

    @property
    def grasps(self) -> list[Grasp]:
        """All recordings."""
        ways = product(self.loads_n, self.frictions, self.materials, range(self.cycles))
        return [Grasp(*way) for way in ways]

    def recording(self, grasp: Grasp) -> tuple[Recording, Scene]:
        """The recording, and its scene."""
        scene: Any = OmegaConf.to_container(OmegaConf.load(conf_dir() / "scene" / "pulled.yaml"))
        mu_k = self.reflex.kinetic_ratio * grasp.mu_s
        scene |= {"load_n": grasp.load_n, "mu_s": grasp.mu_s, "mu_k": mu_k}
        hand, seed = self.alarms.detector.pool.hand, self.seed
        source = SimulatedRecordings(
            seed=seed,
            cycles=self.cycles,
            materials=[grasp.material],
            channels=hand.to_rows(),
            scene=scene,
        )
        name = source.ids[grasp.cycle]
        return source.load(name), Scene.from_dict(source.key(name))

    def pulls(self, grasp: Grasp) -> list[Pull]:
        """The slips of a recording, and when their alarms come."""
        recording, scene = self.recording(grasp)
        watched = self.alarms.watch(recording.samples)
        pulls = []
        for number, (onset_s, released, sliding, stroke) in enumerate(
            zip(
                recording.onsets_s,
                recording.released_s,
                recording.sliding_s,
                scene.slides,
                strict=True,
            )
        ):
            alarms_s = {
                name: first_alarm_s(made, released[0], sliding[1]) - onset_s
                for name, made in watched.items()
            }
            speed_m_s = 1e-3 * float(stroke.speed_mm_s(np.asarray(onset_s)))
            first_s = released[0] - onset_s
            pulls.append(Pull(grasp, number, onset_s, first_s, speed_m_s, alarms_s))
        return pulls

    def slide(self, pull: Pull, method: str) -> Slide:
        """The motion of a pull's object in the hand that reacts to a method's alarm."""
        return slide(
            self.reflex,
            grip_n=pull.grasp.load_n * relative_load(self.alarms.detector.pool.hand),
            mu_s=pull.grasp.mu_s,
            speed_m_s=pull.speed_m_s,
            alarm_s=0.0 if method == AT_ONCE else pull.alarms_s[method],
        )

    def slid_mm(self, pull: Pull, method: str) -> float:
        """How far the object slides: infinite if dropped, NaN where the alarm stood before."""
        if method != AT_ONCE and math.isnan(pull.alarms_s[method]):
            return math.nan
        slid_mm = self.slide(pull, method).slid_mm
        return slid_mm if slid_mm <= self.reflex.reach_mm else math.inf


def first_alarm_s(made: Decisions, first_s: float, end_s: float) -> float:
    """The first alarm from the first release on, infinite if none; NaN where one stood before."""
    time_s = made.available_s.numpy()
    before = int(np.searchsorted(time_s, first_s))
    if before and bool(made.is_on[before - 1]):
        return math.nan
    raised = time_s[made.is_alarm.numpy() & (time_s >= first_s) & (time_s <= end_s)]
    return float(raised[0]) if len(raised) else math.inf


def relative_load(hand: HandLayout) -> float:
    """Sum of the elements' relative loads: the grip force for 1 N on an element, as scenes mean it.

    Each recording draws its elements' loads around these.
    """
    loads = dict(Contact().finger_loads)
    elements = {(channel.finger, channel.segment) for channel in hand.channels}
    return sum(loads.get(finger, 1.0) for finger, _ in elements)


# What is told of them -----------------------------------------------------------------------------


class Spread(NamedTuple):
    """Median and the quantiles that hold 90 % between them; infinite where objects drop."""

    middle: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Those of values that are not NaN; NaN of none."""
        known = [value for value in values if not math.isnan(value)]
        if not known:
            return cls(math.nan, math.nan, math.nan)
        return cls(*map(float, np.quantile(known, [0.5, 0.05, 0.95], method="inverted_cdf")))


def report(study: Study, pulls: Sequence[Pull]) -> str:
    """A table: of each load and alarm its delay, what is dropped, and millimetres by friction."""
    rows = []
    for load_n, method in product(study.loads_n, COLOURS):
        own = [pull for pull in pulls if pull.grasp.load_n == load_n]
        slid = [study.slid_mm(pull, method) for pull in own]
        delays = [0.0 if method == AT_ONCE else pull.alarms_s[method] for pull in own]
        early, num = sum(map(math.isnan, slid)), len(own)
        delay = Spread.of([1e3 * s for s in delays])
        row: dict[str, object] = {
            "load N": f"{load_n:g}",
            "alarm": method,
            "slips": num,
            "before %": style.percent(early / num, 1),
            "dropped %": style.percent(sum(map(math.isinf, slid)) / num, 1),
            "delay ms": _number(delay.middle, 0),
            "95 %": _number(delay.high, 0),
        }
        for mu_s in study.frictions:
            at_mu = zip(own, slid, strict=True)
            spread = Spread.of([mm for pull, mm in at_mu if pull.grasp.mu_s == mu_s])
            low, high = _number(spread.low), _number(spread.high)
            row[f"mm, friction {mu_s:g}"] = f"{_number(spread.middle)} [{low}, {high}]"
        rows.append(row)
    r = study.reflex
    return style.marked(
        True,
        f"{', '.join(study.materials)}, seed {study.seed}, {study.cycles} recordings each; "
        f"object {r.object_kg:g} kg, {1e3 * r.delay_s:g} ms until the grip rises by "
        f"{r.rate_n_s:g} N/s up to {r.most:g} times; dropped beyond {r.reach_mm:g} mm.",
        "before: the alarm stood before the first element let go; left out of delay and mm. "
        "mm until held: median [5 %, 95 %].",
        style.table(rows, num_left=2, merged=1),
    )


def _number(value: float, digits: int = 1) -> str:
    if math.isnan(value):
        return "-"
    return f"{value:.{digits}f}" if value < math.inf else "never"


def typical(study: Study, pulls: Sequence[Pull]) -> Pull:
    """Of the middle friction and load, the pull that is nearest to the medians of all methods."""
    load_n, mu_s = (own[len(own) // 2] for own in (study.loads_n, study.frictions))
    own = [pull for pull in pulls if (pull.grasp.load_n, pull.grasp.mu_s) == (load_n, mu_s)]
    names, reach_mm = list(study.alarms.settings), study.reflex.reach_mm
    slid = np.array([[min(study.slid_mm(pull, name), reach_mm) for name in names] for pull in own])
    away = np.abs(np.log(slid) - np.log([Spread.of(column).middle for column in slid.T]))
    return own[int(np.nan_to_num(away, nan=10.0).sum(1).argmin())]


# Figure -------------------------------------------------------------------------------------------


@style.styled
def draw(study: Study, pulls: Sequence[Pull], path: Path) -> None:
    """Write the figure: a pull on the left, all of them on the right."""
    figure = style.new_figure(
        14, 7, "A grip that tightens when the alarm comes: sliding until held", simulated=True
    )
    parts: Any = figure.subfigures(1, 2, width_ratios=[1, 1.45])
    left, right = parts
    draw_pull(left, study, typical(study, pulls))
    draw_distances(right, study, pulls)
    handles: list[Any] = [
        Line2D([], [], color=colour, linewidth=2, label=name, linestyle=_line(name))
        for name, colour in COLOURS.items()
    ]
    style.legend_below(figure, handles, len(handles))
    style.save(figure, path)


def _line(method: str) -> Any:
    return (0, (3, 2)) if method == AT_ONCE else "-"


def draw_pull(figure: Figure | SubFigure, study: Study, pull: Pull) -> None:
    """The fast channels around an onset, and how far the object slides in each hand."""
    recording, _ = study.recording(pull.grasp)
    slides = {name: study.slide(pull, name) for name in COLOURS if _has(pull, name)}
    ends_s = [own.stop_s for own in slides.values() if own.slid_mm <= study.reflex.reach_mm]
    view_s = VIEW_S[0], max([VIEW_S[1], *(end_s + 0.03 for end_s in ends_s)])
    films, motion = figure.subplots(2, 1, sharex=True)
    draw_films(films, study, pull, recording, view_s)
    time_s = np.linspace(0.0, view_s[1], 600)
    for name, own in slides.items():
        look: dict[str, Any] = {"color": COLOURS[name], "linestyle": _line(name)}
        motion.plot(1e3 * time_s, own.position_mm(time_s), linewidth=2, **look)
        if name != AT_ONCE:
            alarm_s = pull.alarms_s[name]
            alarm = 1e3 * alarm_s, float(own.position_mm(alarm_s))
            motion.plot(*alarm, "v", color=COLOURS[name], markersize=7)
        if own.slid_mm <= study.reflex.reach_mm:
            motion.plot(1e3 * own.stop_s, own.slid_mm, "o", color=COLOURS[name], markersize=5)
    lines = sorted(slides.items(), key=lambda item: -item[1].slid_mm)
    for place, (name, own) in enumerate(lines):
        is_held = own.slid_mm <= study.reflex.reach_mm
        motion.text(
            0.03 - view_s[0] / (view_s[1] - view_s[0]),
            0.94 - 0.09 * place,
            f"{own.slid_mm:.1f} mm  {name}" if is_held else f"dropped  {name}",
            transform=motion.transAxes,
            va="top",
            color=COLOURS[name],
        )
    held = [own.slid_mm for own in slides.values() if own.slid_mm <= study.reflex.reach_mm]
    motion.set_ylim(-0.03 * max([*held, 1.0]), 1.35 * max([*held, 1.0]))
    motion.set_ylabel("slid, mm")
    motion.set_xlabel("time from the onset, ms (▼ alarm, ● held)")
    motion.axvline(0, color=style.BLACK, linewidth=1)


def _has(pull: Pull, method: str) -> bool:
    return method == AT_ONCE or not math.isnan(pull.alarms_s[method])


def draw_films(
    axes: Axes, study: Study, pull: Pull, recording: Recording, view_s: tuple[float, float]
) -> None:
    """The fast channels in lanes, first release and onset, and the alarms."""
    time_s = np.arange(recording.samples.shape[-1]) / recording.sample_rate_hz - pull.onset_s
    shown = (time_s >= view_s[0]) & (time_s <= view_s[1])
    fast = study.alarms.detector.pool.hand.fast
    volts = recording.samples[list(fast)].numpy()[:, shown]
    lane = 0.45 * float(np.ptp(volts, axis=1).max())
    for place, row in enumerate(volts):
        line = row - np.median(row) - place * lane
        axes.plot(1e3 * time_s[shown], line, color=style.INK, linewidth=0.6)
    g = pull.grasp
    axes.set_title(
        f"{MATERIALS[g.material].title}, friction {g.mu_s:g}, {g.load_n:g} N an element: "
        "samples, if the hand did nothing",
    )
    axes.set_yticks([])
    axes.set_ylabel(f"{len(fast)} fast channels, {lane:.2g} V apart")
    axes.set_ylim(-(len(fast) - 0.3) * lane, 2.0 * lane)
    axes.set_xlim(1e3 * view_s[0], 1e3 * view_s[1])
    through = axes.get_xaxis_transform()
    for at_s, name, look in ((pull.first_s, "first\nrelease", ":"), (0.0, "onset", "-")):
        axes.axvline(1e3 * at_s, color=style.BLACK, linewidth=1, linestyle=look)
        side = "right" if at_s else "left"
        axes.text(
            1e3 * at_s,
            0.97,
            name.replace("\n", " \n") + " " if at_s else f" {name}",
            transform=through,
            ha=side,
            va="top",
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5},
        )
    for name, alarm_s in pull.alarms_s.items():
        if view_s[0] < alarm_s < view_s[1]:
            axes.axvline(1e3 * alarm_s, color=COLOURS[name], linewidth=1.5)
            dot: dict[str, Any] = {"color": COLOURS[name], "markersize": 7, "clip_on": False}
            axes.plot(1e3 * alarm_s, 1.0, "v", transform=through, **dot)


def draw_distances(figure: Figure | SubFigure, study: Study, pulls: Sequence[Pull]) -> None:
    """Millimetres until held and what is dropped, over friction; a column for each load."""
    num, reach_mm = len(study.loads_n), study.reflex.reach_mm
    ratios = {"height_ratios": [4, 1]}
    rows = figure.subplots(2, num, sharex=True, sharey="row", squeeze=False, gridspec_kw=ratios)
    hand = study.alarms.detector.pool.hand
    for panel, below, load_n in zip(*rows, study.loads_n, strict=True):
        for method, colour in COLOURS.items():
            slid = [
                [
                    study.slid_mm(pull, method)
                    for pull in pulls
                    if (pull.grasp.load_n, pull.grasp.mu_s) == (load_n, mu_s)
                ]
                for mu_s in study.frictions
            ]
            middle, low, high = (
                np.minimum(row, _DROPPED * reach_mm)
                for row in zip(*map(Spread.of, slid), strict=True)
            )
            if method == AT_ONCE:
                panel.plot(study.frictions, middle, color=colour, linestyle=_line(method))
                continue
            at = np.array(study.frictions) + _BESIDE[method]
            panel.vlines(at, low, high, color=colour, linewidth=5, alpha=0.3)
            panel.plot(at, middle, "o-", color=colour, linewidth=1.5, markersize=5)
            dropped = [100 * sum(map(math.isinf, own)) / len(own) for own in slid]
            below.bar(at, dropped, abs(_BESIDE[PUBLISHED]), color=colour)
        panel.axhspan(reach_mm, 10 * reach_mm, color=style.LIGHT, zorder=0)
        panel.set_title(
            f"{load_n:g} N an element, grip {load_n * relative_load(hand):.1f} N",
        )
        below.set_xticks(study.frictions)
        below.set_xlabel("static friction")
    first, below = rows[:, 0]
    first.set(yscale="log", ylim=(_LEAST_MM, _DROPPED**4 * reach_mm))
    first.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    first.set_ylabel("slid until held, mm: median and 90 % of slips")
    first.text(
        study.frictions[0],
        _DROPPED**3 * reach_mm,
        "dropped",
        ha="left",
        va="center",
    )
    below.set(ylim=(0, 100), yticks=[0, 50, 100])
    below.set_ylabel("dropped, %")


def main(
    run: str | Path,
    out: str | Path = "grip_reflex.png",
    *,
    quick: bool = False,
    num_workers: int | None = None,
) -> list[Pull]:
    """Simulate, print the table, write the figure.

    Args:
        run: folder of a training with ``+exp=onset``.
        out: the figure.
        quick: few pulls.
        num_workers: processes.

    Returns:
        Every slip.
    """
    alarms = Alarms.of_run(Path(run))
    trained = alarms.detector.info.get("train_materials", ())
    held_out = [name for name in MATERIALS if name not in trained] or list(MATERIALS)
    study = Study(
        alarms,
        loads_n=(1.0,) if quick else (0.5, 1.0, 2.0),
        frictions=(0.4, 1.2) if quick else (0.4, 0.6, 0.8, 1.0, 1.2),
        materials=held_out[:1] if quick else held_out,
        cycles=1 if quick else 4,
        seed=1000 + alarms.detector.info.get("seed", 0),
    )
    found = in_processes(study.pulls, study.grasps, "pull", "recording", num_workers)
    pulls = [pull for own in found for pull in own]
    print(report(study, pulls))
    draw(study, pulls, Path(out))
    return pulls


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", help="folder of a training with +exp=onset")
    parser.add_argument("--out", default="grip_reflex.png", help="the figure to write")
    parser.add_argument("--quick", action="store_true", help="few pulls")
    given = parser.parse_args()
    main(given.run, given.out, quick=given.quick)
