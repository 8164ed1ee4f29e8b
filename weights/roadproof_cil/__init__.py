"""The weights of roadproof's controllers `cil` and `cil-small`: two files, and no code."""
