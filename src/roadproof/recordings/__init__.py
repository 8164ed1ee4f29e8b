"""Recorded drives, calibrated or about to be, and their folder."""

from roadproof.recordings.folder import check_free as check_free
from roadproof.recordings.folder import load_recordings as load_recordings
from roadproof.recordings.folder import save_recordings as save_recordings
from roadproof.recordings.folder import stated_weather as stated_weather
from roadproof.recordings.recording import Recording as Recording
from roadproof.recordings.recording import RecordingSet as RecordingSet
from roadproof.recordings.recording import Side as Side
from roadproof.recordings.recording import evenly as evenly
from roadproof.recordings.recording import pooled as pooled
from roadproof.recordings.track import FASTEST_MPS as FASTEST_MPS
from roadproof.recordings.track import Track as Track
