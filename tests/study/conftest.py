import pytest

from hand_made_study import hand_made_records
from roadproof.datatypes import Weather
from roadproof.scenarios import builtin_scenarios
from roadproof.study.methods import BlackBoxPlan, GradOptPlan
from roadproof.study.plan import Study


@pytest.fixture
def small_study():
    return Study(
        controller="cil",
        scenarios=builtin_scenarios()[:1],
        figures=("1-b", 2),
        methods=(
            GradOptPlan(name="GradOpt"),
            BlackBoxPlan(name="BO", search="published-bo", calls=10, random_calls=5),
        ),
        weathers=(Weather.CLEAR_NOON, Weather.RAINY_NOON),
    )


@pytest.fixture
def records():
    return hand_made_records()
