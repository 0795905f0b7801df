"""A fit by shards under any batch scheduler: every job adds up its recordings, the last one solves.

    python -m tactslip_torch.train recipe=paper data.cycles=2 hydra.run.dir=first
    for k in $(seq 16); do python examples/batch_fit.py collect first $k/16 sums-$k.stats; done
    python examples/batch_fit.py solve first detector.pt sums-*.stats

A first training, on few recordings if there are many, chooses features, scaling, C and c. Each
``collect`` may run on another machine, with other recordings in its ``KEY=VALUE`` arguments, such
as ``data.cycles=56``: the same in every shard. A recording that two shards hold is refused.
"""

from __future__ import annotations

import sys
from pathlib import Path

from hydra.utils import instantiate
from omegaconf import OmegaConf

from tactslip_torch import SlipDetector, SufficientStats
from tactslip_torch.training.datamodule import FeatureMaker


def collect(run: Path, shard: str, out: Path, overrides: list[str]) -> None:
    """Add up the training bins of every n-th recording."""
    detector = SlipDetector.load(run / "detector.pt")
    config = OmegaConf.merge(OmegaConf.load(run / "config.yaml"), OmegaConf.from_dotlist(overrides))
    source = instantiate(config.data, _convert_="all")
    fold = instantiate(config.split, _convert_="all")(source.ids)[0]
    rule = instantiate(config.labels)
    pool = detector.pool.select(detector.selected)
    maker = FeatureMaker(source, pool, detector.channel_filter, rule)
    part, parts = map(int, shard.split("/"))
    sums = SufficientStats(len(detector.selected))
    for recording in fold.having("train")[part - 1 :: parts]:
        made = maker(recording).in_split(fold)
        trained = made.roles["train"]
        features = detector.scaler(made.features[trained].double())
        sums.update(str(recording), features, made.is_slip[trained])
    sums.save(out)


def solve(run: Path, out: Path, shards: list[Path]) -> None:
    """Put the sums of all shards together, and solve for the machine."""
    detector = SlipDetector.load(run / "detector.pt")
    sums = SufficientStats.load(shards[0])
    for path in shards[1:]:
        sums.merge(SufficientStats.load(path))
    info = detector.info
    detector.head = sums.solve(info["penalty"], info["kernel"]["offset"], balance="weights")
    detector.save(out)
    print(f"{out}: {int(sums.count.sum())} bins of {len(sums.seen_batches)} recordings")


if __name__ == "__main__":
    action, folder, *rest = sys.argv[1:]
    if action == "collect":
        collect(Path(folder), rest[0], Path(rest[1]), rest[2:])
    else:
        solve(Path(folder), Path(rest[0]), [Path(path) for path in rest[1:]])
