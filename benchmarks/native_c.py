"""The C library on this machine and on emulated boards: ``python -m benchmarks.native_c``.

The detector that comes with the package as a ``.tslip`` file, run by C programs that are built
here: time and memory of a decision beside onnxruntime and the package, and the stream of the sample
recording on two boards that QEMU emulates, in instructions. Needs what ``.ci/boards`` installs.
"""

from __future__ import annotations

import copy
import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import numpy as np
import torch
from hydra.utils import instantiate

from benchmarks import ROOT
from benchmarks.deployment import host
from benchmarks.harness import Benchmark, Job, say
from benchmarks.subjects import Array, drawn_network, loaded
from benchmarks.tables import Table
from benchmarks.timing import interleaved, on_threads
from benchmarks.trainings import composed, trained
from tactslip_torch import SlipDetector, StreamingDetector, sample_recording
from tactslip_torch.deploy.bins import Precision
from tactslip_torch.deploy.check import LARGEST_ERROR, Run, runner, session_of
from tactslip_torch.deploy.export import export_detector
from tactslip_torch.deploy.native import FILE, SOURCE, NativeFile
from tactslip_torch.deploy.stream import stream_graph
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.onset.decisions import KEY, AlarmSettings
from tactslip_torch.onset.evidence import OnsetClassifier, OnsetEvidence
from tactslip_torch.pretrained import NAME

HOST = ROOT / "export" / "native"
SOURCES = ("export/native/*", "export/native/board/*", "export/c/*.c", "export/c/*.h")
BOARD_TOOLS = ("make", "arm-none-eabi-g++", "qemu-system-arm")
TOOLS = (*BOARD_TOOLS, "aarch64-linux-gnu-g++", "qemu-aarch64")
BOARDS = {"m7": "Cortex-M7 (mps2-an500)", "m4": "Cortex-M4F (mps2-an386)"}
_FULL_SCALE = 32000  # counts of the largest sample


def missing_tools(wanted: Sequence[str] = TOOLS) -> list[str]:
    """Of those that the boards and, by default, the other machine need."""
    return [name for name in wanted if shutil.which(name) is None]


def make(folder: Path, target: str, *words: str, where: Path = HOST) -> str:
    """Build a target of ``export/native`` into a folder; what is printed on both streams."""
    command = ["make", "-s", "-C", str(where), f"BUILD={folder}", target, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed: {done.stderr.strip()[-500:]}")
    return done.stdout + done.stderr  # where semihosting writes


def on_board(board: str, folder: Path, counts: Array) -> dict[str, Any]:
    """The stream of counts ``[T, C]`` on an emulated board, by ``detector.c`` in the folder.

    Returns:
        ``alarms``, the numbers that the program prints, and bytes of ``flash`` and ``ram``.
    """
    recording = folder / "recording.c"
    words = ",\n".join(",".join(map(str, row)) for row in counts.tolist())
    recording.write_text(
        "#include <stddef.h>\n#include <stdint.h>\nextern const int16_t recording[];\n"
        "extern const size_t recording_samples;\n"
        f'__attribute__((section(".recording"))) const int16_t recording[] = {{{words}}};\n'
        f"const size_t recording_samples = {len(counts)};\n"
    )
    given = f"DETECTOR={folder / SOURCE}", f"RECORDING={recording}"
    said = make(folder, "run", f"BOARD={board}", *given, where=HOST / "board")
    lines = [json.loads(line) for line in said.splitlines() if line.startswith("{")]
    sizes = {w[0]: int(w[1]) for w in map(str.split, said.splitlines()) if w[:1] and w[0][0] == "."}
    found = lines.pop()
    kept = sizes[".data"]
    return {
        **found,
        "alarms": [(line["alarm_us"] / 1e6, line["onset_us"] / 1e6) for line in lines],
        "flash": sizes[".text"] + sizes.get(".ARM.exidx", 0) + kept,
        "ram": kept + found["state_bytes"] + found["stack_bytes"],
    }


def sample_counts() -> tuple[Array, float]:
    """The sample recording as a converter of 16 bits gives it, ``[T, C]``, and volts of a count."""
    samples = sample_recording().samples.T.numpy()
    scale = float(np.float32(np.abs(samples).max() / _FULL_SCALE))
    return np.rint(samples / scale).astype(np.int16), scale


@dataclass(frozen=True)
class NativeC(Benchmark):
    """The C library here, by an emulated processor of another kind, and on emulated boards.

    Args:
        columns: of a second, smaller detector, which is trained; 0: there is none.
        rounds: of the sample recording, for each way in turn.
        every: of the recordings that ``+exp=unseen4`` tests on, each such one is decided on by all.
    """

    title = "The C library"
    about = (
        "the detector that comes with the package, made by the default recipe, as `detector.tslip` "
        "in C programs, on 1 thread; boards are emulated by QEMU, which counts instructions and "
        "does not show time"
    )
    page = "docs/deploy.md"
    charts: ClassVar = {"": (("A decision on this machine", "us a decision"),)}
    quick = "rounds=2 every=50"
    libraries = ("onnxruntime",)
    columns: int = 0
    rounds: int = 20
    every: int = 1

    @torch.inference_mode()
    def measure(self, job: Job) -> dict[str, Any]:
        """Programs on this machine, aarch64 in QEMU, boards."""
        if missing := missing_tools():
            raise ValueError(f"not installed: {', '.join(missing)}; run .ci/boards")
        detectors = {NAME: SlipDetector.pretrained()}
        if self.columns:
            words = ["+exp=unseen4", "baselines=false", "recipe.views=[pooled]"]
            words += [f"recipe.num_features={self.columns}"]
            small = job.folder.parent / f"{self.columns} columns"
            trained(words, small, small / "cache")
            detectors[f"{self.columns} columns"] = loaded(small / "detector.pt")
        with TemporaryDirectory(prefix="tactslip-bench-") as folder, on_threads(1):
            tables = {
                "A decision on this machine": _here(detectors, Path(folder), self.rounds),
                "The same file on aarch64": _on_aarch64(detectors[NAME], Path(folder)),
                "Error of float32": _float32(detectors[NAME]),
                "The test set, decided on by all": _test_set(detectors[NAME], self.every),
                "Emulated boards": _boards(detectors, Path(folder)),
            }
            return {"tables": tables}


def _here(detectors: Mapping[str, SlipDetector], folder: Path, rounds: int) -> Table:
    say("native_c: programs on this machine")
    make(folder, "timing")
    samples = sample_recording().samples.T.contiguous().numpy()
    np.save(folder / "recording.npy", samples)
    rows = []
    for name, detector in detectors.items():
        for precision in ("float64", "float32"):
            place = folder / name / precision
            place.mkdir(parents=True)
            NativeFile.checked(detector, precision).write(place)
            words = [folder / "timing", place / FILE, folder / "recording.npy", str(rounds)]
            done = subprocess.run(list(map(str, words)), capture_output=True, text=True, check=True)
            found = json.loads(done.stdout)
            row = {"way": f"C, {name}, {precision}", "us a decision": f"{found['p50_us']:.1f}"}
            row["us from start to a score"] = f"{found['first_us']:.0f}"
            row["MB resident"] = f"{found['resident_kb'] / 1e3:.1f}"
            row["kB of the file"] = f"{(place / FILE).stat().st_size / 1e3:.0f}"
            rows.append(row)
    detector = detectors[NAME]
    for way, us in _others(detector, folder, samples, rounds).items():
        rows.append({**dict.fromkeys(rows[0], "-"), "way": way, "us a decision": f"{us:.1f}"})
    return Table(
        rows, "Median CPU time of a decision; CPU time of a new process until its first score."
    )


def _others(detector: SlipDetector, folder: Path, samples: Array, rounds: int) -> dict[str, float]:
    """Microseconds of a push of one hop by the package and by onnxruntime."""
    hop = int(detector.info["alarm"]["hop_samples"])
    pieces = [samples[at : at + hop] for at in range(0, len(samples), hop)]
    stream = StreamingDetector(detector)
    export_detector(detector, folder, ("stream",))
    session, _ = host("files").load_model(folder / "stream.onnx", "stream")
    names = [output.name for output in session.get_outputs()]
    feeds: dict[str, Any] = {"tail": samples[:0], "state": np.zeros(0), "threshold": np.zeros(0)}
    turn = {"package": 0, "graph": 0}

    def push() -> None:
        turn["package"] += 1
        stream.push(pieces[turn["package"] % len(pieces)])

    def run() -> None:
        turn["graph"] += 1
        given = {"samples": pieces[turn["graph"] % len(pieces)], **feeds}
        found = dict(zip(names, session.run(None, given), strict=True))
        feeds["tail"], feeds["state"] = found["next_tail"], found["next_state"]

    timed = interleaved({"package, a push": push, "onnxruntime, a push": run}, rounds)
    return {name: 1e6 * of["p50_s"] for name, of in timed.items()}


def _on_aarch64(detector: SlipDetector, folder: Path) -> Table:
    say("native_c: aarch64 in QEMU")
    cross = [f"{name}=aarch64-linux-gnu-{tool}" for name, tool in (("CC", "gcc"), ("CXX", "g++"))]
    make(folder / "aarch64", str(folder / "aarch64" / "detect"), *cross, "LINK=-static")
    rows = []
    for precision in ("float64", "float32"):
        samples = np.load(folder / "recording.npy").astype(precision)
        np.save(folder / "given.npy", samples)
        file = folder / NAME / precision / FILE
        words = ["qemu-aarch64", folder / "aarch64" / "detect", file, folder / "given.npy"]
        command = [*map(str, words), "--decisions"]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        *lines, summary = map(json.loads, done.stdout.splitlines())
        wanted = StreamingDetector(detector, dtype=getattr(torch, precision)).push(samples)
        score = np.array([line["score"] for line in lines])
        off = np.abs(score - wanted.score.numpy()).max() / float(wanted.score.std())
        same = [line["alarm"] for line in lines] == wanted.is_alarm.tolist()
        rows.append(
            {
                "file": f"{FILE}, {precision}",
                "decisions": str(summary["decisions"]),
                "alarms": f"{summary['alarms']}, {'as' if same else 'NOT as'} the package",
                "largest difference of a score, sd": f"{off:.1e}",
            }
        )
    return Table(rows, "The program for aarch64, run by qemu-aarch64 (user mode).")


def _float32(detector: SlipDetector) -> Table:
    """Scores of a float32 file on the sample recording, and with other gains and offsets."""
    samples = sample_recording().samples.T.numpy()
    streams = {"as it is": samples}
    streams |= {f"times {gain:g}": samples * np.float32(gain) for gain in (0.3, 1000.0)}
    streams |= {f"plus {by:g} V": samples + np.float32(by) for by in (1.0, 10.0, 100.0, 1000.0)}
    rows = []
    for name, given in streams.items():
        found = NativeFile.of(detector, "float32").stream().push(given)
        wanted = StreamingDetector(detector).push(given)
        score = wanted.score.double().numpy()
        off = np.abs(found["score"] - score).max() / score.std()
        changed = int((found["on"] != wanted.is_on.numpy()).sum())
        rows.append(
            {
                "sample recording": name,
                "largest difference of a score, sd": f"{off:.1e}",
                "decisions with another status": f"{changed} of {len(score)}",
            }
        )
    return Table(rows, "Compared with the package in float64. *Status*: whether the alarm stands.")


def _test_set(detector: SlipDetector, every: int) -> Table:
    """Decisions of C library and graph that are not those of the package."""
    config = composed("train", ["+exp=unseen4"])
    source = instantiate(config.data, _convert_="all")
    (fold,) = instantiate(config.split, _convert_="all")(source.ids)
    chosen = [each for each in source.ids if fold.roles.get(each) in ("test", "unseen")][::every]
    ways: dict[tuple[str, Precision], Callable[[Array], Mapping[str, Array]]] = {}
    for precision in LARGEST_ERROR:
        ways["C", precision] = partial(_by_library, NativeFile.of(detector, precision))
        model = stream_graph(detector, AlarmSettings.of(detector), precision).model()
        ways["graph", precision] = partial(_by_graph, runner(session_of(model)))
    found: dict[tuple[str, Precision], list[Array]] = {way: [] for way in ways}
    for number, each in enumerate(chosen):
        say(f"native_c: recording {number + 1} of {len(chosen)} of the test set")
        given = source.load(each).samples.T.contiguous()
        for precision in LARGEST_ERROR:
            samples = given.to(getattr(torch, precision))
            decided = StreamingDetector(detector, dtype=samples.dtype).push(samples)
            wanted = [decided.score, decided.is_on, decided.is_alarm, decided.is_valid]
            expected = np.stack([column.double().numpy() for column in wanted])
            for way in ("C", "graph"):
                own = ways[way, precision](samples.numpy())
                columns = [own[name] for name in ("score", "on", "alarm", "valid")]
                found[way, precision].append(np.stack([*columns, *expected]))
    rows = []
    for (way, precision), parts in found.items():
        both = np.concatenate(parts, 1)
        (score, on, alarm, valid), expected = both[:4], both[4:]
        off, spread = np.abs(score - expected[0]), np.nanstd(expected[0])
        is_other = (score >= 0) != (expected[0] >= 0)
        is_outside = is_other & (np.abs(expected[0]) > LARGEST_ERROR[precision] * spread)
        rows.append(
            {
                "way": f"{way}, {precision}",
                "decisions": f"{len(score):,}",
                "largest difference of a score, sd": f"{np.nanmax(off) / spread:.1e}",
                "99.9 % are within": f"{np.nanquantile(off, 0.999) / spread:.1e}",
                "other sign of the score": str(is_other.sum()),
                "other sign, |score| above the margin": str(is_outside.sum()),
                "other status": str((on != expected[1]).sum()),
                "alarms": f"{expected[2].sum():.0f}",
                "other alarms": str((alarm != expected[2]).sum()),
                "other validity": str((valid != expected[3]).sum()),
            }
        )
    return Table(
        rows,
        f"{len(chosen)} simulated recordings of materials seen in training and held out, compared "
        "with the package. *Status*: whether the alarm stands. The margin is "
        f"{LARGEST_ERROR['float32']:g} of the scores' standard deviation in float32, "
        f"{LARGEST_ERROR['float64']:g} in float64.",
    )


def _by_library(made: NativeFile, samples: Array) -> Mapping[str, Array]:
    """The decisions of a stream in C on a recording."""
    return made.stream().push(samples)


def _by_graph(run: Run, samples: Array) -> Mapping[str, Array]:
    """The outputs of a stream's graph on a recording."""
    none = np.empty(0)
    return run({"samples": samples, "tail": samples[:0], "state": none, "threshold": none})


def _boards(detectors: Mapping[str, SlipDetector], folder: Path) -> Table:
    counts, scale = sample_counts()
    rows = []
    networks = {
        f"{NAME}, with a network {first}-{second}": _with_network(detectors[NAME], first, second)
        for first, second in ((128, 48), (64, 32))
    }
    detectors = {**detectors, **networks}
    for name, detector in detectors.items():
        place = folder / "board"  # where the library is built once
        place.mkdir(exist_ok=True)
        NativeFile.checked(detector, "float32", scale=scale).write(place, source=True)
        decided = StreamingDetector(detector).push(counts.astype(np.float32) * np.float32(scale))
        wanted = [(alarm.alarm_s, alarm.onset_s) for alarm in decided.alarms]
        for board, title in BOARDS.items():
            say(f"native_c: {title}, {name}")
            found = on_board(board, place, counts)
            same = np.allclose(found["alarms"], wanted, atol=2e-6)
            of_hop = found["instructions_of_sample"] * found["hop_samples"]
            rows.append(
                {
                    "board": title,
                    "detector": name,
                    "M instructions a decision": f"{found['instructions'] / 1e6:.2f}",
                    "at most": f"{found['most_instructions'] / 1e6:.2f}",
                    "of the hop's samples": f"{of_hop / 1e6:.2f}",
                    "kB of RAM": f"{found['ram'] / 1e3:.1f}",
                    "kB of flash": f"{found['flash'] / 1e3:.0f}",
                    "alarms": f"{len(wanted)}, {'as' if same else 'NOT as'} the package",
                }
            )
    return Table(
        rows,
        "In float32. Flash includes the detector and RAM the stack; neither includes the "
        "recording. The networks have random weights: these rows show costs only.",
    )


def _with_network(detector: SlipDetector, *widths: int) -> SlipDetector:
    """The detector with an onset classifier whose weights are drawn: it costs what any does."""
    made = copy.deepcopy(detector)
    evidence = OnsetEvidence(made.pool.hand, made.pool.sample_rate_hz)
    num = evidence.num_columns
    scaler = FeatureScaler(-torch.ones(num).double(), torch.ones(num).double())
    onset = OnsetClassifier(evidence, scaler, drawn_network(evidence, *widths), threshold=1e6)
    made.info[KEY] = replace(AlarmSettings.of(made), onset=onset).to_dict()
    return made


if __name__ == "__main__":
    sys.exit(NativeC().run())
