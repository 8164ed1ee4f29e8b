import pytest

from roadproof.datatypes import Weather
from roadproof.scenarios import builtin_scenarios
from roadproof.study.plan import MethodPlan, Study


@pytest.fixture
def small_study():
    return Study(
        controller="cil",
        scenarios=builtin_scenarios()[:1],
        figures=("1-b", 2),
        methods=(
            MethodPlan(name="GradOpt", search="gradopt"),
            MethodPlan(name="BO", search="published-bo", calls=10, random_calls=5),
        ),
        weathers=(Weather.CLEAR_NOON, Weather.RAINY_NOON),
    )
