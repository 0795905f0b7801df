"""Set alarm and threshold on recordings of use: ``tactslip calibrate model=detector.pt ...``.

Recordings without slip set the alarm for a rate of false alarms, labelled ones with slip the
decision threshold. Leaves ``detector.pt``, ``calibration.json`` and ``calibration.png``; a detector
that would be worse on recordings left out is not written.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from hydra.utils import instantiate
from omegaconf import DictConfig

from tactslip_torch.commands.entry import entry_point, save_config
from tactslip_torch.data.recording import RecordingId, RecordingSource, Timeline
from tactslip_torch.features.cache import cache_key
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.onset.decisions import AlarmSettings
from tactslip_torch.onset.rules import Budget
from tactslip_torch.report.calibration import (
    calibration_figure,
    calibration_table,
    pooled_outcome,
)
from tactslip_torch.runtime import check_number, check_share, plain, write_json
from tactslip_torch.training.alarm import OURS, Stream, Timing, score_streams
from tactslip_torch.training.calibrate import (
    Calibrator,
    Change,
    ScoredRecording,
    in_stretches,
)

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
    times = _labelled(config, detector, source)
    _check_hours(calibrator, times)
    save_config(config, folder)
    scored = score_streams(
        source,
        list(times),
        {OURS: detector},
        {OURS: settings.hop_samples},
        settings.onset,
        config.num_workers,
    )
    streams = [one._replace(times=times[one.recording]) for one in scored[OURS]]
    recordings = [calibrator.scored(one) for one in _cut(streams, timing)]
    report, change = _calibrated(calibrator, recordings)
    origin: dict[str, Any] = {
        "simulated": source.is_simulated,
        "date": datetime.now(UTC).date().isoformat(),
        "model": str(config.model),
        "hours": sum(one.hours for one in recordings),
        "recordings": {str(one): cache_key(source.key(one)) for one in times},
        "trained_on": bool(config.use_trained),
    }
    report = {**origin, **report}
    print("\n" + calibration_table(report["left_out"], simulated=report["simulated"]))
    _tell(report)
    write_json(folder / "calibration.json", plain(report))
    calibration_figure(report, folder / "calibration.png")
    if change is None:
        print(f"the detector stays as it is, {config.model}; no detector is written")
    else:
        alarm = report.get("alarm", {})
        curve = [point[:2] for point in alarm.get("curve", ())] if alarm.get("is_set") else ()
        more = {"threshold_curve": curve} if curve else {}
        calibrator.apply(change, detector, more | {"simulated": report["simulated"]})
        kept = ("per_hour", "confidence", "hours", "dispersion", "alarms", "bound")
        detector.info["calibrated"] = plain(
            origin
            | {"alarm": {name: alarm[name] for name in kept} if alarm.get("is_set") else None}
            | {"decision_threshold_moved_by": change.shift}
        )
        detector.save(folder / "detector.pt")
        print(f"calibrated detector: {folder / 'detector.pt'}")
    return report


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
