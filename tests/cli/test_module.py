import subprocess
import sys


def test_the_module_runs_as_the_command_does():
    ran = subprocess.run([sys.executable, "-m", "roadproof", "--version"], capture_output=True, text=True, timeout=120)
    assert (ran.returncode, ran.stderr) == (0, "")
    assert ran.stdout.startswith("roadproof ")
