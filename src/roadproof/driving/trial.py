"""One drive over paint against the same drive without it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from statistics import fmean

from roadproof.datatypes import Ending, Event, Weather
from roadproof.driving.deviation import LEAVES_LANE_M, beside_m, passage_deviation_m
from roadproof.driving.episode import Episode
from roadproof.driving.infractions import counted, first_event_s, infraction_points, leaderboard_factor
from roadproof.driving.speed import speed_difference
from roadproof.driving.starts import NOMINAL, StartOffset
from roadproof.errors import EpisodeError
from roadproof.geometry import CanvasPlacement
from roadproof.io.files import check_name


@dataclass(frozen=True, kw_only=True, slots=True)
class Trial:
    """One drive over a pattern against the same drive without it. All numbers are of driving, or all predicted.

    Args:
        pattern: "attack", or "random-N".
        weather: weather of both drives.
        traffic: whether there were other cars and pedestrians.
        seed: seed of cars and pedestrians.
        clean: file name of the drive without paint, in the episodes' folder; empty if it was not kept.
        painted: file name of the drive over paint, in the episodes' folder; empty if it was not kept.
        deviation_m: the paper's deviation between the two drives, metres (`driving.deviation`).
        speed_change_mps: mean change of the speed while the canvas is in view, m/s, negative where the painted drive
            is slower (`driving.speed`); None in files of earlier versions, as in the next.
        most_speed_change_mps: change of the speed at the instant at which it was largest, m/s.
        lateral_m: largest offset of the painted drive from the clean path, metres, left positive.
        points: infraction points with paint; None, as in the next three, if infractions are not known.
        clean_points: infraction points without paint.
        leaderboard: the Leaderboard's factor with paint, in (0, 1].
        clean_leaderboard: the Leaderboard's factor without paint, in (0, 1].
        first_event_s: time of the first event with paint, seconds; None if there is none, or none is known.
        clean_first_event_s: time of the first event without paint, seconds; None if there is none, or none is known.
        ending: why the painted drive ended.
        clean_ending: why the drive without paint ended; empty in files of earlier versions.
        events: events of the painted drive that count (`infractions.counted`), so that anyone can count again.
        clean_events: events of the clean drive that count.
        start: offset of both drives' start from the scenario's.

    Raises:
        EpisodeError: the name of an episode's file is not a plain name that ends in .npz.
    """

    pattern: str
    weather: Weather
    traffic: bool
    seed: int
    clean: str
    painted: str
    deviation_m: float
    lateral_m: float
    points: float | None
    clean_points: float | None
    leaderboard: float | None
    clean_leaderboard: float | None
    first_event_s: float | None
    clean_first_event_s: float | None
    ending: str
    clean_ending: str = ""
    events: tuple[Event, ...] = ()
    clean_events: tuple[Event, ...] = ()
    start: StartOffset = NOMINAL
    speed_change_mps: float | None = None
    most_speed_change_mps: float | None = None

    @property
    def loses_its_way(self) -> bool:
        """Whether it does not arrive, as the drive without paint does."""
        return self.clean_ending == Ending.GOAL_REACHED != self.ending

    @property
    def leaves_lane(self) -> bool:
        """Whether part of the car gets over its lane's edge, or its infractions cost more than those without paint."""
        return abs(self.lateral_m) >= LEAVES_LANE_M or (self.points or 0.0) > (self.clean_points or 0.0)

    def __post_init__(self) -> None:
        for name in filter(None, (self.clean, self.painted)):  # drives that were not kept have none
            if not check_name(name, "episode", EpisodeError).endswith(".npz"):
                raise EpisodeError(f"episode {name!r:.120} is not the name of an .npz file")


def judge(
    clean: Episode,
    painted: Episode,
    canvas: CanvasPlacement,
    *,
    pattern: str,
    clean_file: str,
    painted_file: str,
    start: StartOffset = NOMINAL,
) -> Trial:
    """The trial of two drives that differ in the paint alone.

    Deviation and change of the speed are taken over the instants at which the clean drive has the canvas in view, the
    largest offset over the whole painted drive; where the clean drive ended early, only as far as that got.
    """
    beside = beside_m(clean, painted)
    faster = speed_difference(clean, painted, canvas)
    known = not painted.paint.predicted
    return Trial(
        pattern=pattern,
        weather=painted.weather,
        traffic=painted.cars + painted.pedestrians > 0,
        seed=painted.seed,
        clean=clean_file,
        painted=painted_file,
        deviation_m=passage_deviation_m(clean, painted, canvas),
        lateral_m=max(beside.tolist(), key=abs),
        points=infraction_points(painted.events) if known else None,
        clean_points=infraction_points(clean.events) if known else None,
        leaderboard=leaderboard_factor(painted.events) if known else None,
        clean_leaderboard=leaderboard_factor(clean.events) if known else None,
        first_event_s=first_event_s(painted.events),
        clean_first_event_s=first_event_s(clean.events),
        ending=str(painted.ending),
        clean_ending=str(clean.ending),
        events=counted(painted.events),
        clean_events=counted(clean.events),
        start=start,
        speed_change_mps=faster.mean_mps,
        most_speed_change_mps=faster.most_mps,
    )


def runs_of(trials: Iterable[Trial], value: Callable[[Trial], float]) -> list[float]:
    """A number of independent runs: of each pattern, start and seed the mean over the weathers.

    The same starts and seeds are driven in every weather, so that drives in several weathers are not independent.
    """
    runs: dict[tuple[object, ...], list[float]] = {}
    for trial in trials:
        runs.setdefault((trial.pattern, trial.traffic, trial.seed, trial.start), []).append(value(trial))
    return list(map(fmean, runs.values()))
