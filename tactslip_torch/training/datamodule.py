"""From recordings to features of labelled bins: made once by workers, kept, handed to Lightning."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, NamedTuple

import lightning as L
import torch
from torch import Tensor
from torch.utils.data import DataLoader

from tactslip_torch.data.labels import (
    LabelledBins,
    LabelRule,
    bins_of,
    needed_windows,
    shuffled,
    whole_samples,
)
from tactslip_torch.data.recording import Recording, RecordingId, RecordingSource, Timeline
from tactslip_torch.data.splits import ROLES, Split
from tactslip_torch.features.cache import FeatureCache, KeptFeatures, cache_key, features_digest
from tactslip_torch.features.pool import FeaturePool
from tactslip_torch.features.sensing import longest_run_of, run_lengths
from tactslip_torch.native import BackendName
from tactslip_torch.runtime import bar, check_number, num_processes, one_thread
from tactslip_torch.signals.filtering import ChannelFilter, bins_at, largest_in_frames
from tactslip_torch.training.bins import RecordingBins


class RecordingFeatures(NamedTuple):
    """Features and labels of the bins of one recording.

    Attributes:
        times: what is true of the recording; its slides are in the order of the strokes' numbers.
        hop_s: distance of neighbouring bins.

    Shape:
        - features: ``[N, F]``, float32
        - is_slip: ``[N]``, bool
        - speed_mm_s: ``[N]``, steady speed of the stroke of each bin, 0 for bins of no stroke
        - position, stroke: ``[N]``, place beside the onset and number of the stroke, as
          ``LabelledBins`` has them
        - ends_s: ``[N]``, float64, when the last sample of each bin is in
        - span, run: ``[N, C]``, as ``KeptFeatures`` has them
        - roles: role to ``[N]``, bool; of no split empty
        - longest_run: most equal samples in a row of a channel that moves
    """

    recording: RecordingId
    features: Tensor
    is_slip: Tensor
    speed_mm_s: Tensor
    position: Tensor
    stroke: Tensor
    ends_s: Tensor
    span: Tensor
    run: Tensor
    times: Timeline
    hop_s: float
    roles: dict[str, Tensor] = {}  # noqa: RUF012  # a NamedTuple replaces, it does not change
    longest_run: int = 0

    def in_split(self, split: Split) -> RecordingFeatures:
        """With the roles that its bins have in a split."""
        return self._replace(roles=split.bin_roles(self.recording, len(self.is_slip)))

    def of(self, mask: Tensor) -> RecordingFeatures:
        """Some of its bins, by a mask ``[N]``; itself where they are all."""
        if bool(mask.all()):
            return self
        names = (*self._fields[1 : self._fields.index("times")],)
        kept = {name: getattr(self, name)[mask] for name in names}
        roles = {role: own[mask] for role, own in self.roles.items()}
        return self._replace(**kept, roles=roles)


class FeatureMaker:
    """Features of a recording of a source: kept in memory, from the cache, or computed.

    Args:
        source: the recordings.
        pool: the features, whole or a selection; its bin length and rate must fit source and rule.
        channel_filter: the filter of each channel.
        rule: where the bins lie and what they are.
        cache: where features are kept, if they are.
        dtype: in which features are computed; they are handed on in float32.
        backend: what computes them.
        memory_gib: of features that are kept in memory at most.

    Raises:
        ValueError: if rate, channels or bin length of the parts disagree, bins or hops are no whole
            number of samples, or the backend is none that can be used.
    """

    def __init__(
        self,
        source: RecordingSource,
        pool: FeaturePool,
        channel_filter: ChannelFilter,
        rule: LabelRule,
        cache: FeatureCache | None = None,
        dtype: torch.dtype = torch.float64,
        backend: BackendName = "auto",
        memory_gib: float = 2.0,
    ) -> None:
        check_number("features.memory_gib", memory_gib, least=0)
        if pool.hand != source.hand:
            raise ValueError(
                f"the features expect {len(pool.hand)} channels {pool.hand.names[0]}.."
                f"{pool.hand.names[-1]}, the recordings have {len(source.hand)} "
                f"{source.hand.names[0]}..{source.hand.names[-1]}; use the hand of the recordings"
            )
        if pool.sample_rate_hz != source.sample_rate_hz:
            raise ValueError(
                f"the features expect {pool.sample_rate_hz:g} Hz, the recordings have "
                f"{source.sample_rate_hz:g} Hz; make the features for that rate, or resample"
            )
        bin_samples = whole_samples(rule.bin_ms, source.sample_rate_hz, "labels.bin_ms")
        if rule.hop_ms is not None:
            whole_samples(rule.hop_ms, source.sample_rate_hz, "labels.hop_ms")
        if rule.label_column != getattr(source, "label_column", None):
            raise ValueError(
                f"labels.column={rule.column} must be that with which the recordings are read: "
                "data=files or data=named; in Python FileRecordings(..., label_rule=rule)"
            )
        if pool.bin_samples != bin_samples:
            raise ValueError(
                f"the features expect bins of {pool.bin_samples} samples, labels.bin_ms="
                f"{rule.bin_ms:g} makes bins of {bin_samples}"
            )
        self.source = source
        self.pool = pool
        self.extractor = pool.select(range(len(pool.names)), backend)
        self.channel_filter = channel_filter
        self.rule = rule
        self.cache = cache
        self.dtype = dtype
        self.memory_gib = memory_gib
        self._kept: dict[RecordingId, RecordingFeatures] = {}
        self._kept_bytes = 0
        self._code = features_digest(simulated=source.is_simulated)
        self._libraries = [version(name) for name in ("torch", "ptwt", "PyWavelets")]
        if source.is_simulated:  # its random numbers may change between feature releases
            self._libraries.append(".".join(version("numpy").split(".")[:2]))

    def keep(self, made: RecordingFeatures) -> bool:
        """Hold the features of a recording in memory, up to the cap."""
        size = made.features.numel() * made.features.element_size()
        if has_room := self._kept_bytes + size <= self.memory_gib * 2**30:
            # a copy: tensors of a worker lie in shared memory, and each keeps a file open
            self._kept[made.recording] = copy.deepcopy(made)
            self._kept_bytes += size
        return has_room

    def __call__(self, recording: RecordingId, times: Timeline | None = None) -> RecordingFeatures:
        """Features and labels of one recording.

        Args:
            recording: which.
            times: what is true of it, where that is more than the source says.

        Raises:
            ValueError: if bins leave the recording or a sample they need is not finite.
        """
        if (kept := self._kept.get(recording)) is not None:
            return kept
        times = self.source.timeline(recording) if times is None else times
        bins = self.lay_bins(times)
        made = self._features(recording, times, bins)
        is_slip = bins.is_slip
        if self.rule.shuffle_seed is not None:
            place = self.source.ids.index(recording)
            is_slip = shuffled(is_slip, self.rule.shuffle_seed, place)
        speeds = torch.tensor([*times.speeds_mm_s, 0.0])[bins.stroke]  # -1, of no stroke: the 0
        return RecordingFeatures(
            recording,
            made.features,
            is_slip,
            speeds,
            bins.position,
            bins.stroke,
            (bins.starts + bins.bin_samples).double() / self.source.sample_rate_hz,
            made.span,
            made.run,
            times,
            (self.rule.bin_ms if self.rule.hop_ms is None else self.rule.hop_ms) / 1000,
            longest_run=made.longest_run,
        )

    def filtered_bins(self, recording: RecordingId) -> tuple[Tensor, LabelledBins]:
        """The filtered bins ``[N, C, n]`` that features are taken from, and their labels."""
        times = self.source.timeline(recording)
        bins = self.lay_bins(times)
        return self._filter(recording, self._load(recording, times, bins), bins), bins

    def lay_bins(self, times: Timeline) -> LabelledBins:
        """Where the bins of a recording lie, and what they are; no sample is needed for that.

        Bins that would need missing samples are left out.
        """
        before, after = (max(reach) for reach in zip(*self.channel_filter.reaches, strict=True))
        return bins_of(self.rule, times, self.source.sample_rate_hz, before, after)

    def _features(
        self,
        recording: RecordingId,
        times: Timeline,
        bins: LabelledBins,
    ) -> KeptFeatures:
        key = self._key(recording, bins)
        cached = None if self.cache is None else self.cache.load(key, self.pool.selected)
        if cached is not None and {len(each) for each in cached[:3]} == {len(bins.starts)}:
            return cached
        loaded = self._load(recording, times, bins)
        with torch.no_grad():
            cut = self._filter(recording, loaded, bins)
            features: Tensor = self.extractor(cut).float()
        made = KeptFeatures(features, *self._sensed(loaded.samples, cut, bins))
        if self.cache is not None:
            self.cache.store(key, self.pool.selected, made)
        return made

    def _sensed(
        self, samples: Tensor, cut: Tensor, bins: LabelledBins
    ) -> tuple[Tensor, Tensor, int]:
        """What ``KeptFeatures`` says of samples ``[C, T]`` and filtered bins ``[N, C, n]``."""
        runs = run_lengths(samples)
        frames = bins.starts, bins.bin_samples, self.channel_filter.reaches
        loudest = largest_in_frames(samples.abs(), *frames).double()
        span = (cut.amax(-1) - cut.amin(-1)).double()
        is_more = span * self.pool.inverse_span(samples.dtype, is_raw=True) > loudest
        return span.where(is_more, 0.0), largest_in_frames(runs, *frames), longest_run_of(runs)

    def _load(self, recording: RecordingId, times: Timeline, bins: LabelledBins) -> Recording:
        context = self.channel_filter.context_before  # never fewer than behind
        windows = needed_windows(bins, context, times.duration_s, self.source.sample_rate_hz)
        return self.source.load(recording, windows)

    def _filter(self, recording: RecordingId, loaded: Recording, bins: LabelledBins) -> Tensor:
        filtered = self.channel_filter(loaded.samples.to(self.dtype))
        cut = bins_at(filtered, bins.starts, bins.bin_samples)  # [N, C, n]
        bad = (~cut.isfinite()).nonzero()
        if len(bad):
            index, channel, _ = bad[0].tolist()
            raise ValueError(self._broken(recording, loaded, int(bins.starts[index]), channel))
        return cut

    def _broken(self, recording: RecordingId, loaded: Recording, start: int, channel: int) -> str:
        """What to say of a channel whose filtered bin from sample ``start`` on is not finite."""
        before, after = self.channel_filter.reaches[channel]
        begin = max(start - before, 0)
        near = loaded.samples[channel, begin : start + self.pool.bin_samples + after]
        place = int((~near.isfinite()).nonzero()[0])
        return (
            f"{recording}: channel {self.pool.hand.names[channel]}, sample {begin + place} "
            f"({(begin + place) / self.source.sample_rate_hz:.4f} s) is {float(near[place])}; "
            "repair or leave out the recording"
        )

    def _key(self, recording: RecordingId, bins: LabelledBins) -> str:
        pool = self.pool
        content: dict[str, Any] = {
            "recording": dict(self.source.key(recording)),
            "starts": bins.starts.tolist(),
            "bin_samples": bins.bin_samples,
            "wavelet": [pool.config()["wavelet"], pool.level],
            "spectrum": [pool.spectrum, pool.arithmetic],
            "filter": list(self.channel_filter.config().values()),
            "dtype": str(self.dtype),
            "backend": self.extractor.backend,
            "code": self._code,
            "libraries": self._libraries,
        }
        return cache_key(content)


@dataclass(frozen=True)
class TrainingBins:
    """Training bins of recordings, read one recording at a time and as often as asked for."""

    maker: FeatureMaker
    fold: Split
    recordings: Sequence[RecordingId]

    def __iter__(self) -> Iterator[RecordingBins]:
        group = _grouping(self.fold.having("train"))
        for recording in self.recordings:
            made = self.maker(recording).in_split(self.fold)
            some = made.of(made.roles["train"])
            yield RecordingBins(
                str(recording),
                group(recording),
                some.features,
                some.is_slip,
                recording.scene,
                made.longest_run,
            )


def _grouping(recordings: Sequence[RecordingId]) -> Callable[[RecordingId], str]:
    """What validation leaves out: materials; of one its sessions, of one session recordings."""
    if len({recording.material for recording in recordings}) > 1:
        return lambda recording: recording.material
    if len({recording.session for recording in recordings}) > 1:
        return lambda recording: f"session {recording.session or 1}"
    return str


class SlipDataModule(L.LightningDataModule):
    """The recordings of one or more folds.

    ``setup`` makes the features of each recording once for all folds. The only batch of training is
    all training bins, as a fit needs them together; a batch of a test is one recording. Of several
    processes each gets every so-many-th recording: none is padded with recordings of another, as
    Lightning's own sampler would.

    Args:
        maker: makes features of a recording.
        folds: of recordings.
        num_workers: processes that make features; 0 makes them in this one, ``None`` takes as
            many as there are processors, at most 8, shared by the processes of a machine.

    Attributes:
        fold: the one that loaders are of; the first one to begin with.
        seconds: time that making features took.

    Raises:
        ValueError: if there is no such number of processes.
    """

    def __init__(
        self, maker: FeatureMaker, folds: Sequence[Split], num_workers: int | None = None
    ) -> None:
        super().__init__()
        self.maker, self.folds, self.fold = maker, folds, folds[0]
        self.num_workers = num_processes(num_workers)
        self.seconds = 0.0
        self._shares_processors = num_workers is None
        self._made: set[RecordingId] = set()

    def setup(self, stage: str = "test") -> None:
        """Make the features of this process's recordings, each once, for a fit those that train."""
        started, workers = time.perf_counter(), self.num_workers
        if self._shares_processors and self.trainer is not None:
            workers = max(1, workers // self.trainer.num_devices)
        wanted = self._having(*(["train"] if stage == "fit" else ROLES))
        recordings = [recording for recording in wanted if recording not in self._made]
        loader = self._loader(recordings, self.maker, workers)
        with one_thread():  # the processors belong to the workers
            for made in bar(loader, "features", "recording", show=bool(recordings)):
                self.maker.keep(made)
        self._made.update(recordings)
        self.seconds += time.perf_counter() - started

    def train_dataloader(self) -> DataLoader[TrainingBins]:
        """One batch: the training bins of this process's recordings."""
        return self._loader([self.training_bins()])

    def test_dataloader(self) -> DataLoader[RecordingFeatures]:
        """This process's recordings with a role, one a batch."""
        return self._loader(self._having(*ROLES), self._in_fold)

    def training_bins(self) -> TrainingBins:
        """Of this process's recordings."""
        return TrainingBins(self.maker, self.fold, self._having("train"))

    def features(self, *roles: str) -> Iterator[RecordingFeatures]:
        """This process's recordings of the fold with any of the roles, one at a time."""
        return map(self._in_fold, self._having(*roles))

    def transfer_batch_to_device(self, batch: Any, device: Any, dataloader_idx: int) -> Any:
        """Features stay where they are: moments and solve run in float64 on the processor."""
        return batch

    def _having(self, *roles: str) -> list[RecordingId]:
        wanted = set(self.fold.having(*roles))
        return [recording for recording in self._of_process() if recording in wanted]

    def _of_process(self) -> list[RecordingId]:
        """Every so-many-th recording with a role in any fold."""
        every = sorted({recording for fold in self.folds for recording in fold.having(*ROLES)})
        trainer = self.trainer
        part, parts = (0, 1) if trainer is None else (trainer.global_rank, trainer.world_size)
        if parts > len(every):
            raise ValueError(f"{parts} processes for {len(every)} recordings; use fewer")
        return every[part::parts]

    def _in_fold(self, recording: RecordingId) -> RecordingFeatures:
        return self.maker(recording).in_split(self.fold)

    def _loader(
        self, items: list[Any], collate: Callable[[Any], Any] = lambda item: item, workers: int = 0
    ) -> DataLoader[Any]:
        """A loader that makes something of one item at a time."""
        return DataLoader(
            items,  # type: ignore[arg-type]  # a list is a dataset
            batch_size=None,
            num_workers=workers,
            collate_fn=collate,
        )


def training_origin(source: RecordingSource, fold: Split) -> dict[str, Any]:
    """What a detector's ``info`` says of what it is trained on; units only where not volts."""
    trained, units = fold.having("train"), getattr(source, "units", "V")
    return {
        "simulated": source.is_simulated,
        **({} if units == "V" else {"units": units}),
        "split": fold.name,
        "train_materials": sorted({recording.material for recording in trained}),
        "train_sessions": sorted({recording.session or "1" for recording in trained}),
        "train_recordings": {str(r): cache_key(source.key(r)) for r in trained},
    }
