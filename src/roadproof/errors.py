"""What can go wrong, each as one clear line: which value, what was expected, what to do.

The command line prints the message of a `RoadproofError` and ends with code 2; it never shows a traceback for one.
"""


class RoadproofError(Exception):
    """Anything roadproof refuses to do; its message is one line meant for the user."""


class GeometryError(RoadproofError, ValueError):
    """Points, poses or homographies that do not describe a view of the canvas."""


class ColourError(RoadproofError, ValueError):
    """Colour samples or transforms that cannot be fitted or applied."""


class PatternError(RoadproofError, ValueError):
    """A pattern, its figures or their bounds are not valid."""


class RecordingError(RoadproofError, ValueError):
    """A recording on disk is incomplete, damaged or inconsistent."""


class EpisodeError(RoadproofError, ValueError):
    """A driven episode, or its file, is incomplete, damaged or inconsistent."""


class CanvasNotReachedError(RecordingError, EpisodeError):
    """Without paint a car does not come to the canvas unharmed, or hardly moves, so that nothing can be recorded."""


class CalibrationError(RoadproofError, RuntimeError):
    """A calibration that cannot be trusted; the message says why and what to do."""


class ControllerError(RoadproofError, ValueError):
    """A controller cannot be loaded or does not do what attacks need of it."""


class DeviceError(RoadproofError, RuntimeError):
    """The device or precision asked for is not there."""


class OutputError(RoadproofError, OSError):
    """A result cannot be written where it was asked to go."""


class SimulatorError(RoadproofError, RuntimeError):
    """A simulator could not be started, was misused or stopped answering."""


class ScenarioError(RoadproofError, ValueError):
    """A scenario, its map or its route is not valid."""


class TrainingError(RoadproofError, ValueError):
    """Recorded drives or training settings that nothing can be learnt from."""


class StudyError(RoadproofError, ValueError):
    """A study's plan, or a folder with its results, is not valid."""


class CheckError(RoadproofError, ValueError):
    """The plan of a regression check, or what it names, is not valid."""
