"""What a first pass over training recordings learns, the same bits for any order and sharding."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from tactslip_torch.features.bin_sample import BinSample
from tactslip_torch.features.selection import ClassMoments
from tactslip_torch.files import load_table, save_table
from tactslip_torch.ledger import Ledger, content_digest, first_difference

FORMAT = "tactslip_torch survey 1"


class Survey:
    """Moments, ranges and a sample of training bins, with a ledger of their recordings.

    Memory grows with the sample and the number of recordings, not with that of bins. Ranges and
    the sample forget what they pass over, so a recording cannot be taken out again: survey the
    others anew, or keep a survey for each group and merge those that are wanted.

    Args:
        num_features: length of a feature vector.
        sample_bins: bins the sample keeps of each group and class.
        about: what features, hand and labels are, as JSON holds it; only surveys that agree in
            it merge.

    Attributes:
        moments: of all bins.
        minimum: ``[F]``, float32, of all bins; +inf without any.
        maximum: ``[F]``, float32; -inf without any.
        sample: bins by group and class.
        ledger: recording names and digests of their bins.
        about: as given.

    Raises:
        ValueError: if JSON does not hold ``about``.
    """

    def __init__(
        self, num_features: int, sample_bins: int, about: Mapping[str, Any] | None = None
    ) -> None:
        try:
            text = json.dumps(about or {}, sort_keys=True, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise ValueError(f"about must be what JSON holds: {error}") from None
        self.about: dict[str, Any] = json.loads(text)
        self.moments = ClassMoments(num_features)
        self.minimum = torch.full((num_features,), torch.inf)
        self.maximum = torch.full((num_features,), -torch.inf)
        self.sample = BinSample(sample_bins)
        self.ledger = Ledger()

    @property
    def num_features(self) -> int:
        """Length of a feature vector."""
        return len(self.minimum)

    def update(self, recording: str, group: str, features: Tensor, is_slip: Tensor) -> None:
        """Add the training bins of a recording: all of them or, on an error, none.

        Shape:
            - features: ``[N, F]``, float32, finite
            - is_slip: ``[N]``, 1 or True for slip

        Raises:
            ValueError: if the recording is in already, or for another shape or dtype, or a value
                that is not finite.
        """
        features, is_slip = features.detach().cpu(), is_slip.cpu().bool()
        digest = content_digest(features, is_slip)
        self.ledger.add(recording, digest)
        try:
            self.moments.update(features, is_slip)
        except ValueError as error:
            self.ledger.remove(recording, digest)
            raise ValueError(f"recording {recording!r}: {error}") from None
        self.sample.update(recording, group, features, is_slip)
        if len(features):
            self._widen(features.amin(0), features.amax(0))

    def merge(self, other: Survey) -> None:
        """Add the recordings of another survey: all of them or, on an error, none.

        Raises:
            ValueError: if a recording is in both, or the surveys differ in what they are about,
                in the number of features or in the size of the sample; the first difference is
                named.
        """
        ours = {"about": self.about, "sample_bins": self.sample.most}
        theirs = {"about": other.about, "sample_bins": other.sample.most}
        if difference := first_difference(ours, theirs):
            raise ValueError(f"cannot merge surveys that differ in {difference}")
        moments = self.moments.merge(other.moments)
        self.ledger.merge(other.ledger)
        self.moments = moments
        self.sample.merge(other.sample)
        self._widen(other.minimum, other.maximum)

    def state_dict(self) -> dict[str, Any]:
        """``facts`` that JSON holds and ``tensors`` by name, the same for the same recordings."""
        sample = self.sample.state_dict()
        tensors = {f"moments.{name}": part for name, part in self.moments.state_dict().items()}
        tensors |= {f"sample.{name}": part for name, part in sample["tensors"].items()}
        tensors |= {"minimum": self.minimum.clone(), "maximum": self.maximum.clone()}
        facts = {
            "about": self.about,
            "recordings": dict(sorted(self.ledger.entries.items())),
            "sample": sample["facts"],
        }
        return {"facts": facts, "tensors": tensors}

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> Survey:
        """The survey that ``state_dict`` described."""
        facts, tensors = state["facts"], state["tensors"]
        survey = cls(len(tensors["minimum"]), facts["sample"]["most"], facts["about"])
        survey.moments = ClassMoments.from_state_dict(_under("moments.", tensors))
        survey.minimum = tensors["minimum"].clone()
        survey.maximum = tensors["maximum"].clone()
        survey.sample = BinSample.from_state_dict(
            {"facts": facts["sample"], "tensors": _under("sample.", tensors)}
        )
        survey.ledger = Ledger(facts["recordings"])
        return survey

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file, whole or not at all; the same bytes for the same recordings."""
        state = self.state_dict()
        save_table(path, FORMAT, state["facts"], state["tensors"])

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Survey:
        """The survey in a file.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is no survey, or damaged.
        """
        facts, tensors = load_table(path, FORMAT)
        try:
            return cls.from_state_dict({"facts": facts, "tensors": tensors})
        except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
            raise ValueError(f"{os.fspath(path)} is a damaged survey; make it again") from error

    def _widen(self, minimum: Tensor, maximum: Tensor) -> None:
        # which of 0 and -0 is taken depends on their order; adding 0 leaves 0 alone
        self.minimum = torch.minimum(self.minimum, minimum) + 0.0
        self.maximum = torch.maximum(self.maximum, maximum) + 0.0


def _under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {
        name.removeprefix(prefix): part for name, part in tensors.items() if name.startswith(prefix)
    }
