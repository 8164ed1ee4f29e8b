"""Small tensors kept on a device: the same numbers, made once."""

import torch

from roadproof.constants import constant, kept
from roadproof.photometry import AffineResponse
from roadproof.photometry.responses import FilmResponse, response_on


def test_a_constant_has_the_numbers_precision_and_device_that_were_asked_for_and_is_made_once():
    values = (0.1, 1 / 3, 400.0)
    for dtype in (torch.float32, torch.float64):
        like = torch.zeros(2, dtype=dtype)
        found = constant(values, like)
        assert found.dtype == dtype
        assert torch.equal(found, like.new_tensor(values))
        assert constant(values, like) is found
    assert constant(values, torch.zeros(1, device="meta")).device.type == "meta"


def test_a_constant_made_without_gradients_can_be_used_with_them():
    with torch.inference_mode():
        constant((7.0, 8.0), torch.zeros(2))
    leaf = torch.ones(2, requires_grad=True)
    (gradient,) = torch.autograd.grad((leaf * constant((7.0, 8.0), leaf)).sum(), leaf)
    assert gradient.tolist() == [7.0, 8.0]


def test_what_a_function_makes_is_kept():
    made = []

    def make(count):
        made.append(count)
        return torch.arange(count)

    like = torch.zeros(1)
    for _ in range(2):
        assert kept(make, (3,), like).tolist() == [0.0, 1.0, 2.0]
    assert made == [3]


def test_a_response_on_a_device_answers_the_same_bit_for_bit():
    film = FilmResponse(torch.tensor([1.1, 1.0, 0.9]).double(), torch.tensor(1.2), torch.tensor(2.4))
    affine = AffineResponse(torch.rand(3, 3, dtype=torch.float64), torch.rand(3, dtype=torch.float64))
    painted = torch.rand(50, 3, generator=torch.Generator().manual_seed(0))
    for response in (film, affine):
        assert torch.equal(response_on(response, "cpu", torch.float32)(painted), response(painted))
    own = lambda painted: painted  # noqa: E731
    assert response_on(own, "cpu", torch.float32) is own
