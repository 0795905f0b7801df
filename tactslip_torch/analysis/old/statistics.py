"""What a first pass over training recordings learns."""

from __future__ import annotations

import torch
from torch import Tensor

from tactslip_torch.analysis.old.bin_sample import BinSample
from tactslip_torch.features.selection import ClassMoments
from tactslip_torch.runtime import SeenBatches, content_digest


class TrainingStatistics:
    """Moments, ranges and a sample of training bins, and which recordings they are of.

    Memory grows with the sample and the number of recordings, not with that of bins. Ranges and
    the sample forget what they pass over, so a recording cannot be taken out again: statistics the
    others anew, or keep a statistics for each group and merge those that are wanted.

    Args:
        num_features: length of a feature vector.
        sample_bins: bins the sample keeps of each group and class.

    Attributes:
        moments: of all bins.
        minimum: ``[F]``, float32, of all bins; +inf without any.
        maximum: ``[F]``, float32; -inf without any.
        longest_run: most equal samples in a row of a channel that moves.
        sample: bins by group and class.
        seen_batches: recording names and digests of their bins.
    """

    def __init__(self, num_features: int, sample_bins: int) -> None:
        self.moments = ClassMoments(num_features)
        self.minimum = torch.full((num_features,), torch.inf)
        self.maximum = torch.full((num_features,), -torch.inf)
        self.longest_run = 0
        self.sample = BinSample(sample_bins)
        self.seen_batches = SeenBatches()

    @property
    def num_features(self) -> int:
        """Length of a feature vector."""
        return len(self.minimum)

    def update(
        self,
        recording: str,
        group: str,
        features: Tensor,
        is_slip: Tensor,
        longest_run: int = 0,
    ) -> None:
        """Add the training bins of a recording: all of them or, on an error, none.

        Args:
            recording: its name.
            group: that the sample draws from.
            features: of its bins.
            is_slip: which they are.
            longest_run: most equal samples in a row of a channel of it that moves.

        Shape:
            - features: ``[N, F]``, float32, finite
            - is_slip: ``[N]``, 1 or True for slip

        Raises:
            ValueError: if the recording is in already, or for another shape or dtype, or a value
                that is not finite.
        """
        features, is_slip = features.detach().cpu(), is_slip.cpu().bool()
        digest = content_digest(features, is_slip)
        self.seen_batches.add(recording, digest)
        try:
            self.moments.update(features, is_slip)
        except ValueError as error:
            self.seen_batches.remove(recording, digest)
            raise ValueError(f"recording {recording!r}: {error}") from None
        self.sample.update(recording, group, features, is_slip)
        self.longest_run = max(self.longest_run, longest_run)
        if len(features):
            self._widen(features.amin(0), features.amax(0))

    def merge(self, other: TrainingStatistics) -> None:
        """Add the recordings of another statistics: all of them or, on an error, none.

        Raises:
            ValueError: if a recording is in both, or the two differ in the number of features
                or in the size of the sample.
        """
        for what, ours, theirs in (
            ("features", self.num_features, other.num_features),
            ("sample_bins", self.sample.most, other.sample.most),
        ):
            if ours != theirs:
                raise ValueError(f"cannot merge statistics of {ours} and {theirs} {what}")
        self.seen_batches.merge(other.seen_batches)
        self.moments.merge(other.moments)
        self.sample.merge(other.sample)
        self.longest_run = max(self.longest_run, other.longest_run)
        self._widen(other.minimum, other.maximum)

    def _widen(self, minimum: Tensor, maximum: Tensor) -> None:
        # which of 0 and -0 is taken depends on their order; adding 0 leaves 0 alone
        self.minimum = torch.minimum(self.minimum, minimum) + 0.0
        self.maximum = torch.maximum(self.maximum, maximum) + 0.0
