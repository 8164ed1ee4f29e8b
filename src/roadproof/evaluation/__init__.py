"""Driving over a painted pattern and judging what came of it."""

from roadproof.evaluation.evaluate import PAPER_WEATHERS as PAPER_WEATHERS
from roadproof.evaluation.evaluate import Opening as Opening
from roadproof.evaluation.evaluate import evaluate as evaluate
from roadproof.evaluation.evaluate import random_patterns as random_patterns
from roadproof.evaluation.fidelity import Fidelity as Fidelity
from roadproof.evaluation.fidelity import compare_with_rendered as compare_with_rendered
from roadproof.evaluation.fidelity import is_drive_of as is_drive_of
from roadproof.evaluation.fidelity import rendered_frames as rendered_frames
from roadproof.evaluation.objective import DrivenObjective as DrivenObjective
from roadproof.evaluation.objective import Effect as Effect
from roadproof.evaluation.prediction import Prediction as Prediction
from roadproof.evaluation.prediction import predict as predict
from roadproof.evaluation.result import Evaluation as Evaluation
from roadproof.evaluation.result import Row as Row
from roadproof.evaluation.result import Trial as Trial
from roadproof.evaluation.selection import Selection as Selection
from roadproof.evaluation.selection import select_by_driving as select_by_driving
from roadproof.evaluation.starts import StartOffset as StartOffset
from roadproof.evaluation.starts import StartRange as StartRange
