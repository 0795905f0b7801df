"""Learners that fit what is settled, and the maker of the features that was tuned."""

from __future__ import annotations

from typing import Any

from tactslip_torch.feature_maker import FeatureMaker
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.learning import SlipLearner
from tactslip_torch.recipe import Frame, Recipe
from tactslip_torch.signals.filtering import ChannelFilter
from tactslip_torch.tuning.stage import Tuned


def tuned_maker(tuned: Tuned, maker: FeatureMaker) -> FeatureMaker:
    """The maker of the features with the filters that were learned."""
    pool, channel_filter = maker.pool, maker.channel_filter
    if tuned.wavelet is not None:
        pool = FeaturePool(pool.hand, **pool.facts() | {"wavelet": tuned.wavelet})
    if tuned.kernels is not None:
        channel_filter = ChannelFilter(**channel_filter.facts() | {"kernels": tuned.kernels})
    return FeatureMaker(
        maker.source,
        pool,
        channel_filter,
        maker.rule,
        maker.cache,
        maker.dtype,
        maker.extractor.engine,
    )


def settled_learner(
    first: SlipLearner, maker: FeatureMaker, frame: Frame, penalty: float, offset: float
) -> SlipLearner:
    """A learner with nothing left to choose.

    Args:
        first: whose recipe it takes else.
        maker: of its features.
        frame: which, and how scaled.
        penalty: C.
        offset: the kernel's c.
    """
    changes: dict[str, Any] = {"num_features": len(frame.selected)}
    recipe = Recipe(**first.recipe.facts() | changes | {"penalties": penalty, "offsets": offset})
    parts = (maker.pool, maker.channel_filter, recipe)
    options: dict[str, Any] = {"frame": frame, "with_baselines": first.with_baselines}
    return SlipLearner(*parts, abstaining=first.abstaining, **options)
