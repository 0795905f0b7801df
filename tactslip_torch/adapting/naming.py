"""Which recordings are known already, whatever they are called now: by the key of their content."""

from __future__ import annotations

from collections.abc import Mapping

from tactslip_torch.adapting.bins import RecordingBins
from tactslip_torch.adapting.statistics import Statistics


def materials_of(statistics: Statistics) -> dict[str, str]:
    """The material of every recording that is or was in, by name."""
    witnesses = statistics.witnesses
    trained = dict(zip(witnesses.recordings, witnesses.materials, strict=True))
    return trained | {name: own.material for name, own in statistics.bins.items()}


def known_names(
    statistics: Statistics, trained: Mapping[str, str], *, is_in: bool
) -> dict[str, tuple[str, str]]:
    """Name and material of recordings, by key.

    Args:
        statistics: of a detector.
        trained: the keys it tells of recordings that it was trained on, by name.
        is_in: those alone that are in; else those that were taken out too.
    """
    materials = materials_of(statistics)
    keys = dict(trained) | {name: own.key for name, own in statistics.bins.items()}
    order = sorted(keys, key=lambda name: statistics.weight_of(name) > 0)  # one that is in wins
    return {
        keys[name]: (name, materials[name])
        for name in order
        if keys[name] and name in materials and (statistics.weight_of(name) > 0 or not is_in)
    }


def check_once(bins: Mapping[str, RecordingBins], names_in: Mapping[str, tuple[str, str]]) -> None:
    """That no recording comes in twice.

    Args:
        bins: of the recordings that are to come in, by name.
        names_in: what ``known_names`` tells of those that are in.

    Raises:
        ValueError: if one is in already, or is there twice, by whatever name.
    """
    first: dict[str, str] = {}
    for name, own in bins.items():
        if own.key in names_in:
            known, _ = names_in[own.key]
            called = "" if known == name else f" as {known}"
            raise ValueError(f"{name} is in already{called}; action=forget takes it out first")
        if (other := first.setdefault(own.key, name)) != name:
            raise ValueError(f"{name} is the same recording as {other}; give it once")
