"""What is asked of every format of recordings, whichever library is behind it."""

import importlib.util
import random
import re
from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from tactslip_torch import HandLayout, Recording
from tactslip_torch.data.formats.reading import AS_IT_SAYS, pieces

KEY = {"scene": {"seed": 3}, "code": "abc"}
FACTS = (
    "sample_rate_hz",
    "material",
    "speeds_mm_s",
    "onsets_s",
    "annotated_onsets_s",
    "sliding_s",
    "non_slip_s",
    "slip_s",
    "units",
    "provenance",
)
words = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=8)
times = st.floats(0, 100, allow_nan=False)
stretches = st.tuples(times, times).map(lambda pair: (min(pair), max(pair)))
plain = st.dictionaries(
    words, st.none() | st.booleans() | st.integers() | st.lists(times, max_size=2), max_size=3
)


def hand_of(names):
    return HandLayout.from_rows(
        {"name": name, "kind": ("SG", "PVDF")[i % 2], "finger": f"f{i}", "segment": "distal"}
        for i, name in enumerate(names)
    )


def recording(num_channels=2, num_samples=400, dtype=torch.float32, **changes):
    generator = torch.Generator().manual_seed(5)
    samples = torch.randn(num_channels, num_samples, generator=generator, dtype=dtype)
    values = {
        "samples": samples,
        "sample_rate_hz": 2000.0,
        "material": "M1",
        "speeds_mm_s": (20.0, 40.0),
        "onsets_s": (0.05, 0.1 + 1e-9),
        "sliding_s": ((0.05, 0.1), (0.1, 0.2)),
        "annotated_onsets_s": (0.06, 1 / 3),
        "non_slip_s": ((0.01, 0.02),),
        "provenance": {"simulated": True, "seed": 3},
    }
    return Recording(**(values | changes))


@st.composite
def kept(draw):
    """A recording of any bits, its hand and its key."""
    names = draw(st.lists(words, min_size=1, max_size=4, unique=True))
    dtype = draw(st.sampled_from([np.float32, np.float64]))
    num_samples = draw(st.integers(0, 9))
    size = len(names) * num_samples * np.dtype(dtype).itemsize
    raw = draw(st.binary(min_size=size, max_size=size))  # every NaN and subnormal as well
    samples = np.frombuffer(raw, dtype).reshape(len(names), num_samples).copy()
    strokes = draw(st.integers(0, 3))

    def some(what):
        return tuple(draw(st.lists(what, min_size=strokes, max_size=strokes)))

    wanted = Recording(
        torch.from_numpy(samples),
        draw(st.floats(0.1, 1e6)),
        draw(words),
        some(times),
        some(times),
        some(stretches),
        some(times),
        tuple(draw(st.lists(stretches, max_size=3))),
        draw(plain),
        slip_s=tuple(draw(st.lists(stretches, max_size=3))),
        units=draw(words),
    )
    return wanted, hand_of(names), draw(plain)


def assert_same(found, wanted, hand, key=KEY):
    """Everything that a file of ours gives back, samples to the bit."""
    assert found.recording.samples.dtype == wanted.samples.dtype
    assert found.recording.samples.shape == wanted.samples.shape
    assert found.recording.samples.numpy().tobytes() == wanted.samples.numpy().tobytes()
    for name in FACTS:
        assert getattr(found.recording, name) == getattr(wanted, name), name
    assert (found.hand, found.key) == (hand, key)


def assert_comes_back(form, path, wanted, hand, key):
    """Saved and loaded; opened and read in pieces."""
    form.save(path, wanted, hand, key)
    assert_same(form.load(path), wanted, hand, key)
    assert form.key(path) == key
    with form.open(path) as opened:
        parts = list(pieces(opened.samples, 4))
        samples = torch.cat(parts, 1) if parts else opened.samples.read(0, 9)
        assert (opened.names, opened.sample_rate_hz) == (hand.names, wanted.sample_rate_hz)
        assert opened.archived.recording.samples.shape == (len(hand), 0)
        for name in FACTS:
            assert getattr(opened.archived.recording, name) == getattr(wanted, name), name
    assert samples.numpy().tobytes() == wanted.samples.numpy().tobytes()


def assert_equal_bytes(form, folder, ending, monkeypatch):
    """Of equal recordings, whenever they are written and wherever."""
    wanted, hand = recording(), hand_of("ab")
    form.save(folder / f"a.{ending}", wanted, hand, KEY)
    monkeypatch.setattr("time.time", lambda: 2e9)
    monkeypatch.setattr("time.asctime", lambda *_: "another day")
    form.save(folder / f"other.{ending}", wanted, hand, dict(reversed(KEY.items())))
    assert (folder / f"a.{ending}").read_bytes() == (folder / f"other.{ending}").read_bytes()


def read(form, path, how=AS_IT_SAYS):
    """All that a file of somebody gives: samples, names, times, rate."""
    with form.open(path, how) as opened:
        assert opened.archived is None
        samples = opened.samples
        whole = samples.read(0, samples.num_samples)
        assert whole.dtype == samples.dtype
        assert whole.shape == (samples.num_channels, samples.num_samples)
        parts = torch.cat(list(pieces(samples, 7)), 1)
        assert parts.numpy().tobytes() == whole.numpy().tobytes()
        assert samples.read(samples.num_samples, samples.num_samples + 5).shape[1] == 0
        since = opened.times and opened.times.read(0, samples.num_samples)
        return whole, opened.names, since, opened.sample_rate_hz


def refused(form, path, how=AS_IT_SAYS):
    """The one line that a file gets when it is opened."""
    with pytest.raises(ValueError, match=re.escape(str(path))) as caught:
        read(form, path, how)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(path))
    return str(caught.value).removeprefix(str(path)).strip()


def hide(monkeypatch, library):
    """As if the library were not installed."""
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        "tactslip_torch.data.formats.reading.find_spec",
        lambda name: None if name == library else find_spec(name),
    )


def assert_hint(library, extra, *calls):
    """Each call says in one line what to install."""
    for call in calls:
        with pytest.raises(ValueError, match=f"needs {library}, which is not installed") as caught:
            call()
        assert f'pip install "tactslip_torch[{extra}]"' in str(caught.value)
        assert "\n" not in str(caught.value)


def damage(content, drawn):
    """A file with bytes changed, doubled, cut off: often where the structure is, at both ends."""
    source, content = random.Random(drawn), bytearray(content)
    kind = source.choice(["bit", "byte", "zeros", "large", "twice", "cut"])
    for _ in range(source.choice([1, 1, 3, 10])):
        last = max(len(content) - 1, 0)
        near_end = max(last - source.randrange(1500), 0)
        at = source.choice([source.randint(0, last), min(source.randrange(3000), last), near_end])
        if kind == "cut":
            del content[max(at, 1) :]
        elif kind == "twice":
            content[at:at] = content[at : at + source.randrange(64)]
        else:
            new = {"zeros": bytes(8), "large": b"\xff\xff\xff\x7f"}.get(kind)
            old = content[at] if content else 0
            flipped = old ^ 1 << source.randrange(8) if kind == "bit" else source.randrange(256)
            content[at : at + len(new or b"1")] = new or bytes([flipped])
    return bytes(content)


def read_all(form, path):
    """Read a file of whomever, in pieces."""
    with form.open(path) as opened:
        for _ in pieces(opened.samples, 97):
            pass
        if opened.times is not None:
            opened.times.read(0, opened.samples.num_samples)


def line_of(way, path):
    """What a refusal says, None if there is none."""
    try:
        way(path)
    except ValueError as error:
        return str(error)


def survived(form, path, contents, num):
    """How damaged files ended, counted: read or refused in one line; anything else fails."""
    ends = Counter()
    for drawn in range(num):
        path.write_bytes(damage(contents[drawn % len(contents)], drawn))
        for way in (form.load, form.key, lambda path: read_all(form, path)):
            said = line_of(way, path)
            assert said is None or (str(path) in said and "\n" not in said), drawn
            ends["read" if said is None else "refused"] += 1
    return ends
