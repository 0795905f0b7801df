"""A filter learned by gradient through the closed-form fit: ``python examples/learned_filter.py``.

One film feels noise; in slip it trembles a little at 300 Hz, of which the moving average that it is
smoothed by at first leaves next to nothing. Each bin is scored by the machine without its group, in
closed form, and the log loss of these scores says how the eleven weights should change. The weights
end up in an ordinary detector.
"""

from __future__ import annotations

import sys

import torch
from torch import Tensor
from torch.nn.functional import softplus

from tactslip_torch import FeaturePool, HandLayout, SlipDetector
from tactslip_torch.hand import Channel
from tactslip_torch.model.fit import fit_quadratic
from tactslip_torch.model.leave_one_group_out import held_out_scores
from tactslip_torch.model.scaling import FeatureScaler
from tactslip_torch.signals.filtering import ChannelFilter

LENGTH, SAMPLES, CONTEXT = 11, 100, 10
PENALTY = 1.0  # the paper's C


def raw_bins(num: int = 80) -> tuple[Tensor, Tensor, Tensor]:
    """Bins with their context, ``[N, 1, n + 10]`` volts, which are slip, and their groups."""
    generator = torch.Generator().manual_seed(0)
    is_slip, groups = torch.arange(num) % 2 == 1, torch.arange(num) // 2 % 4
    time_s = torch.arange(SAMPLES + CONTEXT) / 2000.0
    noise = torch.randn(num, 1, SAMPLES + CONTEXT, generator=generator)
    tremor = 0.5 * torch.sin(2 * torch.pi * 300.0 * time_s) * is_slip[:, None, None]
    return (noise + tremor).double(), is_slip, groups


def main(path: str = "learned_filter.pt", steps: int = 25) -> list[float]:
    """Learn, and save a detector with what was learned; the held-out loss at each step."""
    pool = FeaturePool(HandLayout([Channel("film", "PVDF", "index", "tip", "fast")]))
    selected = [i for i, name in enumerate(pool.names) if name.descriptor in ("std", "energy")]
    raw, is_slip, groups = raw_bins()
    change = torch.zeros(LENGTH, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([change], lr=0.04)
    losses = []
    for _ in range(steps):
        even = (change + change.flip(0)) / 2  # symmetric, so that nothing is delayed
        kernel = 1 / LENGTH + even - even.mean()  # sums to 1: constants stay
        features = pool(raw.unfold(-1, LENGTH, 1) @ kernel)[:, selected]
        scaler = FeatureScaler.fit(features.detach(), compress=True)
        scores = held_out_scores(scaler(features), is_slip, groups, PENALTY)
        loss = softplus(torch.where(is_slip, -4.0, 4.0) * scores).mean()
        losses.append(float(loss.detach()))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        print(f"held-out loss {losses[-1]:.4f}", file=sys.stderr)
    channel_filter = ChannelFilter([LENGTH], kernels={LENGTH: kernel.tolist()})
    head = fit_quadratic(scaler(features.detach()), is_slip, PENALTY)
    SlipDetector(pool, channel_filter, selected, scaler, head).save(path)
    return losses


if __name__ == "__main__":
    main()
