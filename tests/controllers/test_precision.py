import pytest
import torch

from roadproof.controllers.precision import multiplies_bfloat16


@pytest.mark.parametrize(("capability", "expected"), [("AVX512", True), ("AVX2", False), ("DEFAULT", False)])
def test_a_processor_without_wide_vectors_has_no_bfloat16_arithmetic(
    capability: str, expected: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    assert multiplies_bfloat16("cpu") is expected


def test_a_gpu_has_it() -> None:
    assert multiplies_bfloat16("cuda:0")
