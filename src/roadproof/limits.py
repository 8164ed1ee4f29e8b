"""The largest numbers that are taken, wherever they are given: on the command line, in a plan, in a file."""

MAX_SEED = 2**32 - 1
MAX_FIGURES = 64
MAX_CROWD = 500
MAX_PROCESSES = 256
MANY = 1_000_000
