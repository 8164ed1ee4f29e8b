"""`roadproof import`: drives of your own in, recordings out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from roadproof.cli.options import NewOut, argument
from roadproof.cli.output import answer, say, stored


def import_(
    folder: Annotated[Path, argument("Your pictures and tables, with drives.toml; see docs/recordings.md.")],
    out: NewOut = Path("out/recordings"),
) -> None:
    """Make recordings of drives of your own: pictures, and a table of poses and controls."""
    from roadproof.drives.own import import_drives, preview
    from roadproof.io.files import write_atomically
    from roadproof.recordings import check_free, save_recordings

    check_free(out)
    recordings = import_drives(folder)
    picture, shown = preview(recordings), out / "preview.png"
    save_recordings(recordings, out)
    write_atomically(shown, picture.save)
    camera, canvas = recordings.camera, recordings.canvas
    lens = "" if camera.lens is None else f", behind a {camera.lens.model} lens"
    say(f"camera {camera.up_m:.2f} m above the ground, pitch {camera.pitch_deg:.1f}°, {camera.fov_deg:.1f}° wide{lens}")
    if canvas is not None:
        say(f"canvas {canvas.width_m:.2f} m across the road, {canvas.length_m:.2f} m along it")
    for drive in recordings.recordings:
        say(f"  {drive.name:8} {len(drive.frames)} frames, steps {drive.frame_number[0]} to {drive.frame_number[-1]}")
    for told in recordings.origin.split("; "):
        say(f"  {told}")
    say(f"Is the canvas where it should be? {shown}")
    say(f"Recordings in {out}; next: roadproof attack {out} --objective deviation --controller ...")
    answer(stored(out / "recordings.json"))
