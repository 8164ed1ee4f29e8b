"""The weights of roadproof's controllers `cil`, `cil-small` and `cil-hardened`: files, and no code."""
