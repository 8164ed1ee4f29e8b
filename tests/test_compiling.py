"""Kernels compute what their source says, whatever was kept of them, and every part of their work is done once."""

import importlib.util
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import no_type_check

import pytest
import torch

from roadproof import compiling
from roadproof.compiling import Kernel, run


@no_type_check
def _twice(x):
    return 2 * x


@Kernel
@no_type_check
def _counted(parts, add, part):
    parts[part] += add


def test_where_nothing_can_be_kept_kernels_are_compiled_each_time(monkeypatch):
    usual = compiling._numba.njit

    def nowhere(function, **options):
        if options.get("cache"):
            raise RuntimeError("cannot cache function 'twice': no locator available for file")
        return usual(function, **options)

    monkeypatch.setattr(compiling._numba, "njit", nowhere)
    assert Kernel(_twice)(2) == 4


@pytest.fixture
def scaled(tmp_path, monkeypatch):
    """A kernel of a module, as a fresh process has it, and the files that are kept of it."""

    def imported(scale=3, other=1.0):
        numbers = tmp_path / "numbers_of_kernels.py"
        numbers.write_text(f"OTHER = {other}\n")
        file = tmp_path / "module_with_kernel.py"
        file.write_text(
            "from roadproof.compiling import Kernel\n"
            "from numbers_of_kernels import OTHER\n"
            f"@Kernel\ndef scaled(x):\n    return {scale} * OTHER * x\n"
        )
        importlib.invalidate_caches()
        for name in ("numbers_of_kernels", "module_with_kernel"):
            spec = importlib.util.spec_from_file_location(name, tmp_path / f"{name}.py")
            module = importlib.util.module_from_spec(spec)
            monkeypatch.setitem(sys.modules, name, module)
            # Numbers that were compiled a moment ago stand in no file of Python's.
            exec(compile(Path(spec.origin).read_text(), spec.origin, "exec"), vars(module))
        return module.scaled

    return imported, lambda: sorted(tmp_path.rglob("*.nb[ic]"))


def test_a_kept_kernel_is_not_taken_for_one_of_other_source_or_numbers(scaled):
    imported, kept = scaled
    assert imported()(2.0) == 6.0
    files = kept()
    assert len(files) == 2
    assert imported()(2.0) == 6.0
    assert kept() == files
    assert imported(scale=5)(2.0) == 10.0
    assert imported(other=10.0)(2.0) == 60.0
    assert imported()(2.0) == 6.0
    assert len(kept()) == 6


@pytest.mark.parametrize("which", [".nbi", ".nbc"])
def test_what_is_damaged_of_a_kept_kernel_is_compiled_anew(scaled, which):
    imported, kept = scaled
    imported()(2.0)
    (damaged,) = (file for file in kept() if file.suffix == which)
    damaged.write_bytes(damaged.read_bytes()[:20])
    assert imported()(2.0) == 6.0
    assert imported()(2.0) == 6.0
    assert len(damaged.read_bytes()) > 20


def test_threads_may_find_the_damage_at_once(scaled):
    imported, kept = scaled
    imported()(2.0)
    for file in kept():
        file.write_bytes(b"damaged")
    kernel, interval = imported(), sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(8) as pool:
            assert list(pool.map(kernel, [2.0] * 8)) == [6.0] * 8
    finally:
        sys.setswitchinterval(interval)


@Kernel
@no_type_check
def _over(found, number, part):
    found[part] = number / found[part]


def test_a_division_by_nought_is_that_of_tensors():
    found = torch.zeros(2)
    run(_over, (found, 1.0), 2)
    assert found.isinf().all()


def test_an_error_of_the_call_itself_is_raised(scaled):
    imported, _ = scaled
    with pytest.raises(Exception, match="Cannot determine Numba type"):
        imported()(object())


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("parts", [0, 1, 40])
def test_each_part_is_done_once_on_any_number_of_threads(threads, parts):
    done, before = torch.zeros(40), torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        run(_counted, (done, 1.5), parts)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(done, 1.5 * (torch.arange(40) < parts))
