"""Options that several verbs share."""

from __future__ import annotations

import difflib
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, TypeVar, cast

import typer

from roadproof.errors import RoadproofError
from roadproof.io.tables import each_once
from roadproof.limits import MAX_CROWD, MAX_FIGURES, MAX_PROCESSES, MAX_SEED

if TYPE_CHECKING:
    from roadproof.controllers import Controller
    from roadproof.datatypes import Weather
    from roadproof.driving.rollout import Policy
    from roadproof.scenarios import Scenario
    from roadproof.simulators.loading import MappedSimulator

Word = TypeVar("Word", bound=str)


def number(
    about: str,
    least: int | float,
    most: int | float,
    *,
    default: bool | str = True,
    meant: Callable[[Any], Any] = lambda value: value,
) -> Any:  # noqa: ANN401
    """An option that is a number in a range, which its help states; of several numbers, each is.

    Args:
        about: what the number is, for the help.
        least: the smallest value.
        most: the largest value.
        default: whether the help shows the default, or what it says of the default instead.
        meant: gives the verb's argument from the value.
    """

    # Typer tells parameters of its own types apart by annotation, and hands over others.
    def check(_context: Any, parameter: Any, value: Any) -> Any:  # noqa: ANN401
        several = isinstance(value, (list, tuple))
        for each in cast("list[float]", value if several else [] if value is None else [value]):
            if not least <= each <= most:
                raise RoadproofError(f"{parameter.opts[0]} is {each}, expected {least:,} to {most:,}")
        return meant(value)

    return typer.Option(help=f"{about}  [{least:,} to {most:,}]", show_default=default, callback=check)


def unset(about: str, complete: Callable[[str], list[str]] | None = None, *, default: str = "") -> Any:  # noqa: ANN401
    """An option without a value of its own; `default` is what the help says of that, if anything."""
    return typer.Option(help=about, show_default=default or False, autocompletion=complete)


def scenario_names(begun: str) -> list[str]:
    """The built-in scenarios that begin so, for the shell."""
    return [scenario.name for scenario in scenarios_of(None) if scenario.name.startswith(begun)]


def weather_names(begun: str) -> list[str]:
    """The weathers that begin so, for the shell; of a list with commas, the last."""
    from roadproof.datatypes import Weather

    before, comma, last = begun.rpartition(",")
    return [before + comma + weather for weather in Weather if weather.startswith(last)]


def several_weathers(about: str) -> Any:  # noqa: ANN401
    """An option for weathers with commas between (`weathers_of`), in words."""
    return typer.Option(help=f"Weathers, with commas between, {about}.", autocompletion=weather_names)


def argument(about: str) -> Any:  # noqa: ANN401
    """An argument, in words; it must be given where its type has no default."""
    return typer.Argument(help=about, show_default=False)


def _simulator(spec: str) -> str:
    """What `--simulator` names, once it names a simulator; recordings are looked at by the verbs that drive in them."""
    if spec != "town":
        # The road map comes with it; `--help` is spared.
        from roadproof.simulators.loading import check_spec

        check_spec(spec)
    return spec


def _world(spec: str) -> str:
    """What `--simulator` names where that may also be recordings."""
    return spec if spec.startswith("recorded:") else _simulator(spec)


def _device(device: str) -> str:
    """The torch device that `--device` names, once there is such a device."""
    if device == "cpu":
        return device
    # Torch takes seconds to import; most commands never come here.
    import torch

    from roadproof.controllers.loading import device_of
    from roadproof.controllers.precision import multiply_in

    # So that a GPU answers as a CPU does.
    multiply_in("float32")
    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    return str(device_of(device))


_CONTROLLERS = "a shipped one (`roadproof controllers`), a {} file, cil:FILE, pilotnet:FILE or module:factory."
CONTROLLERS = _CONTROLLERS.format(".safetensors, .pt2 or .onnx")
TRAINABLE = _CONTROLLERS.format(".safetensors")
ControllerSpec: TypeAlias = Annotated[str, typer.Option("--controller", help=f"What is tested: {CONTROLLERS}")]
DriverSpec: TypeAlias = Annotated[
    str, typer.Option("--controller", "--driver", help=f"expert, or a controller: {CONTROLLERS}")
]
BudgetName: TypeAlias = Annotated[
    str,
    typer.Option(
        help="quick: for the path in the recorded world; steering: for the steering shift on recorded frames; "
        "published: as the paper's authors had it, hours."
    ),
]
ScenarioName: TypeAlias = Annotated[
    str, typer.Option(help="One of those that `roadproof scenarios` lists.", autocompletion=scenario_names)
]
ScenarioOrRecorded: TypeAlias = Annotated[
    str | None,
    unset(
        "One of those that `roadproof scenarios` lists.", scenario_names, default="left-03, or that of the recordings"
    ),
]
ScenarioFile: TypeAlias = Annotated[
    Path | None,
    typer.Option("--scenarios", help="TOML file with scenarios of your own.", show_default="the built-in 40"),
]
WeatherName: TypeAlias = Annotated[
    str, typer.Option(help="One of the eight, for instance rainy-noon.", autocompletion=weather_names)
]
SimulatorSpec: TypeAlias = Annotated[
    str,
    typer.Option("--simulator", help="Where it is driven: town, town:egl or carla://HOST:PORT.", callback=_simulator),
]
WorldSpec: TypeAlias = Annotated[
    str,
    typer.Option(
        "--simulator",
        help="Where it is driven: town, town:egl, carla://HOST:PORT, or recorded:FOLDER to predict it in recordings.",
        callback=_world,
    ),
]
Device: TypeAlias = Annotated[
    str,
    typer.Option(
        help="What networks compute on: cpu, cuda, cuda:N, or auto for a GPU where there is one.", callback=_device
    ),
]

CheapestFor: TypeAlias = Annotated[
    float | None,
    number("Also find the fewest square metres of paint for so many metres of deviation.", 0.05, 100.0, default=False),
]
LimitCosts: TypeAlias = Annotated[
    bool,
    typer.Option("--limit-costs", help="Also search without each limit on paint, to tell the metres that it costs."),
]
Figures: TypeAlias = Annotated[int, number("K, how many figures are painted.", 1, MAX_FIGURES)]
Cars: TypeAlias = Annotated[int, number("Other cars on the road.", 0, MAX_CROWD)]
Pedestrians: TypeAlias = Annotated[int, number("People about.", 0, MAX_CROWD)]
Processes: TypeAlias = Annotated[
    int,
    number(
        "How many simulators drive at once; 0 for one a core. Several compute on the CPU.",
        0,
        MAX_PROCESSES,
        meant=lambda count: count or os.cpu_count() or 1,
    ),
]
Seed: TypeAlias = Annotated[int, number("Of everything random.", 0, MAX_SEED)]
Out: TypeAlias = Annotated[Path, typer.Option(help="Folder for the results; the same folder goes on where it was.")]
NewOut: TypeAlias = Annotated[Path, typer.Option("--out", help="Folder for the results.")]
Trust: TypeAlias = Annotated[
    bool, typer.Option("--trust", help="Follow a plan that runs code or calls another machine; read it first.")
]


def check_processes(simulator: str, processes: int) -> None:
    """See that several processes have a simulator each.

    Raises:
        RoadproofError: several processes would share one server.
    """
    # The road map comes with it; `--help` is spared.
    from roadproof.simulators.loading import is_server

    if processes > 1 and is_server(simulator):
        raise RoadproofError(
            f"--processes is {processes}, but all of them would step the one server of {simulator}; expected 1"
        )


def choice(value: str, option: str, allowed: Sequence[Word]) -> Word:
    """The allowed word that an option's value is.

    Raises:
        RoadproofError: the value is none of the allowed words; the message names the nearest.
    """
    for word in allowed:
        if value == word:
            return word
    near = difflib.get_close_matches(value, allowed, 1)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise RoadproofError(f"--{option} is {value!r}, expected one of {', '.join(allowed)}{hint}")


def scenarios_of(file: Path | None) -> tuple[Scenario, ...]:
    """The scenarios of a file, or the built-in ones.

    Raises:
        ScenarioError: the file is missing or damaged.
    """
    from roadproof.scenarios import BUILTIN_FILE, load_scenarios

    return load_scenarios(file or BUILTIN_FILE)


def scenario_of(name: str, file: Path | None) -> Scenario:
    """The scenario of a name, from a file or the built-in ones.

    Raises:
        ScenarioError: the file is missing or damaged, or no scenario has this name; the message names the nearest.
    """
    from roadproof.scenarios import find_scenario

    return find_scenario(name, scenarios_of(file))


def weather_of(name: str, option: str = "weather") -> Weather:
    """The weather of a name.

    Raises:
        RoadproofError: no weather has this name; the message names the nearest.
    """
    from roadproof.datatypes import Weather

    return Weather(choice(name, option, tuple(Weather)))


def weathers_of(names: str, option: str) -> tuple[Weather, ...]:
    """The weathers whose names stand in a list, with commas between.

    Raises:
        RoadproofError: a name is no weather's, where the message names the nearest, or is there twice.
    """
    found = tuple(weather_of(name.strip(), option) for name in names.split(","))
    each_once(found, f"--{option}", RoadproofError)
    return found


def driver_of(spec: str, device: str) -> Controller | Callable[[MappedSimulator], Policy]:
    """The expert, or the controller of a spec.

    Raises:
        ControllerError: the spec is neither of the expert nor of a controller, or the controller cannot be loaded.
    """
    from roadproof.controllers import load_controller, shipped_names
    from roadproof.controllers.loading import SPECS
    from roadproof.errors import ControllerError
    from roadproof.training.expert import expert

    if spec == "expert":
        return expert
    if spec.isidentifier() and spec not in shipped_names():
        raise ControllerError(f"--controller is {spec!r}, expected expert or a controller: {SPECS}")
    return load_controller(spec, device=device)
