"""``SlipDetector``: from a bin of all channels to a score, positive for slip. One module, one file.

A file is a plain table of tensors and JSON text; loading it executes nothing.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from tactslip_torch.features.pool import FeatureName, FeaturePool
from tactslip_torch.files import whole_file
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.quadratic import QuadraticForm
from tactslip_torch.model.scaling import MinMaxScaler
from tactslip_torch.signals.filtering import ChannelFilter

FORMAT = "tactslip_torch detector 1"


class SlipDetector(nn.Module):
    """The fitted pipeline from filtered or raw samples to a score.

    Features are computed in the dtype of the bins; scaling and the quadratic form in the dtype of
    the detector (float64 as fitted; ``detector.float()`` for float32).

    Args:
        pool: what features there are.
        channel_filter: the Savitzky-Golay filter of each channel.
        selected: pool indices of the features in use.
        scaler: of the selected features.
        head: the machine on scaled features.
        info: JSON-able facts about the training, kept in the file.

    Raises:
        ValueError: if the parts disagree about the number of channels or features.
    """

    def __init__(
        self,
        pool: FeaturePool,
        channel_filter: ChannelFilter,
        selected: Sequence[int],
        scaler: MinMaxScaler,
        head: QuadraticForm,
        info: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        if not len(selected) == len(scaler.minimum) == len(head.linear):
            raise ValueError(
                f"{len(selected)} selected features, a scaler of {len(scaler.minimum)} and a head "
                f"of {len(head.linear)}: the three must agree"
            )
        outside = [int(i) for i in selected if not 0 <= i < len(pool.names)]
        if outside:
            raise ValueError(
                f"selected features must lie in 0..{len(pool.names) - 1}, the pool's "
                f"{len(pool.names)}, got {outside[0]}"
            )
        if len(channel_filter.window_lengths) != len(pool.hand):
            raise ValueError(
                f"a filter of {len(channel_filter.window_lengths)} channels does not fit a hand "
                f"of {len(pool.hand)}"
            )
        self.pool = pool
        self.channel_filter = channel_filter
        self.scaler = scaler
        self.head = head
        self.selected = tuple(int(i) for i in selected)
        self.info = dict(info or {})

    @property
    def selected_names(self) -> tuple[FeatureName, ...]:
        """Names of the features in use, best first."""
        return tuple(self.pool.names[i] for i in self.selected)

    @property
    def context(self) -> int:
        """Samples ``score_raw`` needs on each side of a bin."""
        return self.channel_filter.context

    def forward(self, bins: Tensor) -> Tensor:
        """Score filtered bins; at least 0 means slip, NaN where a needed value is not finite.

        Shape:
            - bins: ``[*, C, n]``
            - output: ``[*]``, dtype of ``bins``

        Raises:
            ValueError: if the number of channels or samples is another.
        """
        index = torch.tensor(self.selected, device=bins.device)
        return self.score_features(self.pool(bins).index_select(-1, index)).to(bins.dtype)

    def validity(self, bins: Tensor) -> Tensor:
        """Whether every channel the score depends on can be trusted (``FeaturePool.validity``).

        Shape:
            - bins: ``[*, C, n]``, filtered
            - output: ``[*]``, bool

        Raises:
            ValueError: as ``forward``.
        """
        needed = {name.channel for name in self.selected_names}
        used = [i for i, name in enumerate(self.pool.hand.names) if name in needed]
        valid: Tensor = self.pool.validity(bins)[..., used].all(-1)
        return valid

    def score_features(self, features: Tensor) -> Tensor:
        """Score selected, unscaled features.

        Shape:
            - features: ``[*, K]`` in the order of ``selected``
            - output: ``[*]``, dtype of the detector
        """
        score: Tensor = self.head(self.scaler(features.to(self.head.linear.dtype)))
        return score

    def score_raw(self, samples: Tensor) -> Tensor:
        """Filter and score raw bins that come with ``context`` samples on each side.

        Shape:
            - samples: ``[*, C, n + 2 * context]``, volts
            - output: ``[*]``

        Raises:
            ValueError: if the number of channels or samples is another.
        """
        score: Tensor = self(self.channel_filter.valid(samples))
        return score

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the detector to one file, whole or not at all."""
        pool = self.pool
        config = {
            "channels": pool.hand.to_rows(),
            "pool": {
                "sample_rate_hz": pool.sample_rate_hz,
                "bin_samples": pool.bin_samples,
                "wavelet": pool.wavelet,
                "level": pool.level,
                "spectrum": pool.spectrum,
            },
            "window_lengths": list(self.channel_filter.window_lengths),
            "polyorder": self.channel_filter.polyorder,
            "info": self.info,
        }
        content = {
            "format": FORMAT,
            "config": json.dumps(config),
            "selected": torch.tensor(self.selected),
            "state": {name: value.cpu() for name, value in self.state_dict().items()},
        }
        with whole_file(path) as temporary:
            torch.save(content, temporary)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SlipDetector:
        """Read a detector; nothing in the file is executed.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is not a detector file, or a damaged one.
        """
        try:
            content = torch.load(path, map_location="cpu", weights_only=True)
        except FileNotFoundError:
            raise FileNotFoundError(f"no detector at {os.fspath(path)}") from None
        except Exception as error:  # torch.load raises many kinds for a file that is not its own
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise ValueError(f"{os.fspath(path)} is not a readable detector: {reason}") from error
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ValueError(f"{os.fspath(path)} is not a file of format {FORMAT!r}")
        try:
            return cls._from_content(content)
        except (AttributeError, KeyError, TypeError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"{os.fspath(path)} is a damaged detector: {reason}") from error

    @classmethod
    def _from_content(cls, content: Mapping[str, Any]) -> SlipDetector:
        config = json.loads(content["config"])
        state = content["state"]
        return cls(
            FeaturePool(HandLayout.from_rows(config["channels"]), **config["pool"]),
            ChannelFilter(config["window_lengths"], config["polyorder"]),
            content["selected"].tolist(),
            MinMaxScaler(state["scaler.minimum"], state["scaler.maximum"]),
            QuadraticForm(state["head.quadratic"], state["head.linear"], state["head.constant"]),
            config["info"],
        )
