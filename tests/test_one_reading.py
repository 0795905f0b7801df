"""One folder is the same to check, train, detect and stream: names, rate, unit, samples."""

from types import SimpleNamespace

import numpy as np
import pytest
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import OmegaConf
from test_commands import composed

from tactslip_torch.commands.data import check
from tactslip_torch.commands.detect import reading_of
from tactslip_torch.data.file_recordings import hand_file
from tactslip_torch.live.sources import FileInTime

NUM_ROWS = 50
EPOCH_NS = 1_700_000_000 * 10**9
RATE = {"sample_rate_hz": 250.0}
TABLES = {
    # lines above the rows, a row, rate, names, what a person says of it
    "names": ("time,a,b\n", "{s!r},{a},{b}", 2000.0, "ab", {}),
    "decimal commas": ("Time (ms);a;b\n", "{ms!r};{a};{b}", 92.31, "ab", {}),
    "a line of units": ("t_us\ta\tb\n(us)\t(V)\t(V)\n", "{us!r}\t{a}\t{b}", 1e4, "ab", {}),
    "since 1970": ("Timestamp,a,b,label\n", "{ns},{a},{b},1", 100.0, "ab", {}),
    "a column beside": ("time,a,b,Slip [0/1]\n", "{s!r},{a},{b},1", 25.0, "ab", {}),
    "no times": ("a;b;frame\n", "{a};{b};1", 250.0, "ab", RATE),
    "no names": ("", "{a} {b}", 250.0, ["ch1", "ch2"], RATE),
}


def values_of(case, file):
    """Numbers ``[C, T]``, one of them missing where cells may be empty."""
    values = np.random.default_rng([file, len(case)]).normal(2.0, 3.0, (2, NUM_ROWS)).round(6)
    if TABLES[case][0]:
        values[file, 20] = np.nan
    return values


def write(path, case, file):
    head, row, rate_hz, *_ = TABLES[case]
    cells = [["" if np.isnan(x) else repr(x) for x in of] for of in values_of(case, file).tolist()]
    lines = []
    for i, (a, b) in enumerate(zip(*cells, strict=True)):
        s = i / rate_hz
        times = {"s": s, "ms": s * 1e3, "us": s * 1e6, "ns": EPOCH_NS + round(s * 1e9)}
        lines.append(row.format(a=a, b=b, **times))
    body = "\n".join(lines) + "\n"
    path.write_text(head + (body.replace(".", ",") if ";" in row else body), encoding="utf-8")
    return path


@pytest.mark.parametrize("case", TABLES)
def test_check_train_detect_and_stream_agree(case, tmp_path, capsys):
    *_, rate_hz, names, reading = TABLES[case]
    paths = [write(tmp_path / f"{file}.csv", case, file) for file in (0, 1)]
    (tmp_path / "manifest.csv").write_text(
        "file,material,trial,label\n0.csv,M,0,slip\n1.csv,M,1,slip\n"
    )
    said = {"data": {"reading": reading | {"gaps": "missing"}, "root": str(tmp_path)}}
    train = composed("data=files", f"data.root={tmp_path}")
    source = instantiate(OmegaConf.merge(train, said).data, _convert_="all")
    assert (source.hand.names, source.sample_rate_hz) == (tuple(names), rate_hz)
    of_check = composed(f"root={tmp_path}", "action=check", "num_workers=0", name="data")
    assert check(OmegaConf.merge(of_check, said)) == 0
    printed = capsys.readouterr().out
    refusing = {"data": {"reading": reading | {"gaps": "refuse"}, "root": str(tmp_path)}}
    num_missing = sum(int(np.isnan(values_of(case, file)).sum()) for file in (0, 1))
    assert check(OmegaConf.merge(of_check, refusing)) == num_missing
    if num_missing:  # train refuses what check shows
        with pytest.raises(InstantiationException, match=r"set data\.reading\.gaps=missing"):
            instantiate(OmegaConf.merge(train, refusing).data, _convert_="all")
    assert f"channels: {', '.join(names)}\n" in printed
    assert f"2 channels at {rate_hz:g} Hz in {source.units}: " in printed
    pool = SimpleNamespace(hand=source.hand, sample_rate_hz=source.sample_rate_hz)
    detector = SimpleNamespace(pool=pool, info={"units": source.units, "reading": reading})
    of_detect, of_stream = (
        reading_of(composed("model=x", f"{key}=x", name=name), detector)
        for name, key in (("detect", "input"), ("stream", "source"))
    )
    for file, (path, recording) in enumerate(zip(paths, source.ids, strict=True)):
        wanted = values_of(case, file)
        np.testing.assert_array_equal(source.load(recording).samples, wanted)
        with hand_file(path, source.hand, source.sample_rate_hz, of_detect, source.units) as opened:
            np.testing.assert_array_equal(opened.samples.read(0, NUM_ROWS), wanted)
        blocks = list(FileInTime(path, detector, of_stream, speed=None))[1:]
        np.testing.assert_array_equal(np.concatenate([b.samples for b in blocks]).T, wanted)
