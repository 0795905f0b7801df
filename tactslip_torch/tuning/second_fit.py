"""A learner that fits what tuning found, and the maker of its features."""

from __future__ import annotations

from tactslip_torch.feature_maker import FeatureMaker
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.learning import SlipLearner
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


def tuned_learner(tuned: Tuned, maker: FeatureMaker, first: SlipLearner) -> SlipLearner:
    """A learner with nothing left to choose, of a maker's features."""
    return SlipLearner(
        maker.pool,
        maker.channel_filter,
        tuned.recipe(first.recipe),
        abstaining=first.abstaining,
        frame=tuned.frame,
    )
