import subprocess
import sys


def test_the_module_runs_as_the_command_does():
    ran = subprocess.run([sys.executable, "-m", "roadproof", "--version"], capture_output=True, text=True, timeout=120)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert ran.stdout.startswith("roadproof ")


def test_a_command_to_which_nobody_listens_works_all_the_same():
    ran = subprocess.run(["/bin/sh", "-c", '"$0" -m roadproof --version >&-', sys.executable], timeout=120)
    assert ran.returncode == 0
