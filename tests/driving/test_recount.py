"""Points, factors and first events can be counted again from the events that evaluations and studies keep."""

import json

from roadproof.datatypes import Event, EventKind
from roadproof.driving.evaluation import Evaluation
from roadproof.driving.infractions import first_event_s, infraction_points, leaderboard_factor
from roadproof.study.rows import drive_columns
from runs import write_evaluation

# A rail touched twice, two lights within a second, the lawn after the sidewalk, the wrong lane twice and once more.
EVENTS = (
    Event(EventKind.WRONG_LANE, 1.05, "1.2 m beside its lane on road 2"),
    Event(EventKind.WRONG_LANE, 2.1, "1.9 m beside its lane on road 2"),
    Event(EventKind.SIDEWALK, 2.6, "a wheel on the sidewalk"),
    Event(EventKind.COLLISION_STATIC, 2.75, "guard rail 28"),
    Event(EventKind.OFF_ROAD, 3.1, "a wheel off the road"),
    Event(EventKind.COLLISION_STATIC, 3.9, "guard rail 28"),
    Event(EventKind.RED_LIGHT, 4.0, "traffic light at (45.0, -1.8)"),
    Event(EventKind.RED_LIGHT, 4.9, "traffic light at (61.5, -1.8)"),
    Event(EventKind.WRONG_LANE, 6.0, "0.9 m beside its lane on road 3"),
    Event(EventKind.STOP_SIGN, 7.7, "stop sign at (90.0, -1.8)"),
    Event(EventKind.COLLISION_PEDESTRIAN, 8.15, "pedestrian 4"),
)
CLEAN = EVENTS[6:8]
POINTS = 2 + 2 + 6 + 3 + 3 + 2 + 2 + 9


def test_evaluation_json_holds_all_that_its_points_are_made_of(tmp_path):
    write_evaluation(tmp_path, events=EVENTS, clean_events=CLEAN)
    trials = json.loads((tmp_path / "evaluation.json").read_text())["trials"]
    assert len(trials) == 6
    for trial in trials:
        painted, clean = (
            [Event(EventKind(each["kind"]), each["time_s"], each["detail"]) for each in trial[name]]
            for name in ("events", "clean_events")
        )
        assert (len(painted), len(clean)) == (8, 2)
        assert trial["points"] == infraction_points(painted) == POINTS
        assert trial["clean_points"] == infraction_points(clean) == 6.0
        assert trial["leaderboard"] == leaderboard_factor(painted)
        assert trial["clean_leaderboard"] == leaderboard_factor(clean)
        assert trial["first_event_s"] == first_event_s(painted) == 1.05
        assert trial["clean_first_event_s"] == first_event_s(clean) == 4.0


def test_a_row_of_a_study_holds_the_events_that_its_points_are_made_of(tmp_path):
    write_evaluation(tmp_path, events=EVENTS, clean_events=CLEAN)
    for trial in Evaluation.load(tmp_path).trials:
        row = drive_columns(trial)
        events = [Event(EventKind(kind), time_s, detail) for kind, time_s, detail in json.loads(row["events"])]
        assert tuple(events) == trial.events
        assert row["points"] == infraction_points(events) == POINTS
        assert row["leaderboard"] == leaderboard_factor(events)
        assert row["first_event_s"] == first_event_s(events)
