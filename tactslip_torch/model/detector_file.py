"""A fitted detector in one file: a plain table of tensors and JSON text that executes nothing."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from torch import Tensor

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.kernels import KernelSum, QuadraticForm, kernel_from_dict
from tactslip_torch.model.missing_channels import ClassGaussians
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.runtime import load_table, save_table, table_form
from tactslip_torch.signals.filtering import ChannelFilter

FORMAT = "tactslip_torch detector 3"
_EARLIER_FORMATS = ("tactslip_torch detector 1", "tactslip_torch detector 2")

Head = QuadraticForm | KernelSum
"""A quadratic form of fixed size, or the sum over training bins of a kernel that does not fold."""


class DetectorParts(NamedTuple):
    """What ``SlipDetector`` is made of, in the order of its arguments."""

    pool: FeaturePool
    channel_filter: ChannelFilter
    selected: Sequence[int]
    scaler: FeatureScaler
    head: Head
    info: Mapping[str, Any]
    imputation: Tensor
    gaussians: ClassGaussians | None
    pooling: ChannelPooling | None


def write_detector(
    path: str | os.PathLike[str],
    pool: FeaturePool,
    channel_filter: ChannelFilter,
    selected: Sequence[int],
    head: Head,
    info: Mapping[str, Any],
    pooling: ChannelPooling | None,
    state: Mapping[str, Tensor],
) -> None:
    """Write a detector with the tensors of its ``state_dict``, whole or not at all."""
    facts = {
        "channels": pool.hand.to_rows(),
        "pool": pool.facts(),
        **channel_filter.facts(),
        "selected": list(selected),
        "pooling": None if pooling is None else pooling.to_dict(),
        "kernel": head.kernel.to_dict() if isinstance(head, KernelSum) else None,
        "info": dict(info),
    }
    save_table(path, FORMAT, facts, {name: value.cpu() for name, value in state.items()})


def read_detector(path: str | os.PathLike[str]) -> DetectorParts:
    """The parts of a saved detector.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a detector file, a damaged one, or of an earlier version.
    """
    name = os.fspath(path)
    try:
        if table_form(path) in _EARLIER_FORMATS:
            raise ValueError(
                f"{name} was made by version 0.1.0 or earlier; train again, or use it with that "
                "version"
            )
        facts, state = load_table(path, FORMAT)
    except FileNotFoundError:
        raise FileNotFoundError(f"no detector at {name}") from None
    try:
        return _parts(facts, state)
    except (AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise damaged(path, error) from error


def damaged(path: str | os.PathLike[str], error: Exception) -> ValueError:
    """What to raise for a file whose parts do not fit together."""
    reason = str(error).splitlines()[0]
    return ValueError(f"{os.fspath(path)} is a damaged detector: {reason}")


def _parts(facts: Mapping[str, Any], state: Mapping[str, Tensor]) -> DetectorParts:
    def part(prefix: str) -> dict[str, Any]:
        return {
            name.removeprefix(prefix): value
            for name, value in state.items()
            if name.startswith(prefix)
        }

    head: Head
    if facts["kernel"] is None:
        head = QuadraticForm(**part("head."))
    else:
        head = KernelSum(**part("head."), kernel=kernel_from_dict(facts["kernel"]))
    hand, pooling = HandLayout.from_rows(facts["channels"]), facts["pooling"]
    return DetectorParts(
        FeaturePool(hand, **facts["pool"]),
        ChannelFilter(
            facts["window_lengths"],
            facts["polyorder"],
            facts["align"],
            facts.get("kernels"),  # only where they are none of Savitzky-Golay's
        ),
        facts["selected"],
        FeatureScaler(**part("scaler.")),
        head,
        facts["info"],
        state["imputation"],
        ClassGaussians.among(state),
        pooling and ChannelPooling.from_dict(hand, pooling, part("pooling.")),
    )
