"""Drives: made, kept, compared, judged."""

from roadproof.driving.episode import Episode as Episode
from roadproof.driving.evaluation import Evaluation as Evaluation
from roadproof.driving.infractions import infraction_points as infraction_points
from roadproof.driving.infractions import leaderboard_factor as leaderboard_factor
