"""Set alarm and threshold on recordings of use: ``tactslip calibrate model=detector.pt ...``.

Recordings without slip set the alarm for a rate of false alarms, labelled ones with slip the
decision threshold. With ``refit=true`` the detector is fitted again before, to its training bins
and the labelled recordings. Leaves ``detector.pt``, ``calibration.json`` and ``calibration.png``; a
detector that would be worse on recordings left out is not written.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from hydra.utils import instantiate
from omegaconf import DictConfig

from tactslip_torch.commands.entry import entry_point, save_config
from tactslip_torch.data.labels import LabelRule
from tactslip_torch.data.recording import RecordingId, RecordingSource, Timeline
from tactslip_torch.features.cache import cache_key
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import AlarmSettings
from tactslip_torch.onset.rules import Budget
from tactslip_torch.report.calibration import calibration_figure, calibration_table, pooled_outcome
from tactslip_torch.runtime import bar, check_number, check_share, plain, whole_file, write_json
from tactslip_torch.training.alarm import OURS, Stream, Timing, score_streams
from tactslip_torch.training.bins import RecordingBins
from tactslip_torch.training.calibrate import (
    Calibrator,
    Change,
    ScoredRecording,
    held_out_accuracy,
    in_stretches,
    left_out_folds,
)
from tactslip_torch.training.refit import BINS, KeptBins

_FEW_SLIPS, _FEW_RECORDINGS, _NUM_STRETCHES = 30, 3, 10
_NUM_CELLS = 60  # of a histogram


def calibrate(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Calibrate the detector of ``config.model``; write it if it is better for that.

    Args:
        config: composed from ``conf/calibrate.yaml``.
        folder: where results go.

    Returns:
        The content of ``calibration.json``.

    Raises:
        ValueError: for bad input, or too few hours for the rate, in one line.
        FileNotFoundError: if there is no such detector.
    """
    detector = SlipDetector.load(config.model)
    settings, pool = AlarmSettings.of(detector), detector.pool
    for name in ("slip_free", "use_trained", "refit"):
        if type(config[name]) is not bool:
            raise ValueError(f"{name} must be true or false, got {config[name]!r}")
    if config.per_hour is not None:
        check_number("per_hour", config.per_hour)
    check_share("confidence", config.confidence)
    if "channels" in config.data and config.data.channels is None:
        config.data.channels = pool.hand.to_rows()
    source: RecordingSource = instantiate(config.data, _convert_="all")
    _check_hand(detector, source)
    timing = Timing(
        pool.sample_rate_hz, settings.hop_samples, pool.bin_samples, detector.look_ahead
    )
    calibrator = Calibrator(
        settings, timing, instantiate(config.labels), config.per_hour, config.confidence
    )
    kept = _kept_bins(config, detector) if config.refit else None
    times = _labelled(config, detector, source)
    _check_hours(calibrator, times)
    save_config(config, folder)
    scoring = _Scoring(source, times, config.num_workers)
    new = _new_bins(kept, detector, calibrator.rule, scoring) if kept else {}
    use = _Use(detector, calibrator, scoring.recordings(calibrator, list(times), detector))
    origin: dict[str, Any] = {
        "simulated": source.is_simulated,
        "date": datetime.now(UTC).date().isoformat(),
        "model": str(config.model),
        "hours": sum(one.hours for one in use.recordings),
        "recordings": {str(one): cache_key(source.key(one)) for one in times},
        "trained_on": bool(config.use_trained),
    }
    before, refit = use, None
    if kept is not None:
        use, kept, refit = _refitted(use, kept, new, scoring)
    detector, calibrator, recordings = use
    report, change = _calibrated(calibrator, recordings)
    if refit is not None and refit["is_set"]:
        report["left_out"] = _rows_of_refit(before, report["left_out"], change is not None)
        change = change or Change(0.0, None, calibrator.settings)
        detector.info |= _trained_on(detector, origin["recordings"], times)
        detector.info["refitted"] = plain(origin | refit)
    report = {**origin, **({"refit": refit} if refit else {}), **report}
    print("\n" + calibration_table(report["left_out"], simulated=report["simulated"]))
    _tell(report)
    write_json(folder / "calibration.json", plain(report))
    calibration_figure(report, folder / "calibration.png")
    if change is None:
        print(f"the detector stays as it is, {config.model}; no detector is written")
        return report
    alarm = report.get("alarm", {})
    curve = [point[:2] for point in alarm.get("curve", ())] if alarm.get("is_set") else ()
    more = {"threshold_curve": curve} if curve else {}
    calibrator.apply(change, detector, more | {"simulated": report["simulated"]})
    stated = ("per_hour", "confidence", "hours", "dispersion", "alarms", "bound")
    detector.info["calibrated"] = plain(
        origin
        | {"alarm": {name: alarm[name] for name in stated} if alarm.get("is_set") else None}
        | {"decision_threshold_moved_by": change.shift}
    )
    _keep_bins(kept, detector, Path(config.model).with_name(BINS), folder / BINS)
    detector.save(folder / "detector.pt")
    print(f"calibrated detector: {folder / 'detector.pt'}")
    return report


class _Use(NamedTuple):
    """A detector, what calibrates it, and recordings as one that had not seen them scored them."""

    detector: SlipDetector
    calibrator: Calibrator
    recordings: list[ScoredRecording]


class _Scoring(NamedTuple):
    """Recordings to be scored, with what is known of them."""

    source: RecordingSource
    times: Mapping[RecordingId, Timeline]
    num_workers: int | None

    def streams(
        self, calibrator: Calibrator, some: Sequence[RecordingId], detector: SlipDetector
    ) -> list[Stream]:
        """Some of the recordings as a detector scores them."""
        settings = calibrator.settings
        hops, onset = {OURS: settings.hop_samples}, settings.onset
        scored = score_streams(self.source, some, {OURS: detector}, hops, onset, self.num_workers)
        return [one._replace(times=self.times[one.recording]) for one in scored[OURS]]

    def recordings(
        self, calibrator: Calibrator, some: Sequence[RecordingId], detector: SlipDetector
    ) -> list[ScoredRecording]:
        """The same, to be calibrated on."""
        streams = self.streams(calibrator, some, detector)
        return [calibrator.scored(one) for one in _cut(streams, calibrator.timing)]


# The refit ---------------------------------------------------------------------------------------


def _kept_bins(config: DictConfig, detector: SlipDetector) -> KeptBins:
    """The training bins beside a detector that can be fitted again.

    Raises:
        ValueError: if there are none, or more must be said.
    """
    if config.use_trained:
        raise ValueError("refit=true adds recordings; leave use_trained at false")
    rate = AlarmSettings.of(detector).target_per_hour
    if config.per_hour is None and rate is not None:
        raise ValueError(
            f"the alarm is set for {rate:g} false alarms an hour, and a refit changes that rate; "
            "give per_hour=RATE, and recordings without slip, to set it again"
        )
    return KeptBins.load(Path(config.model).with_name(BINS), detector)


def _new_bins(
    kept: KeptBins, detector: SlipDetector, rule: LabelRule, scoring: _Scoring
) -> dict[RecordingId, RecordingBins]:
    """Labelled bins of the recordings that a refit adds.

    Raises:
        ValueError: if recordings are too few to leave some out.
    """
    source, times, num_workers = scoring
    new = kept.recordings(detector, source, rule, times, num_workers)
    is_slip = torch.cat([bins.is_slip for bins in new.values()])
    num_slip = int(is_slip.sum())
    if len(new) < 2 or not 0 < num_slip < len(is_slip):
        raise ValueError(
            "a refit is tested on new recordings, each left out in turn: it needs two or more with "
            f"labels, with slip and without; got {len(new)}, with {num_slip} bins of slip and "
            f"{len(is_slip) - num_slip} without"
        )
    return new


def _refitted(
    use: _Use, kept: KeptBins, new: Mapping[RecordingId, RecordingBins], scoring: _Scoring
) -> tuple[_Use, KeptBins | None, dict[str, Any]]:
    """The detector refitted, if that is better on what is left out, with its bins; what came of it.

    Each recording is scored by a refit without it, so that thresholds can be set by these scores.
    """
    detector, calibrator, _ = use
    times = scoring.times
    made, kept_then = kept.refitted(detector, new.values())
    then = replace(calibrator, settings=AlarmSettings.of(made))
    masks, _ = left_out_folds([one.material for one in times])
    scored = dict[RecordingId, Stream]()
    for mask in bar(masks, "refit, recordings left out", "fold"):
        out = [one for one, is_out in zip(times, mask, strict=True) if is_out]
        without, _ = kept.refitted(detector, [bins for one, bins in new.items() if one not in out])
        scored |= zip(out, scoring.streams(then, out, without), strict=True)
    streams = _cut([scored[one] for one in times], then.timing)
    after = _Use(made, then, [then.scored(one) for one in streams])
    old, better = (held_out_accuracy(of.recordings) for of in (use, after))
    report = {
        "is_set": better > old,
        "before": old,
        "after": better,
        "new_objects_before": detector.info.get("validated"),
        "new_objects_after": made.info["validated"],
        "num_groups": [len(of.sample.group_names) for of in (kept, kept_then)],
        "added_bins": sum(len(bins.is_slip) for bins in new.values()),
        "kept_bins": len(kept.sample.is_slip),
        "groups": _by_group(use, after),
    }
    return (after, kept_then, report) if better > old else (use, None, report)


def _by_group(before: _Use, after: _Use) -> list[dict[str, Any]]:
    """Balanced accuracy on each group before and after, both thresholds at 0."""
    pairs = (_rows(use.calibrator, use.recordings, _unchanged(use)) for use in (before, after))
    found = []
    for old, new in zip(*pairs, strict=True):
        found.append(old | {"after": new["after"]})
    rows = []
    for group in dict.fromkeys(row["group"] for row in found):
        own = [row for row in found if row["group"] == group]
        ends = (pooled_outcome(row[when] for row in own) for when in ("before", "after"))
        old, new = (end["balanced_accuracy"] for end in ends)
        rows.append({"group": group, "before": old, "after": new})
    return rows


def _rows_of_refit(
    before: _Use, rows: Sequence[Mapping[str, Any]], is_moved: bool
) -> list[dict[str, Any]]:
    """Rows of a refitted detector that say what the old one made of the recordings."""
    old = _rows(before.calibrator, before.recordings, _unchanged(before))
    when = "after" if is_moved else "before"  # no threshold of the refitted one is moved
    return [mine | {"after": row[when]} for mine, row in zip(old, rows, strict=True)]


def _unchanged(use: _Use) -> list[Change]:
    return [Change(0.0, None, use.calibrator.settings)] * len(use.recordings)


def _trained_on(
    detector: SlipDetector, recordings: Mapping[str, str], times: Mapping[RecordingId, Timeline]
) -> dict[str, Any]:
    """What ``info`` says of the training recordings, with those that were added."""
    info, known = detector.info, dict(detector.info.get("train_recordings", {}))
    for name, key in recordings.items():
        while name in known:
            name += " (refit)"
        known[name] = key
    materials = {*info.get("train_materials", ()), *(one.material for one in times)}
    sessions = {*info.get("train_sessions", ()), *(one.session or "1" for one in times)}
    return {
        "train_recordings": known,
        "train_materials": sorted(materials),
        "train_sessions": sorted(sessions),
    }


def _keep_bins(kept: KeptBins | None, detector: SlipDetector, old: Path, new: Path) -> None:
    """Leave bins beside a written detector: those of the refit, else those of the old one."""
    if kept is not None:
        kept.written_with(detector).save(new)
    elif old.is_file() and not (new.exists() and new.samefile(old)):
        with whole_file(new) as temporary:
            shutil.copyfile(old, temporary)


# What is given -----------------------------------------------------------------------------------


def _check_hand(detector: SlipDetector, source: RecordingSource) -> None:
    """Refuse recordings of another hand, rate or unit."""
    pool, units = detector.pool, getattr(source, "units", "V")
    pairs: list[tuple[str, object, object]] = [
        ("channels", list(source.hand.names), list(pool.hand.names)),
        ("sample rate in Hz", source.sample_rate_hz, pool.sample_rate_hz),
        ("unit", units, detector.info.get("units", "V")),
    ]
    for what, given, wanted in pairs:
        if given != wanted:
            raise ValueError(
                f"the recordings have another {what} than the detector: {given}, not {wanted}; "
                "read them as for training (data.channels, data.reading, data.units)"
            )


def _labelled(
    config: DictConfig, detector: SlipDetector, source: RecordingSource
) -> dict[RecordingId, Timeline]:
    """The recordings to calibrate on, with what is known of them; notes on the others.

    Raises:
        ValueError: if none is left.
    """
    known = set(detector.info.get("train_recordings", {}).values())
    found, trained, unlabelled = dict[RecordingId, Timeline](), 0, 0
    for one in source.ids:
        times = source.timeline(one)
        if not times.has_stretches:
            if not (config.slip_free or source.is_simulated):
                unlabelled += 1
                continue
            times = replace(times, non_slip_s=((0.0, times.duration_s),))
        if not config.use_trained and cache_key(source.key(one)) in known:
            trained += 1
            continue
        found[one] = times
    if unlabelled:
        print(
            f"note: {unlabelled} recordings have no label and are left out; if nothing slips in "
            "them, say slip_free=true"
        )
    if trained:
        print(f"note: {trained} recordings are left out, as the detector was trained on them")
    if not found:
        remedy = "label them, or say slip_free=true"
        if trained:
            remedy = "record others, or say use_trained=true, with which the stated rate is too low"
        raise ValueError(f"no recording is left to calibrate on: {remedy}")
    return found


def _check_hours(calibrator: Calibrator, times: Mapping[RecordingId, Timeline]) -> None:
    """Say how many hours the rate needs and what those given can show; refuse too few."""
    hours = sum(end - start for of in times.values() for start, end in of.non_slip_s) / 3600
    num = sum(bool(of.non_slip_s) for of in times.values())
    if calibrator.per_hour is None:
        if not any(of.onsets_s or of.slip_s for of in times.values()):
            raise ValueError(
                "nothing to set: give per_hour=RATE for the alarm, or labelled recordings with "
                "slip for the decision threshold"
            )
        return
    budget = calibrator.budget()
    rate, confidence = calibrator.per_hour, calibrator.confidence
    need = f"at most {rate:g} false alarms an hour with a confidence of {confidence:g}"
    least = budget.bound(0, 1.0) / rate
    if not hours:
        raise ValueError(
            f"{need} need at least {least:.2g} h without slip, and no recording is labelled "
            "non-slip; label some, or say slip_free=true if they have no label"
        )
    best = budget.bound(0, hours)
    line = (
        f"{need} need at least {least:.3g} h without slip, with no alarm in them; given: "
        f"{hours:.3g} h in {num} recordings, which can show {best:.3g} an hour at best"
    )
    if best > rate:
        raise ValueError(f"{line}; record more, or give a larger per_hour")
    print(line)


def _cut(streams: Sequence[Stream], timing: Timing) -> list[Stream]:
    """Streams; where few have time without slip, those of it alone in stretches to leave out."""
    quiet = [one for one in streams if one.times.non_slip_s]
    if len(quiet) >= _FEW_RECORDINGS:
        return list(streams)
    found = []
    for one in streams:
        is_quiet = not (one.times.onsets_s or one.times.slip_s)
        found += in_stretches(one, timing, _NUM_STRETCHES) if is_quiet else [one]
    return found


def _calibrated(
    calibrator: Calibrator, recordings: Sequence[ScoredRecording]
) -> tuple[dict[str, Any], Change | None]:
    """What is reported, and what changes of the detector; ``None``: nothing is better."""
    settings, report = calibrator.settings, dict[str, Any]()
    budget = _bunched_budget(calibrator, recordings)
    num_slip = sum(int(one.is_slip.sum()) for one in recordings)
    moves_bins = 0 < num_slip < sum(len(one.is_slip) for one in recordings)
    if budget is None and not moves_bins:
        side, other = ("slip", "non-slip") if num_slip else ("non-slip", "slip")
        raise ValueError(
            f"nothing to set: all labelled bins are {side}; label {other} as well, or give "
            "per_hour=RATE for the alarm"
        )
    change = calibrator.fit(recordings, budget, moves_bins=moves_bins)
    changes, words = calibrator.left_out(recordings, change, budget)
    rows = _rows(calibrator, recordings, changes)
    old, new = (pooled_outcome(row[when] for row in rows) for when in ("before", "after"))
    if moves_bins:
        is_set = new["balanced_accuracy"] > old["balanced_accuracy"]
        report["bins"] = {
            "threshold": change.shift,
            "is_set": is_set,
            "before": old["balanced_accuracy"],
            "after": new["balanced_accuracy"],
            "histogram": _histogram(recordings),
        }
        if not is_set:  # the alarm without it
            change = calibrator.fit(recordings, budget)
            changes, _ = calibrator.left_out(recordings, change, budget)
            if budget is not None:
                rows = _rows(calibrator, recordings, changes)
                new = pooled_outcome(row["after"] for row in rows)
    if budget is not None:
        rates = old["per_hour"], new["per_hour"] or 0.0
        report["alarm"] = _alarm_report(calibrator, recordings, change, budget, *rates)
        if not report["alarm"]["is_set"]:
            change = change._replace(alarm=settings)
    elif change.alarm != settings and new["found"] < old["found"]:
        report["alarm_stays"] = [old["found"], new["found"], new["slips"]]
        change = change._replace(alarm=settings)
        changes = [each._replace(alarm=settings) for each in changes]
        rows = _rows(calibrator, recordings, changes)
    report |= {"left_out_words": words, "left_out": rows}
    is_better = any(report[name]["is_set"] for name in ("bins", "alarm") if name in report)
    return report, change if is_better else None


def _bunched_budget(calibrator: Calibrator, recordings: Sequence[ScoredRecording]) -> Budget | None:
    """The budget of false alarms with the dispersion that they have; ``None``: no rate is set.

    Raises:
        ValueError: if they come in bunches, so that the recordings cannot show the rate.
    """
    if (rate := calibrator.per_hour) is None:
        return None
    dispersion = calibrator.dispersion(recordings)
    hours = sum(one.hours for one in recordings)
    budget = calibrator.budget(dispersion)
    best = budget.bound(0, hours)
    if dispersion > 1.05:
        line = (
            f"false alarms come in bunches (variance of their counts {dispersion:.2g} times "
            f"the mean): {hours:.3g} h can show {best:.3g} an hour at best"
        )
        if best > rate:
            raise ValueError(
                f"{line}, not {rate:g}; give {best * hours / rate:.2g} h, or a larger per_hour"
            )
        print(line)
    return budget


def _alarm_report(
    calibrator: Calibrator,
    recordings: Sequence[ScoredRecording],
    change: Change,
    budget: Budget,
    old: float,
    new: float,
) -> dict[str, Any]:
    """What is reported of the alarm; ``old`` and ``new`` are rates on what was left out."""
    (counts,) = change.alarm.metadata["budget"]
    hours, is_worse = counts["amount"], new > budget.limit and new >= old

    def stated(threshold: float) -> float:
        return calibrator.restated(change, threshold).alarm_threshold

    return {
        "per_hour": budget.limit,
        "confidence": budget.confidence,
        "hours": hours,
        "dispersion": budget.dispersion,
        **{name: counts[name] for name in ("allowed", "alarms", "bound")},
        "before": stated(calibrator.settings.alarm_threshold),
        "after": stated(change.alarm.alarm_threshold),
        "is_set": math.isfinite(change.alarm.alarm_threshold) and not is_worse,
        "rate_before": old,
        "rate_after": new,
        "curve": [
            [stated(at), each, budget.bound(round(each * hours), hours)]
            for at, each in calibrator.curve(recordings, change)
        ],
    }


def _rows(
    calibrator: Calibrator, recordings: Sequence[ScoredRecording], changes: Sequence[Change]
) -> list[dict[str, Any]]:
    """Of each recording its group, and what came of it before and after."""
    before = Change(0.0, None, calibrator.settings)
    return [
        {
            "recording": str(one.stream.recording),
            "group": one.stream.recording.material,
            "before": calibrator.outcome(one, before),
            "after": calibrator.outcome(one, after),
        }
        for one, after in zip(recordings, changes, strict=True)
    ]


def _histogram(recordings: Sequence[ScoredRecording]) -> dict[str, Any]:
    """Counts of the scores of bins by kind."""
    scores = np.concatenate([one.bins.numpy() for one in recordings])
    is_slip = np.concatenate([one.is_slip.numpy() for one in recordings])
    ends = [np.quantile(scores[of], (0.005, 0.995)) for of in (is_slip, ~is_slip)]
    edges = np.linspace(np.min(ends), np.max(ends), _NUM_CELLS + 1)
    counts = {
        name: np.histogram(np.clip(scores[of], edges[0], edges[-1]), edges)[0].tolist()
        for name, of in (("slip", is_slip), ("other", ~is_slip))
    }
    return {"edges": edges.tolist(), **counts}


def _tell(report: Mapping[str, Any]) -> None:
    """What was set, and what was not and why."""
    if refit := report.get("refit"):
        accuracies = f"{100 * refit['before']:.1f} % before, {100 * refit['after']:.1f} % after"
        what = "refitted" if refit["is_set"] else "not refitted, as that is not better"
        print(
            f"the detector is {what}: balanced accuracy {accuracies}, with {refit['added_bins']} "
            f"new bins beside {refit['kept_bins']} kept ones; on what was left out, each at the "
            "better of its threshold and one moved"
        )
        if None not in (ends := [refit["new_objects_before"], refit["new_objects_after"]]):
            told = " %, after ".join(f"{100 * end:.1f}" for end in ends)
            old, new = refit["num_groups"]
            print(
                "expected on other objects, where each group of training bins is left out in turn: "
                f"before {told} % ({old} groups, {new} after; one hard group lowers it)"
            )
    print(f"left out: {report['left_out_words']}")
    if bins := report.get("bins"):
        accuracies = f"{100 * bins['before']:.1f} % before, {100 * bins['after']:.1f} % after"
        if bins["is_set"]:
            print(f"decision threshold moved by {bins['threshold']:+.3g} of the score")
        else:
            print(f"decision threshold stays: another is not better ({accuracies}, left out)")
    if alarm := report.get("alarm"):
        if alarm["is_set"]:
            print(
                f"alarm threshold {round(alarm['after'], 9):.4g} "
                f"({round(alarm['before'], 9):.4g} before): at most "
                f"{alarm['bound']:.3g} false alarms an hour ({alarm['per_hour']:g} were asked for) "
                f"with a confidence of {alarm['confidence']:g} in use like these recordings, which "
                f"have {alarm['alarms']} in {alarm['hours']:.3g} valid h"
            )
            kept = [at for at, _, bound in alarm["curve"] if bound <= alarm["per_hour"]]
            if kept and min(kept) < 0 <= alarm["after"] < 1e-9:
                print(
                    "note: it is not set below 0, where decisions say no slip; "
                    f"threshold={min(kept):.3g} of detect and stream holds the rate too, and "
                    "raises more alarms, earlier"
                )
        else:
            print(
                f"alarm stays: on what was left out another has {alarm['rate_after']:.3g} false "
                f"alarms an hour, before {alarm['rate_before']:.3g}, wanted at most "
                f"{alarm['per_hour']:g}"
            )
    if stays := report.get("alarm_stays"):
        found, less, num = stays
        print(f"alarm stays: moved with the threshold it finds {less} of {num} slips, now {found}")
    slips = sum(row["after"]["slips"] for row in report["left_out"])
    if 0 < slips < _FEW_SLIPS:
        print(f"note: {slips} slips say little of how many are found; give {_FEW_SLIPS} or more")


main = entry_point("calibrate", calibrate)
