"""The parts of a detector must fit together, or it is refused."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.pooling import ChannelPooling
from tactslip_torch.model.detector_file import Head
from tactslip_torch.model.missing_channels import ClassGaussians
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.signals.filtering import ChannelFilter


def check_parts(
    pool: FeaturePool,
    channel_filter: ChannelFilter,
    selected: Sequence[int],
    scaler: FeatureScaler,
    head: Head,
    imputation: Tensor,
    gaussians: ClassGaussians | None,
    pooling: ChannelPooling | None = None,
) -> None:
    """Refuse parts that disagree; what they are ``SlipDetector`` says.

    Raises:
        ValueError: if they disagree about the number of channels or features, or imputation values
            are not scaled.
    """
    num = len(selected)
    if pooling is not None:
        given = tuple(pool.names[index] for index in selected if 0 <= index < len(pool.names))
        if given != pooling.inputs or pooling.hand != pool.hand:
            raise ValueError(
                f"{num} selected features do not fit a pooling of {len(pooling.inputs)}: they must "
                "be its inputs, in their order"
            )
        num = len(pooling.names)
    if not num == len(scaler.minimum) == head.num_features:
        raise ValueError(
            f"{num} columns, a scaler of {len(scaler.minimum)} and a head of "
            f"{head.num_features}: the three must agree"
        )
    if len(channel_filter.window_lengths) != len(pool.hand):
        raise ValueError(
            f"a filter of {len(channel_filter.window_lengths)} channels does not fit a hand "
            f"of {len(pool.hand)}"
        )
    if imputation.shape != (num,) or not bool((imputation.abs() <= 1).all()):
        raise ValueError(
            f"imputation must be {num} scaled features in [-1, 1], got "
            f"{tuple(imputation.shape)} of at most {float(imputation.abs().max()):g}"
        )
    if gaussians is not None and gaussians.num_features != num:
        raise ValueError(f"Gaussians of {gaussians.num_features} features do not fit {num} of them")
