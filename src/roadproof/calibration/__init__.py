"""From recorded drives to recordings for attacks: where the canvas is in each frame, and how paint looks there."""

from roadproof.calibration.calibrate import METHODS as METHODS
from roadproof.calibration.calibrate import Calibrated as Calibrated
from roadproof.calibration.calibrate import CalibrationMethod as CalibrationMethod
from roadproof.calibration.calibrate import calibrate as calibrate
from roadproof.calibration.calibrate import replays_needed as replays_needed
from roadproof.calibration.report import CalibrationReport as CalibrationReport
from roadproof.calibration.report import DriveReport as DriveReport
