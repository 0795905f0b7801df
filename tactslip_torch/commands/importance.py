"""Which sensors matter: balanced accuracy without each channel, finger and kind of channel.

The detector stays as it is; what is masked counts as missing. It is evaluated on bins of its test
and held-out recordings, as many of each recording and class; a decision that is not valid is wrong.
Where a mask leaves no decision valid, nothing is said of it.
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
from tactslip_torch.data.recording import RecordingId, RecordingSource
from tactslip_torch.data.splits import Split
from tactslip_torch.hand import HandLayout
from tactslip_torch.model.detector import SlipDetector
from tactslip_torch.report import style
from tactslip_torch.report.metrics import confusion_matrix, split_metrics
from tactslip_torch.runtime import check_number, in_processes, write_json
from tactslip_torch.training.experiment import features_of

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
    check_number("bins", config.bins, whole=True)
    model = Path(config.model)
    detector = SlipDetector.load(model)
    places = [place / "config.yaml" for place in (model.parent, model.parent.parent)]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise FileNotFoundError(f"no config.yaml beside {model}; give model=RUN/detector.pt")
    training: Any = OmegaConf.load(found)
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
    maker = features_of(detector, source, instantiate(training.labels), None)
    masks = _masks(source.hand)

    def evaluated(recording: RecordingId) -> Tensor:
        """Confusions by role, mask and whether decisions were valid, ``[R, M, 2, 2, 2]``."""
        bins, laid = maker.filtered_bins(recording)
        counts = torch.zeros(len(_ROLES), len(masks), 2, 2, 2, dtype=torch.long)
        roles = fold.bin_roles(recording, len(bins))
        for place, role in enumerate(_ROLES):
            of_class = [(roles[role] & (laid.is_slip == value)).nonzero()[:, 0] for value in (0, 1)]
            some = torch.cat([index[:: max(1, len(index) // config.bins)] for index in of_class])
            for number, channels in enumerate(masks.values() if len(some) else ()):
                decided = detector.predict(bins[some], masked_channels=channels or None)
                is_slip = laid.is_slip[some]
                says_slip = torch.where(decided.is_valid, decided.score >= 0, ~is_slip)
                for valid, mine in enumerate((~decided.is_valid, decided.is_valid)):
                    table = confusion_matrix(is_slip[mine], says_slip[mine])
                    counts[place, number, valid] = torch.tensor(table)
        return counts

    save_config(config, folder)
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


def _masks(hand: HandLayout) -> dict[tuple[str, str], tuple[str, ...]]:
    """What is masked: nothing, each channel, and of several fingers or kinds each of these."""
    masks: dict[tuple[str, str], tuple[str, ...]] = {("nothing", ""): ()}
    several = [u for u in ("finger", "kind") if len({getattr(c, u) for c in hand.channels}) > 1]
    for unit in ("name", *several):
        for channel in hand.channels:
            key = ("channel" if unit == "name" else unit, str(getattr(channel, unit)))
            masks[key] = (*masks.get(key, ()), channel.name)
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
