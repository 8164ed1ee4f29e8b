import pytest
import torch

from roadproof.controllers.precision import multiplies_bfloat16, multiply_in


@pytest.mark.parametrize(("capability", "expected"), [("AVX512", True), ("AVX2", False), ("DEFAULT", False)])
def test_a_processor_without_wide_vectors_has_no_bfloat16_arithmetic(
    capability: str, expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    assert multiplies_bfloat16("cpu") is expected


def test_a_gpu_has_it() -> None:
    assert multiplies_bfloat16("cuda:0")


def test_multiplications_round_to_tf32_only_where_that_is_asked_for() -> None:
    before = torch.backends.cudnn.allow_tf32, torch.get_float32_matmul_precision()
    try:
        for dtype, rounds in (("float32", False), ("tf32", True), ("bfloat16", False)):
            multiply_in(dtype)
            assert torch.backends.cudnn.allow_tf32 is rounds
            assert torch.get_float32_matmul_precision() == ("high" if rounds else "highest")
    finally:
        torch.backends.cudnn.allow_tf32 = before[0]
        torch.set_float32_matmul_precision(before[1])
