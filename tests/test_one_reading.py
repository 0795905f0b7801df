"""One folder is the same to check, train, detect and stream: names, rate, unit, samples."""

import io
import tempfile
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hydra.utils import instantiate
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from test_commands import composed

from tactslip_torch.commands.data import check
from tactslip_torch.commands.detect import plain_section
from tactslip_torch.data.file_recordings import hand_file
from tactslip_torch.data.formats import Reading
from tactslip_torch.live.sources import FileInTime

NUM_FILES = 2
TIMES = {  # names of a column of times, its cell in a line of units, how many of it are a second
    "time": ("s", 1),
    "Time (ms)": ("ms", 10**3),
    "t_us": ("(us)", 10**6),
    "Timestamp": ("[ms]", 10**3),
}
EPOCH = 1_700_000_000
BESIDE = ("label", "Slip [0/1]", "frame", "is_slip", "episode_index")


@dataclass(frozen=True)
class Table:
    """How files are written."""

    names: tuple[str, ...]
    rate_hz: float
    num_rows: int
    delimiter: str
    has_commas: bool
    has_header: bool
    time: str | None
    has_units: bool
    is_since_1970: bool
    beside: str | None
    has_empty: bool
    seed: int

    @property
    def reading(self):
        """What a person says of them: a rate where there are no times."""
        return {} if self.time else {"sample_rate_hz": self.rate_hz}

    def values(self, file):
        """Numbers ``[C, T]``, some of them missing."""
        random = np.random.default_rng(self.seed + file)
        values = np.round(random.normal(2.0, 3.0, (len(self.names), self.num_rows)), 6)
        if self.has_empty:
            values[random.random(values.shape) < 0.05] = np.nan
            values[:, 0] = 1.25  # a first row that is there
        return values

    def write(self, path, file):
        unit, of_a_second = TIMES[self.time or "time"]
        columns = {}
        if self.time is not None:
            ticks = np.arange(self.num_rows) / self.rate_hz * of_a_second
            columns[self.time] = list(map(repr, ticks.tolist()))
            if self.is_since_1970:
                ticks = EPOCH * 10**9 + np.round(np.arange(self.num_rows) / self.rate_hz * 1e9)
                columns[self.time] = [str(int(tick)) for tick in ticks]
        missing = "nan" if self.delimiter == " " else ""
        for name, row in zip(self.names, self.values(file), strict=True):
            columns[name] = [missing if np.isnan(v) else repr(v) for v in row.tolist()]
        if self.beside is not None:
            columns[self.beside] = ["1"] * self.num_rows
        heads = [list(columns)] if self.has_header else []
        if self.has_units and not self.is_since_1970:
            units = {self.time: unit, **dict.fromkeys(self.names, "(V)")}
            heads.append([units.get(name, "-") for name in columns])
        rows = [self.delimiter.join(head) for head in heads]
        body = [self.delimiter.join(row) for row in zip(*columns.values(), strict=True)]
        if self.has_commas:
            body = [row.replace(".", ",") for row in body]
        path.write_text("\n".join([*rows, *body]) + "\n", encoding="utf-8")


@st.composite
def tables(draw):
    names = tuple(f"g{n}" for n in range(draw(st.integers(1, 6))))
    delimiter = draw(st.sampled_from(",;\t "))
    has_header = delimiter != " " and draw(st.booleans())
    rate_hz = draw(st.sampled_from([10.0, 25.0, 92.31, 100.0, 250.0, 1e3, 2e3, 1e4]))
    known = list(TIMES) if has_header else ["time"]
    time = draw(st.sampled_from([*known, None]))
    beside = draw(st.sampled_from([None, *BESIDE])) if has_header else None
    is_since_1970 = time in ("time", "Timestamp") and draw(st.booleans())
    num_columns = len(names) + (time is not None) + (beside is not None)
    return Table(
        names,
        rate_hz,
        draw(st.integers(40, 90)),
        delimiter,
        delimiter in "\t;" and num_columns > 1 and draw(st.booleans()),
        has_header,
        time,
        has_header and (time == "Timestamp" or draw(st.booleans())),
        is_since_1970,
        beside,
        num_columns > 1 and draw(st.booleans()),
        draw(st.integers(0, 999)),
    )


@pytest.fixture(scope="module")
def configs():
    """Of the commands, as they are without any word of a person."""
    whole = [f"{key}=x" for key in ("root", "action")]
    return {
        "check": composed(*whole, "num_workers=0", name="data"),
        "train": composed("data=files", "data.root=x"),
        "detect": composed("model=x", "input=x", name="detect"),
        "stream": composed("model=x", "source=x", name="stream"),
    }


@settings(max_examples=8)
@given(tables())
def test_check_train_detect_and_stream_agree(configs, made):
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        paths = [root / f"{file}.csv" for file in range(NUM_FILES)]
        for file, path in enumerate(paths):
            made.write(path, file)
        listed = "\n".join(f"{path.name},M,{file},slip" for file, path in enumerate(paths))
        (root / "manifest.csv").write_text(f"file,material,trial,label\n{listed}\n")
        agree(configs, made, root, paths)


def agree(configs, made, root, paths):
    said = {"data": {"reading": made.reading, "root": str(root)}}
    source = instantiate(OmegaConf.merge(configs["train"], said).data, _convert_="all")
    names = made.names if made.has_header else tuple(f"ch{n + 1}" for n in range(len(made.names)))
    assert source.hand.names == names
    assert source.sample_rate_hz == made.rate_hz
    with redirect_stdout(io.StringIO()) as out:
        num = check(OmegaConf.merge(configs["check"], {"root": str(root)}, said))
    printed = out.getvalue()
    broken = [np.isnan(made.values(file)).any(1).sum() for file in range(NUM_FILES)]
    assert num == sum(broken) == printed.count("is not finite in")  # as train refuses these
    seconds = NUM_FILES * made.num_rows / made.rate_hz
    number = f"{len(names)} channel{'s' * (len(names) > 1)}"
    assert f"channels: {', '.join(names)}\n" in printed
    assert f"{seconds:.1f} s, {number} at {made.rate_hz:g} Hz in {source.units}: " in printed
    assert (made.beside is None) == ("taken for no channels" not in printed)
    pool = SimpleNamespace(hand=source.hand, sample_rate_hz=source.sample_rate_hz)
    detector = SimpleNamespace(pool=pool, info={"units": source.units})
    for file, (path, recording) in enumerate(zip(paths, source.ids, strict=True)):
        wanted = made.values(file)
        np.testing.assert_array_equal(source.load(recording).samples, wanted)
        of_detect, of_stream = (
            Reading.of(plain_section(OmegaConf.merge(configs[name].reading, made.reading)))
            for name in ("detect", "stream")
        )
        with hand_file(path, source.hand, source.sample_rate_hz, of_detect, source.units) as opened:
            found = opened.samples.read(0, opened.samples.num_samples)
        np.testing.assert_array_equal(found, wanted)
        blocks = list(FileInTime(path, detector, of_stream, speed=None))[1:]
        np.testing.assert_array_equal(np.concatenate([b.samples for b in blocks]).T, wanted)
