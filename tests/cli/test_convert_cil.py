"""`roadproof convert-cil` as its users call it."""

import numpy as np

from published_checkpoint import made_up_checkpoint


def test_a_checkpoint_becomes_a_controller_that_other_verbs_load(invoke, tmp_path):
    archive, out = tmp_path / "cil.npz", tmp_path / "cil.safetensors"
    np.savez(archive, **made_up_checkpoint(seed=3))
    code, printed = invoke("convert-cil", archive, out)
    assert code == 0, printed.err
    assert f"roadproof check-controller {out}" in printed.out
    code, printed = invoke("check-controller", out, "--no-drive")
    assert code == 0, printed.err
    assert "ok  gradients" in printed.out

    code, printed = invoke("convert-cil", archive, out)
    assert code == 2
    assert printed.err.startswith(f"roadproof: {out} exists already; choose a new file, or")
    assert printed.err.count("\n") == 1
    code, printed = invoke("convert-cil", archive, out, "--overwrite")
    assert code == 0, printed.err


def test_a_checkpoint_that_is_none_is_one_line(invoke, tmp_path):
    code, printed = invoke("convert-cil", tmp_path / "none.npz", tmp_path / "out.safetensors")
    assert code == 2
    assert printed.err.startswith(
        f"roadproof: {tmp_path / 'none.npz'} is missing; make it where TensorFlow is installed: "
    )
    assert printed.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
