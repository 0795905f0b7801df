"""Compression of heavy tails where the ratio of value and knee leaves the normal numbers."""

import math

import torch

from tactslip_torch.features.ops import signed_log


def test_a_value_far_below_its_knee_is_itself():
    """Found by hypothesis: 3.8e-11 beside 1.3e29 is bent away from zero, by 3e-6 of itself."""
    value, knee = torch.tensor([math.exp(-24)]), torch.tensor([math.exp(67)])
    torch.testing.assert_close(signed_log(value, knee), value, rtol=4 * 2.0**-23, atol=0)
