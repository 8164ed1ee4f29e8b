"""Freed memory is kept, measured by page faults of a process that asks for the same blocks; waiting threads sleep."""

import os
import platform
import subprocess
import sys
from importlib.metadata import version

import pytest

from roadproof.machine import made_with

ASK_AGAIN = """
import resource, torch
from roadproof.machine import keep_freed_memory
{first}
faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def step():
    first, second = torch.ones(8 << 18), torch.ones(40 << 18)
    del first
    third = torch.ones(20 << 18)
for _ in range(10):  # the heap grows to what is needed
    step()
before = faults()
for _ in range(10):
    step()
print(faults() - before)
"""


GIVE_BACK = """
import torch
from roadproof.machine import give_back_freed_memory, keep_freed_memory
keep_freed_memory()
taken = lambda: int(next(line for line in open("/proc/self/status") if line.startswith("VmRSS")).split()[1])
before = taken()
kept, freed = torch.ones(1000), [torch.ones(8 << 18) for _ in range(20)]
last = torch.ones(1000)
del freed
{first}
print(taken() - before)
"""
glibc_only = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")


def answer_of(script: str, first: str) -> int:
    told = subprocess.run(
        [sys.executable, "-c", script.format(first=first)], capture_output=True, text=True, check=True
    )
    return int(told.stdout)


@glibc_only
def test_blocks_that_were_freed_are_used_again() -> None:
    assert answer_of(ASK_AGAIN, "keep_freed_memory()") < 0.3 * answer_of(ASK_AGAIN, "")


@glibc_only
def test_what_was_freed_is_given_back_where_that_is_asked() -> None:
    assert answer_of(GIVE_BACK, "give_back_freed_memory()") < 0.1 * answer_of(GIVE_BACK, "")


ASK_CONTROLLER = (
    "import sys; sys.argv[1:] = ['check-controller', 'cil-small', '--no-drive']; import roadproof.cli as c; c.main()"
)


@pytest.mark.skipif(sys.platform != "linux", reason="torch's threads are not those of GNU OpenMP")
@pytest.mark.parametrize(
    ("asked", "spins"), [({}, "5000"), ({"OMP_WAIT_POLICY": "PASSIVE"}, "0"), ({"GOMP_SPINCOUNT": "7"}, "7")]
)
def test_threads_of_a_command_sleep_soon_while_they_wait_unless_the_user_says_otherwise(asked, spins) -> None:
    # A command that was called in this process has left its choice here.
    usual = {name: value for name, value in os.environ.items() if name not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    environment = {**usual, "OMP_DISPLAY_ENV": "VERBOSE", **asked}
    told = subprocess.run(
        [sys.executable, "-c", ASK_CONTROLLER], env=environment, capture_output=True, text=True, check=True
    )
    assert f"GOMP_SPINCOUNT = '{spins}'" in told.stderr


def test_what_figures_are_made_with_is_what_is_installed() -> None:
    told = made_with()
    for name in ("numpy", "pillow", "torch"):
        assert told[name] == version(name)
    assert told["processor"]
