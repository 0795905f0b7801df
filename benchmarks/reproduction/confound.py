"""Does it feel slip, or hear the arm? Tables, and a conclusion that follows from the numbers."""

from __future__ import annotations

from typing import NamedTuple

from benchmarks.reproduction.results import (
    MeanSd,
    Report,
    by_seed,
    labels_of,
    on_shared_seeds,
    percent,
    seeds_text,
    text,
)
from benchmarks.tables import Table

FOLDS = {"protocol": "the protocol alone", "with_scenes": "such scenes as well"}
"""What the two detectors are trained on."""

PAPER_SCENE = "paper"
SCENES = {
    PAPER_SCENE: "the paper's protocol",
    "arm_motion": "arm moves, nothing slips",
    "pulled": "object pulled, arm at rest",
    "motor_off": "protocol, arm neither heard nor felt",
    "taps": "knocks on the object, held still",
    "grips": "grip force changes",
    "machine": "a machine nearby",
    "mains_bursts": "bursts of mains hum",
}
"""Scenes in words; one that is not here goes by its name."""

CLEARLY = 2.0
"""Points by which scenes must be told better, on average in every seed."""

NO_WORSE = 0.5
"""Points that the protocol may lose, on average over seeds, seen and unseen alike."""

FAR_BEHIND = 10.0
"""Points of recall by which a scene must fall behind the same class of the protocol to be lost."""

ROLES = ("test", "unseen")
CLASSES = ("non_slip_recall", "slip_recall")


class Verdict(NamedTuple):
    """What training with such scenes does, in points of balanced accuracy.

    Attributes:
        gains: on the scenes that are not the protocol, mean of them, a number a seed.
        changes: on the protocol by role, a number a seed.
    """

    gains: list[float]
    changes: dict[str, list[float]]

    @property
    def is_better(self) -> bool:
        """Whether scenes are told clearly better, in every seed."""
        return min(self.gains) > CLEARLY

    @property
    def is_no_worse(self) -> bool:
        """Whether the protocol is kept."""
        means = [MeanSd.of(values).mean for values in self.changes.values()]
        return min(means) >= -NO_WORSE

    @property
    def recommends(self) -> bool:
        """Whether to train with such scenes."""
        return self.is_better and self.is_no_worse


def recalls(report: Report, fold: str, role: str, scene: str) -> list[float]:
    """Mean recall, in percent, of the classes that a scene has; a number a seed.

    That is balanced accuracy; the recall of non-slip where nothing slips.
    """
    group = ("per_scene", [scene])
    both = [percent(report, f"confound: {fold}", role, score, group) for score in CLASSES]
    there = [values for values in both if values]
    return [sum(values) / len(values) for values in zip(*there, strict=True)]


def scenes_of(report: Report) -> list[str]:
    """Scenes that both are judged on, the protocol first."""
    found = labels_of(report, "confound: protocol", "test", "per_scene")
    return sorted(found, key=lambda scene: scene != PAPER_SCENE)


def others_of(report: Report) -> list[str]:
    """All of them but the protocol."""
    return [scene for scene in scenes_of(report) if scene != PAPER_SCENE]


def difference(report: Report, role: str, scene: str) -> list[float]:
    """Points that a scene gains when such scenes are trained on, a number a seed."""
    before, after = (recalls(report, fold, role, scene) for fold in FOLDS)
    return [b - a for a, b in zip(before, after, strict=True)]


def verdict(report: Report) -> Verdict:
    """What follows from the runs of ``confound``."""
    by_scene = [difference(report, "test", scene) for scene in others_of(report)]
    gains = [sum(values) / len(values) for values in zip(*by_scene, strict=True)]
    return Verdict(gains, {role: difference(report, role, PAPER_SCENE) for role in ROLES})


def confound_tables(report: Report) -> dict[str, Table]:
    """Both tables by title, and what the second gains."""
    trained = {fold: {PAPER_SCENE} for fold in FOLDS}
    trained["with_scenes"].update(trained_scenes(report))
    found = {}
    for fold, words in FOLDS.items():
        rows = []
        for scene in scenes_of(report):
            cells = [
                text(percent(report, f"confound: {fold}", role, score, ("per_scene", [scene])))
                for role in ROLES
                for score in CLASSES
            ]
            gain = [text(difference(report, role, scene), sign="+") for role in ROLES]
            is_second = fold == "with_scenes"
            mark = " (trained on)" if scene in trained[fold] else ""
            rows.append([f"{named(scene)}{mark}", *cells, *(gain if is_second else [])])
        header = ["judged on"]
        header += [f"{role}: {name}, %" for role in ROLES for name in ("non-slip", "slip")]
        header += [f"{role}: gain, points" for role in ROLES] if fold == "with_scenes" else []
        note = "Recalls; - where a scene has no bin of a class. Gains are of their mean."
        found[f"Trained on {words}"] = Table(header, rows, note)
    return found


def trained_scenes(report: Report) -> list[str]:
    """Scenes that the second detector is trained on beside the protocol."""
    return [scene for run in report["runs"]["confound"][:1] for scene in run["trained_scenes"]]


def named(scene: str) -> str:
    """A scene in words, with its name."""
    return f"{SCENES[scene]}, `{scene}`" if scene in SCENES else f"`{scene}`"


def conclusion(report: Report) -> list[str]:
    """Paragraphs whose sentences follow from the numbers."""
    found = verdict(report)
    gain = MeanSd.of(found.gains).text(sign="+")
    by_role = " and ".join(
        f"{text(values, sign='+')} points on {'seen' if role == 'test' else 'unseen'} materials"
        for role, values in found.changes.items()
    )
    measured = (
        f"Over {seeds_text(len(found.gains))}, training with such scenes gains {gain} "
        f"points on the scenes (mean over all but the protocol, test cycles; from "
        f"{min(found.gains):+.2f} to {max(found.gains):+.2f} by seed) and changes the protocol by "
        f"{by_role}. "
    )
    criteria = (
        f"Clearly better means more than {CLEARLY:g} points in every seed, no worse a mean loss of "
        f"at most {NO_WORSE:g} points on seen and on unseen materials."
    )
    return [_hears(report), measured + _sentence(found) + f" {criteria}", _for_recorders(found)]


def _sentence(found: Verdict) -> str:
    if found.recommends:
        return (
            "**It is clearly better on them and no worse on the protocol, so it is the recommended "
            "way to train.**"
        )
    if found.is_better:
        return (
            "**It is clearly better on them but worse on the protocol, so it is recommended only "
            "where an arm moves without slip, and is not the default.**"
        )
    worse = "" if found.is_no_worse else ", and worse on the protocol"
    return f"**It is not clearly better on them{worse}, so training stays as it is.**"


def behind(report: Report, scene: str, score: str) -> list[float]:
    """Points by which a class of a scene is recalled worse than the same class of the protocol.

    Of the detector of the protocol, test cycles; a number a seed, none without such bins.
    """
    own, base = (
        by_seed(report, "confound: protocol", "test", score, ("per_scene", [of]))
        for of in (scene, PAPER_SCENE)
    )
    return [b - a for a, b in zip(*on_shared_seeds(own, base), strict=True)]


CHECKS = (
    ("arm_motion", "non_slip_recall", "Of bins in which the arm moves and nothing slips"),
    ("pulled", "slip_recall", "Of slip bins with the arm at rest"),
    ("motor_off", "slip_recall", "Of slip bins of the protocol with a silent arm"),
)
"""Scenes in which slip and the arm part, the class that tells, and its bins in words."""


def _hears(report: Report) -> str:
    """What the detector of the protocol makes of an arm that moves, and of slip without it."""
    parts: list[str] = []
    lost, wavering = [], []
    for scene, score, words in CHECKS:
        falls = behind(report, scene, score)
        if not falls:
            continue
        kind = "non-slip" if score == "non_slip_recall" else "slip"
        parts.append(
            f"{words} the detector of the protocol calls {_called_slip(report, scene, score)} % "
            f"slip, of {kind} bins of the protocol {_called_slip(report, PAPER_SCENE, score)} %."
        )
        if min(falls) > FAR_BEHIND:
            lost.append(named(scene))
        elif max(falls) > FAR_BEHIND:
            wavering.append(named(scene))
    far = f"more than {FAR_BEHIND:g} points behind the same class of the protocol"
    if lost:
        parts.append(
            f"On {' and '.join(lost)} it falls {far} in every seed: there it hears the arm rather "
            "than feels slip."
        )
    if wavering:
        parts.append(f"On {' and '.join(wavering)} it falls {far} in some seeds and not in others.")
    if parts and not lost and not wavering:
        parts.append(
            f"On none of these and in no seed does it fall {far}: on the simulated hand it feels "
            "slip more than it hears the arm."
        )
    return " ".join([*parts, _worst(report)])


def _called_slip(report: Report, scene: str, score: str) -> str:
    """Of bins of a scene and of the class of a recall, what the detector calls slip, percent."""
    values = percent(report, "confound: protocol", "test", score, ("per_scene", [scene]))
    return text([100 - value for value in values] if score == "non_slip_recall" else values)


def _worst(report: Report) -> str:
    """The scene whose classes fall furthest behind the same classes of the protocol."""
    of_scenes = {scene: _mean_behind(report, scene) for scene in others_of(report)}
    worst = max(of_scenes, key=lambda scene: MeanSd.of(of_scenes[scene]).mean)
    falls = of_scenes[worst]
    if MeanSd.of(falls).mean <= 0:
        return "On no scene are its classes recalled worse than the same classes of the protocol."
    own = recalls(report, "protocol", "test", worst)
    base = [value + fall for value, fall in zip(own, falls, strict=True)]
    return (
        f"Of all scenes it is fooled most by `{worst}`: mean recall {text(own)} %, of the same "
        f"classes of the protocol {text(base)} %."
    )


def _mean_behind(report: Report, scene: str) -> list[float]:
    """Mean over the classes that a scene has of what it falls behind, a number a seed."""
    by_class = [falls for score in CLASSES if (falls := behind(report, scene, score))]
    return [sum(values) / len(values) for values in zip(*by_class, strict=True)]


def _for_recorders(found: Verdict) -> str:
    negatives = (
        "arm motion with the object carried, knocks on the object, changes of grip, and slip of a "
        "pulled object with the arm at rest"
    )
    if found.recommends:
        line = "**Whoever records a real hand:** record these as well, and train on them: "
        return f"{line}{negatives}."
    return (
        f"**Whoever records a real hand:** record these as well, to judge on if not to train on: "
        f"{negatives}. Without them nobody can tell what a score in this protocol means."
    )
