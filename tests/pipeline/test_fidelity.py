"""Composites against renders, in the town itself."""

import dataclasses

import numpy as np
import pytest
import torch

import needs
from paint_shy import PaintShy, just_before_the_canvas
from roadproof.coverage import Shape
from roadproof.datatypes import Weather
from roadproof.driving.rollout import rollout
from roadproof.errors import EpisodeError, RecordingError
from roadproof.patterns import Pattern
from roadproof.photometry import AffineResponse, ColourTransform, pixel_maps_from_two_paints
from roadproof.pipeline.fidelity import (
    Fidelity,
    compare_with_rendered,
    is_drive_of,
    measure_fidelity,
    rendered_frames,
)
from roadproof.recordings import Recording, RecordingSet, Side

needs.town()
from roadproof.simulators.town.simulator import TownSimulator

SHORT = just_before_the_canvas(1.0)
PATTERN = Pattern(
    (Shape.RECTANGLE,), torch.tensor([[200.0, 200.0, 200.0, 300.0, 20.0]]), torch.tensor([[0.9, 0.1, 0.8]])
)
STEPS = np.arange(0, 20, 4)


@pytest.fixture(scope="module")
def drive():
    """A drive's episode, its calibrated recording, and the same frames over the real paint."""
    frames, homographies = [], []
    with TownSimulator() as town:
        episode = rollout(
            town,
            PaintShy(),
            SHORT,
            on_step=lambda seen, _: (frames.append(seen.frame), homographies.append(town.image_from_canvas())),
        )
        white, black = (np.full((400, 400, 4), (*[level] * 3, 255), np.uint8) for level in (255, 0))
        light, dark = (torch.tensor(rendered_frames(town, SHORT, episode, paint, STEPS)) for paint in (white, black))
        rendered = rendered_frames(town, SHORT, episode, PATTERN, STEPS)
        view, camera = town.input, town.camera
    maps = pixel_maps_from_two_paints(light, dark)
    recording = Recording(
        name="clean",
        side=Side.CLEAN,
        frames=np.stack(frames)[STEPS],
        frame_number=STEPS,
        image_from_canvas=np.stack(homographies)[STEPS],
        speed_mps=episode.speed_mps[STEPS],
        command=episode.command[STEPS],
        steer=episode.steer[STEPS],
        maps=maps,
    )
    recordings = RecordingSet(
        camera=camera, view=view, colour=ColourTransform(AffineResponse.identity()), recordings=(recording,)
    )
    return episode, recordings, rendered


def test_composites_of_a_calibrated_drive_are_close_to_renders_and_say_what_the_controller_does(drive):
    _, recordings, rendered = drive
    found = compare_with_rendered(PATTERN, recordings, PaintShy(), rendered)
    assert found.agreement.frames == len(STEPS)
    assert found.agreement.paint_error < 4.0
    assert found.agreement.elsewhere_error < 1.0
    assert found.agreement.rendered_shift > 0.01
    assert found.agreement.predicted_shift == pytest.approx(found.agreement.rendered_shift, rel=0.1)
    # Against the clean frames the error in the paint is the paint itself.
    assert np.abs(found.clean.astype(float) - rendered).max() > 50


def test_a_worse_composite_is_told_from_a_good_one(drive):
    _, recordings, rendered = drive
    other = Pattern(PATTERN.shapes, PATTERN.boxes, torch.tensor([[0.5, 0.5, 0.5]]))
    good, bad = (compare_with_rendered(each, recordings, PaintShy(), rendered) for each in (PATTERN, other))
    assert bad.agreement.paint_error > 5 * good.agreement.paint_error
    assert bad.agreement.steer_error > 5 * good.agreement.steer_error


def test_it_is_known_which_drive_was_recorded(drive):
    episode, recordings, _ = drive
    assert is_drive_of(recordings.recordings[0], episode)
    assert not is_drive_of(recordings.recordings[0], dataclasses.replace(episode, speed_mps=episode.speed_mps + 1.0))


def test_the_recorded_clean_drive_is_rendered_over_the_paint_and_kept(drive, town, tmp_path):
    episode, recordings, rendered = drive
    weather = Weather.CLEAR_NOON
    found = measure_fidelity(town, PaintShy(), SHORT, PATTERN, recordings, tmp_path, weather=weather)
    np.testing.assert_array_equal(found.rendered, rendered)
    assert Fidelity.load(tmp_path / "fidelity.npz").agreement == found.agreement
    other = dataclasses.replace(episode, speed_mps=episode.speed_mps + 1.0)
    assert (
        measure_fidelity(town, PaintShy(), SHORT, PATTERN, recordings, tmp_path, weather=weather, clean=other) is None
    )
    unseen = dataclasses.replace(PATTERN, boxes=PATTERN.boxes * torch.tensor([1.0, 1.0, 1e-3, 1e-3, 1.0]))
    assert (
        measure_fidelity(town, PaintShy(), SHORT, unseen, recordings, tmp_path, weather=weather, clean=episode) is None
    )


def test_it_is_saved_and_loaded(drive, tmp_path):
    _, recordings, rendered = drive
    found = compare_with_rendered(PATTERN, recordings, PaintShy(), rendered)
    found.save(tmp_path / "fidelity.npz")
    again = Fidelity.load(tmp_path / "fidelity.npz")
    assert all(np.array_equal(getattr(found, f.name), getattr(again, f.name)) for f in dataclasses.fields(Fidelity))
    (tmp_path / "fidelity.npz").write_bytes(b"text")
    with pytest.raises(EpisodeError, match="is damaged"):
        Fidelity.load(tmp_path / "fidelity.npz")


def test_frames_that_do_not_belong_together_are_refused(drive):
    _, recordings, rendered = drive
    with pytest.raises(RecordingError, match="render the same frames"):
        compare_with_rendered(PATTERN, recordings, PaintShy(), rendered[1:])
    with pytest.raises(RecordingError, match="no drive 'left', expected one of clean"):
        compare_with_rendered(PATTERN, recordings, PaintShy(), rendered, drive="left")
    with pytest.raises(RecordingError, match="frames up to 99 are asked of a drive of 21 steps"):
        rendered_frames(TownSimulator(), SHORT, drive[0], PATTERN, np.array([99]))
