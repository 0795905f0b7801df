"""Which sensors matter: balanced accuracy without each channel, finger and kind of channel.

The detector stays as it is; what is masked counts as missing. It is evaluated on all bins of its
test and held-out recordings, as by ``tactslip evaluate``: a bin whose decision is not valid counts
as non-slip. Where a mask leaves no decision valid, nothing is said of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from tactslip_torch.commands.entry import entry_point, save_config
from tactslip_torch.commands.evaluate import overlap
from tactslip_torch.data.recording import RecordingId, RecordingSource
from tactslip_torch.data.splits import Split
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.report import style
from tactslip_torch.report.metrics import confusion_matrix, split_metrics
from tactslip_torch.runtime import in_processes, write_json
from tactslip_torch.training.datamodule import RecordingFeatures
from tactslip_torch.training.experiment import feature_cache, features_of

_ROLES = ("test", "unseen")


def importance(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Evaluate a trained detector without each of its sensors, and write what it loses.

    Args:
        config: composed from ``conf/importance.yaml``.
        folder: where results go.

    Returns:
        The content of ``sensors.json``: ``rows`` with ``unit``, ``name``, and the balanced accuracy
        by role, null where no decision is valid.

    Raises:
        ValueError: for bad input, in one line.
        FileNotFoundError: if there is no such detector, or no configuration beside it.
    """
    model = Path(config.model)
    detector = SlipDetector.load(model)
    places = [place / "config.yaml" for place in (model.parent, model.parent.parent)]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise FileNotFoundError(f"no config.yaml beside {model}; give model=RUN/detector.pt")
    training: Any = OmegaConf.load(found)
    if not {"data", "split", "labels"} <= {*training}:
        raise ValueError(f"{found} is of no training; give model=RUN/without_OBJECT/detector.pt")
    if folder.resolve() in {place.parent.resolve() for place in places}:
        raise ValueError(f"{found} would be lost; give another folder, hydra.run.dir=FOLDER")
    source: RecordingSource = instantiate(training.data, _convert_="all")
    folds: list[Split] = instantiate(training.split, _convert_="all")(source.ids)
    fold = next((fold for fold in folds if fold.name == detector.info.get("split")), None)
    if fold is None:
        kept = f"; give a detector of a fold, such as {found.parent / folds[0].name / model.name}"
        raise ValueError(
            f"{model} was trained on all recordings, so that none is left to evaluate it on{kept}"
            if detector.info.get("split") == "all"
            else f"{found} has no fold {detector.info.get('split')!r} of {model.name}"
        )
    if fold.test_fraction is None and (known := overlap(detector, source, fold)["recordings"]):
        raise ValueError(
            f"{model} was trained on {known[0]}, which {fold.name} holds out now: the recordings "
            "have changed since; train again"
        )
    masks = _masks(source.hand)
    save_config(config, folder)
    with feature_cache(training.cache) as cache:
        maker = features_of(detector, source, instantiate(training.labels), cache)
        order = [maker.pool.selected.index(feature) for feature in detector.selected]

        def evaluated(recording: RecordingId) -> Tensor:
            """Confusions by role, mask and whether decisions are valid, ``[R, M, 2, 2, 2]``."""
            counts = torch.zeros(len(_ROLES), len(masks), 2, 2, 2, dtype=torch.long)
            bins = maker(recording).in_split(fold)
            bins = bins._replace(features=bins.features[:, order].double())
            for number, is_masked in enumerate(masks.values()):
                says_slip, is_valid = _decided(detector, bins, is_masked)
                for place, role in enumerate(_ROLES):
                    for valid, kind in enumerate((~is_valid, is_valid)):
                        mine = bins.roles[role] & kind
                        table = confusion_matrix(bins.is_slip[mine], says_slip[mine])
                        counts[place, number, valid] = torch.tensor(table)
            return counts

        recordings = fold.having(*_ROLES)
        parts = in_processes(evaluated, recordings, "recordings", "recording", config.num_workers)
        total = torch.stack(list(parts)).sum(0)
    rows: list[dict[str, Any]] = [
        {"unit": unit, "name": name}
        | {
            role: split_metrics(of.sum(0).tolist())["balanced_accuracy"] if of[1].any() else None
            for role, of in zip(_ROLES, total[:, number], strict=True)
        }
        for number, (unit, name) in enumerate(masks)
    ]
    content = {"simulated": source.is_simulated, "detector": model.name, "rows": rows}
    write_json(folder / "sensors.json", content)
    _figure(content, folder / "sensors.png")
    shown = [
        {"without": f"{row['unit']} {row['name']}".strip()}
        | {f"{role} %": style.percent(row[role]) for role in _ROLES}
        for row in rows
    ]
    table = style.table(shown, kept=1)
    print(f"\n{style.marked(source.is_simulated, table)}\n\nresults in {folder}")
    return content


@torch.no_grad()
def _decided(
    detector: SlipDetector, bins: RecordingFeatures, is_masked: Tensor
) -> tuple[Tensor, Tensor]:
    """Whether bins are called slip and are valid, ``[N]`` each, without masked channels ``[C]``."""
    always_stuck = torch.iinfo(bins.run.dtype).max
    is_lost, is_valid = detector.sensed(bins.span, bins.run.masked_fill(is_masked, always_stuck))
    scaled = detector.scaled(bins.features, is_lost)
    return (detector.head(scaled) >= 0) & is_valid, is_valid


def _masks(hand: HandLayout) -> dict[tuple[str, str], Tensor]:
    """What is masked: nothing, each channel, and of several fingers or kinds each of these."""
    masks = {("nothing", ""): torch.zeros(len(hand), dtype=torch.bool)}
    several = [u for u in ("finger", "kind") if len({getattr(c, u) for c in hand.channels}) > 1]
    for unit in ("name", *several):
        of = [str(getattr(channel, unit)) for channel in hand.channels]
        for name in dict.fromkeys(of):
            key = ("channel" if unit == "name" else unit, name)
            masks[key] = torch.tensor([each == name for each in of])
    return masks


@style.styled
def _figure(content: Mapping[str, Any], path: Path) -> None:
    """A bar for what is masked: percent points of balanced accuracy that are lost."""
    whole, *rows = content["rows"]
    title = "Balanced accuracy lost without a sensor"
    figure = style.new_figure(8, 1.5 + 0.2 * len(rows), title, simulated=content["simulated"])
    roles = [role for role in _ROLES if whole[role] is not None] or [_ROLES[0]]
    panels = figure.subplots(1, len(roles), sharey=True, squeeze=False)[0]
    for axes, role in zip(panels, roles, strict=True):
        colour = style.BLUE if role == _ROLES[0] else style.VERMILION
        for lane, row in enumerate(rows):
            if whole[role] is None or row[role] is None:
                axes.text(0.0, lane, " -", va="center")
            else:
                axes.barh(lane, 100 * (whole[role] - row[role]), color=colour)
        axes.set_title(f"{role}: {style.percent(whole[role])} % with all")
        axes.set_xlabel("percent points lost")
    style.lanes(panels[0], [f"{row['unit']} {row['name']}" for row in rows])
    style.save(figure, path)


main = entry_point("importance", importance)
