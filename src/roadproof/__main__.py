"""`python -m roadproof`."""

from roadproof.cli import main

main()
