"""The whole way from nothing to a controller that drives, in stages that stay in a folder.

    FOLDER/recipe.json            what was asked for
    FOLDER/drives/expert/         the expert's drives
    FOLDER/drives/painted/        the expert's drives over random paint, where asked for
    FOLDER/drives/round-1/ …      the network's own drives, with the expert's answers (DAgger)
    FOLDER/network-0.safetensors  what was learnt from the expert; network-1 … after each round
    FOLDER/NAME.safetensors       the last of them, in half the bytes

A stage whose files are there is not repeated, so an interrupted run goes on, and a folder can be carried to another
machine between stages.

References:
    Ross, Gordon, Bagnell, "A reduction of imitation learning and structured prediction to no-regret online learning",
    AISTATS 2011 (DAgger).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast

from roadproof.controllers import CIL, ConditionalPilotNet, save_controller, temporal_controller, waypoint_controller
from roadproof.controllers.shipped import shipped_weights
from roadproof.controllers.weights_file import load_network
from roadproof.errors import TrainingError
from roadproof.io.files import write_json
from roadproof.io.identity import digest, require_same
from roadproof.io.text import read_json
from roadproof.training.collection import CollectionPlan, collect
from roadproof.training.dataset import Dataset
from roadproof.training.imitation import Learner, TrainingPlan, imitate

FORMAT = "roadproof-recipe"
FORMAT_VERSION = 1
FRESH: dict[str, Callable[..., Learner]] = {
    "cil": CIL,
    "pilotnet": ConditionalPilotNet,
    "waypoint": waypoint_controller,
    "temporal": temporal_controller,
}
"""What makes each network with fresh weights."""

OnStage = Callable[[str, int, int, str], object]
"""Called with a stage's name, how much of it is done, of how much, and a word about it."""


def _unwatched(stage: str, done: int, total: int, word: str) -> None:
    del stage, done, total, word


@dataclass(frozen=True, kw_only=True, slots=True)
class Recipe:
    """How a controller is made.

    Args:
        network: "cil", "pilotnet" for the conditional PilotNet, "waypoint" for the one that sees a path, or "temporal"
            for that with a memory.
        width: factor on the channels and units of CIL; other networks have one width.
        seed: the seed of scenarios, traffic, disturbances, weights and batches.
        start: weights file, or name of a shipped controller, to go on from; None begins with fresh weights.
        drives: how many drives of the expert are recorded.
        painted_drives: how many drives of the expert over random paint are recorded besides.
        pasted: share of the pictures learnt from with coloured rectangles pasted on the road, 0 to 1.
        samples: frames seen in the first training, repetitions counted.
        learning_rate: the largest learning rate of the first training; the rounds' is a third of it.
        rounds: how often the network then drives itself and learns from the expert's answers.
        round_drives: how many drives of the network are recorded in each round.
        round_samples: frames seen in the training after each round.

    Raises:
        TrainingError: the network is unknown, or a number makes no sense.
    """

    network: str = "cil"
    width: float = 1.0
    seed: int = 0
    start: str | None = None
    drives: int = 260
    painted_drives: int = 0
    pasted: float = 0.0
    samples: int = 200_000
    learning_rate: float = 1.2e-3
    rounds: int = 0
    round_drives: int = 100
    round_samples: int = 100_000

    def __post_init__(self) -> None:
        if self.network not in FRESH:
            raise TrainingError(f"network is {self.network!r}, expected one of {', '.join(FRESH)}")
        for name in ("painted_drives", "rounds"):
            if getattr(self, name) < 0:
                raise TrainingError(f"{name} is {getattr(self, name)}, expected 0 or more")
        if self.width != 1.0 and self.network != "cil":
            raise TrainingError(f"width is {self.width:g}, but {self.network} has one width; leave it out")
        # Found out now rather than after an hour of driving.
        self.expert_plans()
        for number in range(self.rounds + 1):
            self.round_plan(number, Path())
            self.training_plan(number)

    def fresh(self) -> Learner:
        """The network as a recipe begins with it, before it has learnt anything.

        Raises:
            TrainingError: the weights to go on from are of another network.
            ControllerError: they are missing or damaged.
        """
        width = {"width": self.width} if self.network == "cil" else {}
        fresh = FRESH[self.network](seed=self.seed, **width)
        if self.start is None:
            return fresh
        begun = load_network(_weights(self.start))
        if type(begun) is not type(fresh):
            raise TrainingError(
                f"start {self.start} is a {type(begun).__name__}, network {self.network} a {type(fresh).__name__}; "
                "give the network that it goes on with"
            )
        if isinstance(begun, CIL) and self.width not in (1.0, begun.width):
            raise TrainingError(f"width is {self.width:g}, but start {self.start} has {begun.width:g}; leave it out")
        return begun

    def weights_of_start(self) -> str:
        """What tells the weights that are gone on from, whatever their name; empty for fresh ones."""
        return "" if self.start is None else digest(_weights(self.start).read_bytes())[:16]

    def expert_plans(self) -> dict[str, CollectionPlan]:
        """The plans of the expert's drives, by the name of their folder."""
        plans = {"expert": CollectionPlan(drives=self.drives, seed=self.seed)}
        if self.painted_drives:
            plans["painted"] = CollectionPlan(drives=self.painted_drives, seed=self.seed + 500, painted=0.8)
        return plans

    def round_plan(self, number: int, controller: Path) -> CollectionPlan:
        """The plan of the network's own drives in a round."""
        return CollectionPlan(
            drives=self.round_drives,
            seed=self.seed + 1000 * number,
            controller=str(controller),
            disturbed=0.5,
            painted=0.5 if self.painted_drives else 0.0,
        )

    def training_plan(self, number: int) -> TrainingPlan:
        """The plan of the training after a round; round 0 learns from the expert's drives alone."""
        first = number == 0
        # The frames of a window resemble each other: more of them make a batch as varied.
        return TrainingPlan(
            batch=256 if self.network == "temporal" else 128,
            samples=self.samples if first else self.round_samples,
            learning_rate=self.learning_rate if first else self.learning_rate / 3,
            seed=self.seed + 1000 * number,
            pasted=self.pasted,
        )


def gather(recipe: Recipe, folder: Path, *, processes: int = 1, on_stage: OnStage = _unwatched) -> list[Path]:
    """Record the expert's drives of a recipe; what can be done on another machine than the training.

    Returns:
        The files of the expert's drives.

    Raises:
        TrainingError: the folder belongs to another recipe.
        OutputError: the folder cannot be written.
    """
    recipe.fresh()  # weights to start from are read before the first drive
    _claim(recipe, folder)
    shards: list[Path] = []
    for name, plan in recipe.expert_plans().items():
        shards += _collected(plan, folder / "drives" / name, f"Driving ({name})", processes, on_stage)
    return shards


def follow(
    recipe: Recipe, folder: Path, *, processes: int = 1, device: str = "cpu", on_stage: OnStage = _unwatched
) -> Path:
    """Carry a recipe out, as far as the folder does not hold it yet.

    Args:
        recipe: how the controller is made.
        folder: the folder that keeps everything.
        processes: how many simulators drive at once.
        device: the torch device on which the network learns, such as "cpu" or "cuda".
        on_stage: called with a stage's name, the steps done, their number, and a word on them.

    Returns:
        The path of the controller's weights file.

    Raises:
        TrainingError: the folder belongs to another recipe, or nothing can be learnt.
        OutputError: the folder cannot be written.
    """
    shards = gather(recipe, folder, processes=processes, on_stage=on_stage)
    network = folder / "network-0.safetensors"
    _trained(recipe, 0, recipe.fresh, shards, network, device, on_stage)
    for number in range(1, recipe.rounds + 1):
        plan = recipe.round_plan(number, network)
        title = f"Round {number}, the network drives"
        shards += _collected(plan, folder / "drives" / f"round-{number}", title, processes, on_stage)
        before, network = network, folder / f"network-{number}.safetensors"
        _trained(recipe, number, lambda before=before: load_network(before), shards, network, device, on_stage)
    weights = folder / f"{recipe.network}.safetensors"
    save_controller(load_network(network), weights, dtype="float16")
    return weights


def _collected(plan: CollectionPlan, folder: Path, title: str, processes: int, on_stage: OnStage) -> tuple[Path, ...]:
    return collect(
        plan, folder, processes=processes, on_drive=lambda done: on_stage(title, done, plan.drives, "drives")
    )


def _trained(
    recipe: Recipe,
    number: int,
    start: Callable[[], Learner],
    shards: list[Path],
    path: Path,
    device: str,
    on_stage: OnStage,
) -> None:
    checkpoint = path.with_suffix(".ckpt")
    if not path.exists():
        title = "Learning from the expert" if number == 0 else f"Round {number}, learning"
        plan = recipe.training_plan(number)
        learnt = imitate(
            start(),
            Dataset.load(shards),
            plan,
            checkpoint=checkpoint,
            device=device,
            on_progress=lambda step, loss: on_stage(title, step, plan.steps, f"loss {loss:.4f}"),
        )
        save_controller(learnt, path)
    checkpoint.unlink(missing_ok=True)


def _weights(start: str) -> Path:
    return Path(start) if start.endswith(".safetensors") else shipped_weights(start)


def _claim(recipe: Recipe, folder: Path) -> None:
    """Write the recipe into its folder, or refuse a folder that was begun with another."""
    path, asked = folder / "recipe.json", asdict(recipe) | {"weights of start": recipe.weights_of_start()}
    if path.exists():
        kept = read_json(path, FORMAT, FORMAT_VERSION, TrainingError).get("recipe")
        if isinstance(kept, dict):
            # Folders are older than these words.
            kept = {"weights of start": asked["weights of start"]} | cast("dict[str, object]", kept)
        require_same(folder, "a training", kept, asked, TrainingError)
    else:
        write_json(path, {"format": FORMAT, "version": FORMAT_VERSION, "recipe": asked})
