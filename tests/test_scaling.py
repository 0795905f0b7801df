import math

import numpy as np
import oracles
import pytest
import torch
from sklearn.preprocessing import MinMaxScaler as Reference

from tactslip_torch.model.scaling import MinMaxScaler


@pytest.mark.parametrize("num_bins", [2, 3, 50])
def test_equals_sklearn(num_bins, rng):
    train = rng.standard_normal((num_bins, 6)) * 10.0 ** rng.integers(-6, 7, 6) + 3
    new = train.mean(0) + 2 * rng.standard_normal((80, 6)) * train.std(0)
    reference = Reference(feature_range=(-1, 1), clip=True).fit(train)
    scaler = MinMaxScaler.fit(torch.from_numpy(train))
    for features in (train, new):
        actual = scaler(torch.from_numpy(features))
        np.testing.assert_allclose(actual, reference.transform(features), rtol=1e-9, atol=1e-9)
    assert (scaler(torch.from_numpy(new)).abs() == 1).any(), "nothing was clipped"


def test_fit_and_the_constructor_are_the_same(rng):
    train = torch.from_numpy(rng.standard_normal((20, 4)))
    fitted = MinMaxScaler.fit(train)
    given = MinMaxScaler(train.min(0).values, train.max(0).values)
    assert torch.equal(fitted.minimum, given.minimum)
    assert torch.equal(fitted.maximum, given.maximum)
    scaled = fitted(train)
    assert torch.equal(scaled.min(0).values, -torch.ones(4, dtype=torch.float64))
    assert torch.equal(scaled.max(0).values, torch.ones(4, dtype=torch.float64))


def test_what_leaves_the_range_is_clipped():
    scaler = MinMaxScaler(torch.tensor([0.0, -4.0]), torch.tensor([2.0, 4.0]))
    features = torch.tensor([[0.5, 0.0], [-9.0, 1e30], [math.inf, -math.inf]])
    assert scaler(features).tolist() == [[-0.5, 0.0], [-1.0, 1.0], [1.0, -1.0]]


def test_a_constant_feature_becomes_zero(rng):
    train = torch.from_numpy(rng.standard_normal((5, 3)))
    train[:, 1] = 0.1
    scaler = MinMaxScaler.fit(train)
    scaled = scaler(torch.tensor([[0.0, 0.1, 0.0], [0.0, 99.0, 0.0]], dtype=torch.float64))
    assert (scaled[:, 1] == 0).all()
    alone = MinMaxScaler.fit(train[:1])
    assert (alone(train) == 0).all()


def test_nan_stays_nan():
    scaler = MinMaxScaler(torch.tensor([0.0, 1.0]), torch.tensor([2.0, 1.0]))
    scaled = scaler(torch.tensor([[math.nan, 1.0], [1.0, math.nan]]))
    assert scaled[0, 0].isnan()
    assert scaled[1, 1].isnan()
    assert scaled[0, 1] == 0
    assert scaled[1, 0] == 0


def test_manners(rng, device):
    train = torch.from_numpy(rng.standard_normal((20, 4))).to(device)
    scaler = {
        torch.float64: MinMaxScaler.fit(train),
        torch.float32: MinMaxScaler.fit(train.float()),
    }
    features = torch.from_numpy(2 * rng.standard_normal((6, 4))).to(device)
    oracles.assert_manners(lambda x: scaler[x.dtype](x), features)


def test_gradcheck_and_the_gradient_where_clipped(rng):
    scaler = MinMaxScaler(-torch.ones(3).double(), torch.ones(3).double())
    features = torch.from_numpy(rng.uniform(-0.9, 0.9, (4, 3))).requires_grad_()
    assert torch.autograd.gradcheck(scaler, features)
    outside = torch.tensor([[3.0, -3.0, 0.5]], dtype=torch.float64, requires_grad=True)
    scaler(outside).sum().backward()
    assert outside.grad.tolist() == [[0, 0, 1]]
    still = MinMaxScaler(torch.ones(1), torch.ones(1))
    at = torch.tensor([[1.0], [2.0]], requires_grad=True)
    still(at).sum().backward()
    assert at.grad.tolist() == [[0], [0]]


def test_the_range_is_saved_with_the_state(rng):
    scaler = MinMaxScaler.fit(torch.from_numpy(rng.standard_normal((20, 4))))
    other = MinMaxScaler(torch.zeros(4), torch.ones(4)).double()
    other.load_state_dict(scaler.state_dict())
    features = torch.from_numpy(rng.standard_normal((5, 4)))
    assert torch.equal(other(features), scaler(features))
    assert list(scaler.parameters()) == []


def test_errors_name_the_feature():
    with pytest.raises(ValueError, match=r"\(2,\).*\(3,\)"):
        MinMaxScaler(torch.zeros(2), torch.ones(3))
    with pytest.raises(ValueError, match=r"feature 1.*1 and 0"):
        MinMaxScaler(torch.tensor([0.0, 1.0]), torch.tensor([1.0, 0.0]))
    with pytest.raises(ValueError, match=r"feature 0.*nan"):
        MinMaxScaler.fit(torch.tensor([[math.nan, 1.0], [0.0, 2.0]]))
    with pytest.raises(ValueError, match=r"feature 1.*inf"):
        MinMaxScaler.fit(torch.tensor([[0.0, math.inf], [0.0, 2.0]]))
