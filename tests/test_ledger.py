import hashlib

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tactslip_torch.ledger import Ledger, content_digest

NAMES = ["a", "b", "c", "d"]
entries = st.dictionaries(st.sampled_from(NAMES), st.sampled_from(["1", "2"]))


def test_what_is_added_is_there_until_it_is_removed():
    ledger = Ledger()
    assert len(ledger) == 0
    ledger.add("a", "1")
    ledger.add("b", "1")
    assert ledger.entries == {"a": "1", "b": "1"}
    assert len(ledger) == 2
    ledger.remove("a", "1")
    assert ledger.entries == {"b": "1"}
    ledger.add("a", "2")
    assert ledger.entries == {"b": "1", "a": "2"}


def test_a_ledger_is_apart_from_what_it_was_made_of():
    source = {"a": "1"}
    ledger = Ledger(source)
    ledger.add("b", "1")
    assert source == {"a": "1"}


@given(ours=entries, theirs=entries)
def test_merge_takes_all_or_nothing(ours, theirs):
    a, b = Ledger(ours), Ledger(theirs)
    both = sorted(ours.keys() & theirs.keys())
    if both:
        with pytest.raises(ValueError, match=rf"^{len(both)} .*such as {both[0]!r}; merge each"):
            a.merge(b)
        assert a.entries == ours
    else:
        a.merge(b)
        assert a.entries == ours | theirs
    assert b.entries == theirs


def test_errors_name_the_batch_and_change_nothing():
    ledger = Ledger({"a": "1"})
    with pytest.raises(ValueError, match=r"'a' is in these statistics already; add it once"):
        ledger.add("a", "1")
    with pytest.raises(ValueError, match=r"'b' was never added"):
        ledger.remove("b", "1")
    with pytest.raises(ValueError, match=r"'a' was added with other content"):
        ledger.remove("a", "2")
    assert ledger.entries == {"a": "1"}


# -------------------------------------------------------------------------------- digests
def test_a_digest_is_of_dtype_shape_and_bytes():
    expected = hashlib.blake2b(digest_size=16)
    expected.update(b"torch.float32(2, 3)" + np.arange(6, dtype="<f4").tobytes())
    expected.update(b"torch.bool(1,)\x01")
    digest = content_digest(torch.arange(6.0).reshape(2, 3), torch.tensor([True]))
    assert digest == expected.hexdigest()


def test_a_digest_sees_every_bit_the_shape_and_the_dtype():
    tensors = [
        torch.zeros(6),
        torch.zeros(6, dtype=torch.int32),
        torch.zeros(2, 3),
        torch.zeros(3, 2),
        torch.zeros(7),
        torch.zeros(0),
        torch.zeros(0, 3),
        torch.zeros(()),
        torch.tensor([0, 0, 0, 0, 0, -0.0]),
        torch.tensor([0, 0, 0, 0, 0, 1e-45]),
    ]
    digests = [content_digest(tensor) for tensor in tensors]
    digests += [content_digest(tensors[0], tensors[2]), content_digest(tensors[2], tensors[0])]
    assert len(set(digests)) == len(digests)


@pytest.mark.parametrize(
    "dtype", [torch.float32, torch.float64, torch.bfloat16, torch.bool, torch.int64, torch.uint8]
)
def test_a_digest_does_not_see_layout_gradients_or_device(dtype, device):
    tensor = torch.arange(12).reshape(3, 4).to(dtype)
    digest = content_digest(tensor)
    assert content_digest(tensor.T.contiguous().T) == digest
    assert content_digest(torch.stack([tensor, tensor], dim=-1)[..., 0]) == digest
    assert content_digest(tensor.to(device)) == digest
    assert content_digest(tensor[:1, :1]) == content_digest(tensor[:1, :1].clone())
    odd = torch.zeros(1).as_strided((1,), (3,))  # a lone value may have any stride
    assert content_digest(odd) == content_digest(torch.zeros(1))
    if dtype.is_floating_point:
        assert content_digest(tensor.requires_grad_()) == digest


def test_an_empty_array_has_a_digest():
    empty = torch.from_numpy(np.zeros((0, 3)))
    assert content_digest(empty) == content_digest(torch.zeros(0, 3, dtype=torch.float64))
    assert content_digest(empty) != content_digest(torch.zeros(3, 0, dtype=torch.float64))
