"""What every host of an exported stream is held to: the truth, and words for what is wrong.

A host is a command, ``[*host, model, recording, *options]``. It is run, its JSON lines are read,
and what they say is held against ``StreamingDetector`` in float64.
"""

import fcntl
import json
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from contract.names import STREAM_OUTPUTS
from small_detector import alarms_of
from streams import onset_of
from test_detector import random_detector

from tactslip_torch import Scene, SlipDetector, simulate
from tactslip_torch.deploy import export
from tactslip_torch.features.sensing import Sensing
from tactslip_torch.onset.decisions import KEY, AlarmSettings, score_stream
from tactslip_torch.onset.rules import NOTHING_YET
from tactslip_torch.onset.streaming import StreamingDetector

EXPORT = Path(__file__).parents[1] / "export"
RATE = 2000.0
HOP = 20


# Input -----------------------------------------------------------------------------------------


@cache
def slipping_stream() -> np.ndarray:
    """Three simulated seconds around an onset, volts ``[T, C]``, float32; not to be written to."""
    scene = Scene("M1", seed=1)
    onset_s = simulate(scene, windows=[]).onsets_s[0]
    recording = simulate(scene, windows=[(onset_s - 2.0, onset_s + 1.0)])
    first = round((onset_s - 2.0) * RATE) + 2  # outside the window there is NaN
    samples = recording.samples[:, first : first + 5990].T.contiguous().numpy()
    assert np.isfinite(samples).all()
    samples.flags.writeable = False
    return samples


@cache
def alarming_detector(with_onset: bool = False) -> SlipDetector:
    """A detector nobody trained, of a seed and settings by which the stream raises some alarms.

    Its levels are those of the stream.
    With an onset classifier some are raised by it, and some by bins.
    """
    detector = random_detector(seed=32)
    samples = torch.from_numpy(slipping_stream().T.copy()).double()
    scores, *_, spans = score_stream(detector, samples, HOP)
    known = detector.sensing
    detector.sensing = Sensing.fit(spans, known.min_alive, known.stuck_samples)
    onset = onset_of(samples, detector.pool.hand, 3, 0.8) if with_onset else None
    settings = replace(alarms_of(scores, HOP), lead_s=0.02, onset=onset)
    detector.info[KEY] = settings.to_dict()
    return detector


def saved(path: Path, samples: np.ndarray) -> Path:
    """A recording as ``.npy``."""
    np.save(path, samples)
    return path


_EXPORTED: dict[bool, Path] = {}


def exported(folder_factory: Any, *, with_onset: bool = False) -> Path:
    """A folder with ``model.onnx``, ``stream.onnx`` and their sidecars, made once in a session."""
    if with_onset not in _EXPORTED:
        folder: Path = folder_factory.mktemp("exported")
        with pytest.MonkeyPatch.context() as patch:  # the hosts are asked here, not the graph
            patch.setattr(export, "check_model", lambda *given: {"worst_sd": 0.0})
            export.export_detector(alarming_detector(with_onset), folder)
        _EXPORTED[with_onset] = folder
    return _EXPORTED[with_onset]


def copied(model: Path, folder: Path) -> Path:
    """A model with its sidecar in another folder."""
    for path in (model, sidecar_of(model)):
        shutil.copy(path, folder)
    return folder / model.name


def sidecar_of(model: Path) -> Path:
    return model.with_name(f"{model.name}.json")


def truncated(path: Path) -> Path:
    """The same file, cut off in its middle."""
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    return path


def altered(path: Path) -> Path:
    """The same file with one bit of its middle byte flipped."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    return path


def installed(folder: Path) -> None:
    """Install a folder's packages where its lock file is newer than what is there.

    Two test files may want the same folder in two processes: one of them waits.
    """
    if shutil.which("node") is None:
        pytest.skip("node is not installed: apt-get install nodejs npm")
    wanted, done = folder / "package-lock.json", folder / "node_modules" / ".package-lock.json"
    with wanted.open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if done.exists() and done.stat().st_mtime >= wanted.stat().st_mtime:
            return
        if shutil.which("npm") is None:
            pytest.skip("npm is not installed: apt-get install npm")
        ran = subprocess.run(["npm", "ci"], cwd=folder, capture_output=True, text=True, check=False)
        assert ran.returncode == 0, ran.stderr


LOST = {
    # rows and channels that are lost, and what they read instead
    "one sample": ((slice(300, 301), slice(None)), np.nan),
    "200 samples": ((slice(400, 600), slice(None)), np.nan),
    "a dead channel": ((slice(None), -1), 0.0),
    "all silent behind the onset": ((slice(2000, None), slice(None)), 0.0),
    "all missing": ((slice(None), slice(None)), np.nan),
}


def without(samples: np.ndarray, lost: str) -> np.ndarray:
    """Samples ``[T, C]`` as a hand sends them that has lost some."""
    (place, value), broken = LOST[lost], samples.copy()
    broken[place] = value
    return broken


# Running a host --------------------------------------------------------------------------------


class Ran(NamedTuple):
    """What a host said: its lines, the last of them apart, what stands on stderr, exit status."""

    lines: list[dict[str, Any]]
    summary: dict[str, Any]
    stderr: str
    status: int


def run_host(host: Sequence[object], *arguments: object) -> Ran:
    """Run a host to its end; JSON as the standard has it, so no NaN."""
    command = [str(part) for part in (*host, *arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    lines = [json.loads(line, parse_constant=_refuse) for line in done.stdout.splitlines()]
    summary = lines.pop() if done.returncode == 0 else {}
    return Ran(lines, summary, done.stderr, done.returncode)


def _refuse(word: str) -> None:
    raise ValueError(f"{word} is no JSON")


# The truth -------------------------------------------------------------------------------------


def truth(
    samples: np.ndarray,
    threshold: float | None = None,
    *,
    with_onset: bool = False,
    detector: SlipDetector | None = None,
) -> list[dict[str, Any]]:
    """Every decision of a detector on samples ``[T, C]``, as a host is to print it."""
    detector = detector or alarming_detector(with_onset)
    settings = AlarmSettings.of(detector)
    if threshold is not None:
        settings = settings.at_threshold(threshold)
    decisions = StreamingDetector(detector, settings, dtype=torch.float64).push(samples)
    fields = STREAM_OUTPUTS | {"in_range": "in_range", "onset_score": "onset_score"}
    fields |= {"hint": "is_hint"}
    of_onset = ["onset_score", "hint"] if settings.onset else []
    kinds = {alarm.alarm_s: alarm.raised_by for alarm in decisions.alarms}
    rows = []
    for i, lost in enumerate(map(decisions.names_lost, range(len(decisions.number)))):
        row = {name: getattr(decisions, field)[i].item() for name, field in fields.items()}
        row["channels_lost"] = list(lost)
        if row["onset_score"] == NOTHING_YET:
            row["onset_score"] = None
        row = {name: row[name] for name in (*ALARM_KEYS, "statistic", "alarm", "on", *of_onset)}
        row |= {name: None for name, value in row.items() if value != value}  # NaN
        if row["statistic"] is not None and row["statistic"] < -0.99e30:  # too few decisions yet
            row["statistic"] = None
        rows.append(row | ({"raised_by": kinds.get(row["time_s"])} if settings.onset else {}))
    return rows


ALARM_KEYS = ("time_s", "onset_s", "score", "probability", "valid", "in_range", "channels_lost")


def assert_same(ran: Ran, expected: list[dict[str, Any]], *, exact: bool = False) -> None:
    """A host ran with ``--decisions`` and said what is expected.

    Times and flags are the same; scores, statistics and probabilities to 1e-3 of a score standard
    deviation (float32), or 1e-9 (``exact``: a model in float64).
    """
    close = 1e-9 if exact else 1e-3
    scores = [row["score"] for row in expected if row["score"] is not None]
    spread = np.std(scores) if scores else 0.0
    near = {"score": close * spread, "probability": close, "statistic": close * 8.0}
    assert ran.status == 0, ran.stderr
    assert len(ran.lines) == len(expected)
    assert all(list(line) == list(expected[0]) for line in ran.lines)
    for name in expected[0]:
        found, wanted = ([row[name] for row in rows] for rows in (ran.lines, expected))
        if name in near:
            found, wanted = (np.array(each, float) for each in (found, wanted))  # null is NaN
            np.testing.assert_allclose(found, wanted, rtol=1e-7, atol=near[name], err_msg=name)
        elif name in ("time_s", "onset_s", "onset_score"):
            found, wanted = (np.array(each, float) for each in (found, wanted))
            np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9, err_msg=name)
        else:
            assert found == wanted, name
    assert ran.summary["decisions"] == len(expected)
    assert ran.summary["alarms"] == sum(row["alarm"] for row in expected)
