"""How a folder of recordings is read and labelled: ``tactslip setup FOLDER``.

Looks at the recordings, asks what they do not tell, and writes ``hand.yaml`` beside them, which
``tactslip train FOLDER`` reads, and ``hand.png``, one recording as it will be read.
"""

from __future__ import annotations

import argparse
import json
import math
import shlex
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml  # type: ignore[import-untyped,unused-ignore]

from tactslip_torch.commands.configuration import HAND_FILE

if TYPE_CHECKING:
    from tactslip_torch.data.file_recordings import FileRecordings
    from tactslip_torch.data.proposal import Answers, Proposal, Question

_PICTURE = "hand.png"
_IN_A_LINE = ("data.labels", "data.rename", "features.frames")
"""Settings whose keys are the user's words."""
_WIDTH = 100


def setup(
    folder: Path,
    answers: Answers,
    ask: Callable[[Question], str],
    *,
    force: bool = False,
) -> Proposal:
    """Write ``hand.yaml`` and ``hand.png`` into a folder of recordings.

    Args:
        folder: of the recordings.
        answers: what is known of them.
        ask: gives the answer to a question, ``""`` for its default.
        force: replace what was written before.

    Raises:
        FileNotFoundError: if there is no such folder.
        FileExistsError: if one of the two files is there.
        ValueError: if no recording can be read, or an answer cannot be.
    """
    from tactslip_torch.data.manifest import MANIFEST, write_table  # of no need for --help
    from tactslip_torch.data.proposal import look, propose

    for name in (HAND_FILE, _PICTURE):
        if (folder / name).exists() and not force:
            raise FileExistsError(f"{folder / name} is there already; --force replaces it")
    found = look(folder, answers)
    proposal = propose(found, answers)
    while proposal.questions:
        question = proposal.questions[0]
        answers = _answered(answers, question, ask(question) or question.default)
        proposal = propose(found, answers)
    width = max(len(finding.what) for finding in proposal.findings)
    for what, value, reason in proposal.findings:
        print(f"{what:{width}}  {value}  ({reason})")
    new = [path for name in (HAND_FILE, MANIFEST) if not (path := folder / name).exists()]
    if proposal.manifest:
        write_table(folder / MANIFEST, list(proposal.manifest[0]), proposal.manifest)
    (folder / HAND_FILE).write_text(_hand_yaml(proposal), encoding="utf-8")
    try:
        _draw(folder, proposal)
    except (ValueError, OSError):
        for path in new:  # so that setup can be started again, with what is corrected
            path.unlink(missing_ok=True)
        raise
    if proposal.manifest:
        print(f"\n{folder / MANIFEST} lists the recordings with their intervals")
    print(f"\n{folder / HAND_FILE} says how the recordings are read; change what is wrong there")
    return proposal


def _answered(answers: Answers, question: Question, answer: str) -> Answers:
    """The answers with one more.

    Raises:
        ValueError: if it is no answer.
    """
    if not (answer := answer.strip()):
        raise ValueError(f"{_sentence(question)} Give {question.flag}")
    if question.name in ("slip", "non_slip"):
        words = {word.strip(): question.name == "slip" for word in answer.split(",")}
        return replace(answers, words={**answers.words, **words})
    is_text = question.name in ("pattern", "column")
    given: dict[str, Any] = {question.name: answer if is_text else _number(answer, question.flag)}
    return replace(answers, **given)


def _sentence(question: Question) -> str:
    return question.text if question.text.endswith(("?", ")")) else f"{question.text}."


def _number(text: str, flag: str) -> float:
    try:
        number = float(text.replace(",", "."))
    except ValueError:
        raise ValueError(f"{flag}: {text!r} is no number") from None
    is_rate = flag == "--rate HZ"
    wanted = "above 0" if is_rate else "of 0 or more"
    if (is_rate and number == 0) or not 0 <= number < float("inf"):
        raise ValueError(f"{flag}: expected a number {wanted}, got {text}")
    return number


# hand.yaml ----------------------------------------------------------------------------------------


def _hand_yaml(proposal: Proposal) -> str:
    """The settings of a proposal as YAML, with the reason of each value."""
    lines = ["# How the recordings of this folder are read and labelled (tactslip setup).", ""]
    for section, settings in proposal.settings.items():
        if settings:
            lines += [f"{section}:", *_lines(settings, section, proposal.reasons), ""]
    return "\n".join(lines)


def _lines(settings: Mapping[str, Any], place: str, reasons: Mapping[str, str]) -> list[str]:
    """A line for each value; that of a channel has its reason once for each kind."""
    found: list[str] = []
    indent = "  " * (place.count(".") + 1)
    for name, value in settings.items():
        key = f"{place}.{name}"
        reason = reasons.get(key, "")
        if isinstance(value, Mapping) and key not in _IN_A_LINE:
            found += [f"{indent}{name}:", *_lines(value, key, reasons)]
        elif key == "data.channels":
            found.append(f"{indent}{name}:   # {reason}")
            told: set[str] = set()
            for row in value:
                kind = row["kind"]
                why = "" if kind in told else f"   # {reasons[f'kind.{kind}']}"
                found.append(f"{indent}  - {_flow(row)}{why}")
                told.add(kind)
        else:
            line = f"{indent}{name}: {_flow(value)}"
            if len(line) + len(reason) + 5 <= _WIDTH:
                found.append(f"{line}   # {reason}")
            else:
                found += [f"{indent}# {reason}", line]
    return found


def _flow(value: Any) -> str:
    """A value in one line of YAML."""
    plain = json.loads(json.dumps(value))  # tuples and numbers of NumPy are none in YAML
    options = {"default_flow_style": True, "sort_keys": False, "allow_unicode": True}
    text: str = yaml.safe_dump(plain, width=math.inf, **options)
    return text.removesuffix("\n").removesuffix("\n...")


# hand.png -----------------------------------------------------------------------------------------


def _draw(folder: Path, proposal: Proposal) -> None:
    """Draw a recording as it will be read.

    Raises:
        ValueError: if it cannot be read so.
    """
    from tactslip_torch.report.recordings import reading_figure

    source = _source(folder, proposal)
    (recording,) = source.ids
    loaded = source.load(recording)
    rows = source.hand.to_rows()
    title = (
        f"{proposal.example}: {len(rows)} channels at {source.sample_rate_hz:g} Hz, "
        f"{loaded.duration_s:.1f} s, as it will be read"
    )
    path = folder / _PICTURE
    reading_figure(loaded, rows, path, title)
    print(f"{path} shows {proposal.example} as it will be read; look at its labels")


def _source(folder: Path, proposal: Proposal) -> FileRecordings:
    """The example of a proposal as a set of its own.

    Raises:
        ValueError: if it cannot be read as is proposed.
    """
    from tactslip_torch.data.file_recordings import FileRecordings
    from tactslip_torch.data.folder import guessed
    from tactslip_torch.data.labels import LabelRule, label_of
    from tactslip_torch.data.manifest import MANIFEST, Entry, Listing, read_manifest
    from tactslip_torch.data.recording import RecordingId, Timeline

    data, file = dict(proposal.settings["data"]), proposal.example
    pattern, words = data.pop("pattern", None), data.pop("labels", {})
    if pattern is None:
        listed = read_manifest(folder / MANIFEST, folder).entries
        entries = tuple(entry for entry in listed if entry.file == file)
    else:
        label = label_of(words.get(guessed(file, pattern).get("label", ""), ""))
        truth = Timeline(label=label) if label else None
        entries = (Entry(file, file, RecordingId(file, 0), truth),)
    rule = LabelRule(**proposal.settings["labels"])
    return FileRecordings(folder, manifest=Listing(entries), label_rule=rule, **data)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="tactslip setup",
        description="Look at the recordings of a folder, ask what they do not tell, and write "
        f"how they are read: {HAND_FILE}, with the reason of each value, and {_PICTURE}, one of "
        "them as it will be read.",
        epilog="example: tactslip setup recordings --rate 100 --non-slip hold",
    )
    parser.add_argument("folder", type=Path, help="of the recordings; its folders are searched")
    parser.add_argument("--yes", action="store_true", help="ask nothing, take what is likely")
    parser.add_argument("--force", action="store_true", help=f"replace {HAND_FILE}, {_PICTURE}")
    parser.add_argument(
        "--rate", metavar="HZ", help="samples a second of each channel, where there are no times"
    )
    parser.add_argument("--time", metavar="COLUMN", help="the column of times")
    parser.add_argument("--time-unit", choices=("s", "ms", "us", "ns"), help="of the times")
    parser.add_argument("--units", help="of the samples, such as N or V")
    parser.add_argument(
        "--column", metavar="NAME",
        help="the column that says of each sample whether it is slip; none: no column says it",
    )  # fmt: skip
    parser.add_argument(
        "--over", metavar="NUMBER", help="slip is where the magnitude of that column is above it"
    )
    parser.add_argument(
        "--label", action="append", default=[], metavar="WORD=slip|non-slip",
        help="what a word of that column, of a folder or of a file's name means; again for more",
    )  # fmt: skip
    parser.add_argument(
        "--non-slip", action="append", default=[], metavar="WORD",
        help="the same for what is no slip; words that are not known are slip then",
    )  # fmt: skip
    parser.add_argument(
        "--pattern", help="how names are made, such as {label}/{material}_{trial} or {material}_*"
    )
    given = parser.parse_args()
    from tactslip_torch.commands.stopping import errors_in_one_line

    with errors_in_one_line():
        setup(given.folder, _answers(given), _ask(given.yes), force=given.force)
        print(f"next: {shlex.join(['tactslip', 'train', str(given.folder)])}")


def _answers(given: argparse.Namespace) -> Answers:
    """What the flags say.

    Raises:
        ValueError: if a number or word is none.
    """
    from tactslip_torch.data.labels import label_of
    from tactslip_torch.data.proposal import Answers

    words = dict.fromkeys((word for each in given.non_slip for word in each.split(",")), False)
    for pair in given.label:
        word, _, label = pair.partition("=")
        if label not in ("slip", "non-slip"):
            raise ValueError(f"--label must be WORD=slip or WORD=non-slip, got {pair!r}")
        words[word] = label_of(label) == "slip"
    return Answers(
        rate_hz=None if given.rate is None else _number(given.rate, "--rate HZ"),
        units=given.units,
        time=given.time,
        time_unit=given.time_unit,
        pattern=given.pattern,
        column=given.column,
        over=None if given.over is None else _number(given.over, "--over"),
        words=words,
    )


def _ask(takes_likely: bool) -> Callable[[Question], str]:
    """What answers questions: a person, or nobody, so that what is likely is taken."""

    def likely(question: Question) -> str:
        if question.default:
            print(f"assumed: {question.default}, of: {question.text} ({question.flag})")
        return question.default

    def person(question: Question) -> str:
        default = f" [{question.default}]" if question.default else ""
        try:
            return input(f"{question.text}{default}\n> ")
        except EOFError:  # nobody is there
            raise ValueError(f"{_sentence(question)} Give {question.flag}, or --yes") from None

    return likely if takes_likely else person
