"""The settings of a recording know the lens, and those of pinholes stay as they were."""

import json
from dataclasses import replace

import pytest

from lenses import ACTION, BARREL, behind
from roadproof.drives.folder import write_settings
from roadproof.errors import RecordingError
from roadproof.geometry import CIL_CAMERA
from roadproof.scenarios import find_scenario
from runs import settings_of

SETTINGS = settings_of(find_scenario("left-03"))


def test_a_recording_goes_on_with_its_own_lens_only(tmp_path):
    bent = replace(SETTINGS, camera=behind(BARREL))
    assert write_settings(bent, tmp_path)
    assert not write_settings(bent, tmp_path)
    for other in (CIL_CAMERA, behind(ACTION)):
        with pytest.raises(RecordingError, match=r"a recording with camera\.lens"):
            write_settings(replace(SETTINGS, camera=other), tmp_path)


def test_a_recording_through_a_pinhole_is_described_as_before_there_were_lenses(tmp_path):
    write_settings(SETTINGS, tmp_path)
    assert "lens" not in json.loads((tmp_path / "record.json").read_text())["camera"]
    assert not write_settings(SETTINGS, tmp_path)
    with pytest.raises(RecordingError, match=r"camera\.lens"):
        write_settings(replace(SETTINGS, camera=behind(BARREL)), tmp_path)
