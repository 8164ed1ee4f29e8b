"""The whole loop for one scenario: its stages, what each may spend, what it took."""

from roadproof.pipeline.budget import PUBLISHED as PUBLISHED
from roadproof.pipeline.budget import QUICK as QUICK
from roadproof.pipeline.budget import STEERING as STEERING
from roadproof.pipeline.fidelity import rendered_frames as rendered_frames
from roadproof.pipeline.limit_costs import LimitCosts as LimitCosts
from roadproof.pipeline.limit_costs import search_without as search_without
from roadproof.pipeline.stress_test import StressTest as StressTest
