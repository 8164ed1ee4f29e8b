"""What a whole stress test spends, and on which search: quick, by the steering shift, or as published."""

from __future__ import annotations

from dataclasses import dataclass, field

from roadproof.attacks import GradOpt, Method, Objective, PathDeviation, Published, SpeedChange, SteeringShift
from roadproof.attacks.objective import ClosedLoop
from roadproof.calibration import CalibrationMethod
from roadproof.datatypes import PAPER_WEATHERS, Weather
from roadproof.drives import Scheme, SteeringNoise, Swerve, Trajectories, Window
from roadproof.driving.starts import USUAL_STARTS, StartRange
from roadproof.errors import RoadproofError
from roadproof.io.tables import each_once

PUBLISHED_WINDOW = Window(least_px=600, frames=100)
"""All frames in which the canvas is as large as in the released ones."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Budget:
    """How much is spent on one scenario, and how.

    Args:
        method: search method: by gradient, improved or published, or without gradients.
        objective: what the search makes large: a path deviation or a speed change in the recorded world, or a steering
            shift.
        trajectories: trajectories that are recorded. For a path deviation the default has a pair to the sides and a
            pair that weaves, so that frames look where an attacked car looks.
        window: which frames of each drive are kept; by default at most 40 that show at least 8 pixels of the canvas.
        pooled: whether drives to the right and left are attacked together too, as in the paper's Group-All.
        calibration: calibration method of the drives.
        select: number of candidates driven over, of which the strongest is kept; 1 verifies the first, 0 drives none.
        weathers: weathers of the evaluation.
        starts: number of the evaluation's drives alone in each weather, each from a start of its own.
        start_range: range from which these starts are drawn.
        runs: number of the evaluation's drives with traffic in each weather.
        rounds: number of re-recording rounds, which search on along the path of the attacked car (`rerecording`).
        attack_weathers: weathers of the recordings, over which the search takes the mean; candidates are driven in the
            first. By default the first of `weathers` alone.

    Raises:
        RoadproofError: a number is not whole or below 0, rounds have no candidates to drive, there are no weathers,
            they repeat or do not suit the calibration, or the search does not suit the drives or the published
            settings.
    """

    method: Method = field(default_factory=lambda: GradOpt(restarts=3))
    objective: Objective = field(default_factory=PathDeviation)
    trajectories: Trajectories = field(
        default_factory=lambda: Trajectories(count=5, perturbation=Swerve((1.5,), weaves_m=(0.5,)))
    )
    window: Window = field(default_factory=lambda: Window(frames=40, least_px=8))
    pooled: bool = False
    calibration: CalibrationMethod = CalibrationMethod.TWO_PAINT
    select: int = 1
    weathers: tuple[Weather, ...] = PAPER_WEATHERS
    starts: int = 5
    start_range: StartRange = USUAL_STARTS
    runs: int = 10
    rounds: int = 0
    attack_weathers: tuple[Weather, ...] = ()

    def __post_init__(self) -> None:
        for name in ("rounds", "select", "starts", "runs"):
            if not isinstance(number := getattr(self, name), int) or number < 0:
                raise RoadproofError(f"{name} is {number}, expected a whole number, 0 or more")
        each_once(self.weathers, "weathers", RoadproofError)
        if isinstance(self.method, Published):
            self._check_published()
        if self.rounds and not self.select:
            raise RoadproofError(f"{self.rounds} rounds begin from candidates that were driven; select 1 or more")
        if self.rounds and isinstance(self.objective, SpeedChange):
            raise RoadproofError(f"{self.rounds} rounds follow the path that was driven; a speed change has 0 rounds")
        if len(set(self.recorded_in)) < len(self.recorded_in):
            raise RoadproofError(f"attack_weathers are {', '.join(self.recorded_in)}; expected each once")
        if len(self.recorded_in) > 1 and self.calibration is CalibrationMethod.PUBLISHED:
            raise RoadproofError(
                f"a {self.calibration} calibration holds in one weather, {len(self.recorded_in)} are to be attacked; "
                f"choose {CalibrationMethod.TWO_PAINT}"
            )
        at_random = self.trajectories.scheme is Scheme.RANDOM
        if self.is_predicted and (self.pooled or at_random):
            raise RoadproofError(
                f"a {self.objective.name} is searched for each side apart; attack drives pooled or perturbed at random "
                "by their steering shift: objective=SteeringShift()"
            )

    def _check_published(self) -> None:
        told: dict[str, tuple[object, object]] = {
            "objective": (self.objective.name, SteeringShift().name),
            "perturbation": (type(self.trajectories.perturbation).__name__, SteeringNoise.__name__),
            "window": (self.window, PUBLISHED_WINDOW),
            "calibration": (str(self.calibration), str(CalibrationMethod.PUBLISHED)),
            "select": (self.select, 0),
            "rounds": (self.rounds, 0),
            "weathers attacked": (len(self.recorded_in), 1),
        }
        for name, (given, published) in told.items():
            if given != published:
                raise RoadproofError(
                    f"a published search with {name} {given}: as published it is {published}; "
                    "change it, or search with method=GradOpt()"
                )

    @property
    def is_predicted(self) -> bool:
        """Whether the search drives in the recorded world."""
        return isinstance(self.objective, ClosedLoop)

    @property
    def recorded_in(self) -> tuple[Weather, ...]:
        """The weathers of the recordings."""
        return self.attack_weathers or self.weathers[:1]


QUICK = Budget(starts=2, runs=0)
"""Minutes on a laptop, driven alone: the path in the recorded world, one candidate driven."""

STEERING = Budget(
    method=GradOpt(),
    objective=SteeringShift(),
    trajectories=Trajectories(),
    window=Window(),
    select=4,
    starts=2,
    runs=0,
)
"""As quick, but searching the steering shift on recorded frames, and driving over four candidates."""

PUBLISHED = Budget(
    method=Published(),
    objective=SteeringShift(),
    trajectories=Trajectories(perturbation=SteeringNoise()),
    window=PUBLISHED_WINDOW,
    calibration=CalibrationMethod.PUBLISHED,
    select=0,
)
"""As the paper and its code: 61 calls to calibrate, steering noise, all frames in which the canvas is as large as in
the released ones, linearised gradients, 4 × 250 iterations a side, nothing driven to choose, ten runs in traffic."""

BUDGETS = {"quick": QUICK, "steering": STEERING, "published": PUBLISHED}
