"""Steps of a search as one CUDA graph, recorded once a rung and replayed.

A step is some hundreds of small operations. On a GPU the processor takes longer to start them one by one than the GPU
to do them; a graph starts them all at once. It holds the operations, the shapes and the places in memory, so a step
must be the same every time and must ask for nothing from the device. Where that cannot be, as with a controller that
calls `.item()`, steps are run one operation at a time, and the result says why.
"""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Callable
from typing import TypedDict, Unpack

import torch

from roadproof.attacks.batched import BatchedMeasure
from roadproof.attacks.objective import RecordedMeasure
from roadproof.attacks.step import State, corrected, require_finite_step, stepped
from roadproof.errors import RoadproofError
from roadproof.foreign import in_one_line
from roadproof.search_space import SearchSpace

LOOK_S = 0.5
"""Steps are replayed for about so long before their outcome is looked at, told and kept."""

LEAST = 6
"""So many steps are worth recording: that takes as long as three of them, and some time more."""

_HELD = ("unit", "best_unit", "best", "exp_avg", "exp_avg_sq")


class Steps(TypedDict):
    """The steps of one rung.

    Args:
        learning_rate: Adam's learning rate.
        momentum: Adam's β₁.
        iterations: number of steps of the rung.
        state: the state that the steps begin with; it is not changed.
    """

    learning_rate: float
    momentum: float
    iterations: int
    state: State


class Replay:
    """The steps of one rung, on tensors that stay where they are.

    Args:
        measure: the measure that is made large, whose frames are counted.
        same: the measure whose steps are the same operations every time, see `replayable` of a measure.
        space: the search space.
        **steps: learning rate, momentum, iterations and state; see `Steps`.

    Attributes:
        again: takes one step more, which nobody waits for or looks at; `go_on` is what a search calls.

    Raises:
        RuntimeError, RoadproofError: a step cannot be recorded.
    """

    def __init__(
        self, measure: RecordedMeasure, same: RecordedMeasure, space: SearchSpace, **steps: Unpack[Steps]
    ) -> None:
        state, momentum = steps["state"], steps["momentum"]
        self._measure, self._same, self._space, self._momentum = measure, same, space, momentum
        self._done, self._left = int(state["done"]), steps["iterations"] - int(state["done"])
        unit, history = state["unit"], state["history"]
        numbers = [corrected(steps["learning_rate"], momentum, 1 + self._done + k) for k in range(self._left)]
        self._rate, self._root = (torch.tensor(each, device=unit.device) for each in zip(*numbers, strict=True))
        self._begin = {name: state[name] for name in _HELD} | {
            "row": torch.zeros(1, dtype=torch.int64, device=unit.device),
            "finite": torch.ones((), dtype=torch.bool, device=unit.device),
        }
        self._now = {name: tensor.clone() for name, tensor in self._begin.items()}
        self._before, self._new = history, history.new_zeros(self._left, *history.shape[1:])
        self._taken, self._at_once = 0, 1
        frames = same.frames_evaluated
        self._advance()
        self._frames = same.frames_evaluated - frames
        self._restart()
        self.again = RECORDERS[unit.device.type](self._advance, self._restart, unit.device)
        self._restart()

    def go_on(self) -> State:
        """Take some steps, as many as `LOOK_S` has room for, and the state after them.

        Raises:
            RoadproofError: a value or a gradient was NaN or infinite in one of them.
        """
        count, began = min(self._at_once, self._left - self._taken), time.monotonic()
        for _ in range(count):
            self.again()
        self._taken += count
        self._measure.frames_evaluated += count * self._frames
        require_finite_step(self._now["finite"])
        self._at_once = max(1, int(LOOK_S * count / max(time.monotonic() - began, 1e-6)))
        state = {name: self._now[name].clone() for name in _HELD}
        history = torch.cat([self._before, self._new[: self._taken]])
        return state | {"history": history, "done": torch.tensor(self._done + self._taken)}

    def _advance(self) -> None:
        """One step, in place."""
        now, row = self._now, self._now["row"]
        rate, root = self._rate.index_select(0, row), self._root.index_select(0, row)
        changed, value, finite = stepped(self._same, self._space, self._momentum, rate, root, now)
        for name, tensor in changed.items():
            now[name].copy_(tensor)
        self._new.index_copy_(0, row, value[None])
        now["finite"].logical_and_(finite)
        row.add_(1)

    def _restart(self) -> None:
        for name, tensor in self._begin.items():
            self._now[name].copy_(tensor)


def replay_of(measure: RecordedMeasure, space: SearchSpace, **steps: Unpack[Steps]) -> Replay | str | None:
    """The steps of a rung as a `Replay`; why there is none, in words; None where there is no need, as on a CPU."""
    if measure.device.type not in RECORDERS or int(steps["state"]["done"]) >= steps["iterations"]:
        return None
    same = measure.replayable() if isinstance(measure, BatchedMeasure) else None
    if same is None:
        return "their operations differ from step to step"
    # A rung that is resumed is recorded, or not, as it was.
    if steps["iterations"] < LEAST:
        return "too few in a row to be worth recording"
    try:
        return Replay(measure, same, space, **steps)
    except (RuntimeError, RoadproofError) as error:
        return in_one_line(error)


def steps_in_words(steps: Counter[str | None], *, kernels: bool = True) -> str:
    """How steps were run; "" on a CPU.

    Args:
        steps: their number by what `replay_of` said, "" where they were replayed.
        kernels: whether the device has kernels of our own for painting.
    """
    reasons = [reason for reason in steps if reason]
    if not reasons and not steps[""]:
        return ""
    told = f"{steps['']} of {sum(steps.values())} steps were replayed as a CUDA graph"
    told = f"{told}; the others ran one operation at a time: {'; '.join(reasons)}" if reasons else told
    return told if kernels else f"{told}; painting took longer than it could, since Triton cannot compile here"


def cuda_graph(advance: Callable[[], None], restart: Callable[[], None], device: torch.device) -> Callable[[], object]:
    """Record what a function does on a GPU, and give what does it again; the function itself has run before.

    Args:
        advance: the function, which works on tensors that stay where they are.
        restart: puts these tensors back to what they were.
        device: the GPU.

    Raises:
        RuntimeError: the function asks the device for something, or does what no graph can hold.
    """
    with torch.cuda.device(device):
        side, graph = torch.cuda.Stream(), torch.cuda.CUDAGraph()
        side.wait_stream(torch.cuda.current_stream())
        # The stream is entered here too, since a capture that fails does not leave it.
        try:
            with torch.cuda.stream(side):
                # A capture that fails leaves traces in torch's allocator and generator, so look for what waits before.
                _without_waiting(advance)
                restart()
                with torch.cuda.graph(graph, stream=side, capture_error_mode="thread_local"):
                    advance()
        finally:
            torch.cuda.current_stream().wait_stream(side)
    return graph.replay


def _without_waiting(function: Callable[[], None]) -> None:
    before = torch.cuda.get_sync_debug_mode()
    with warnings.catch_warnings():
        # Torch says that it does not find everything yet; what it misses, the capture finds.
        warnings.simplefilter("ignore")
        torch.cuda.set_sync_debug_mode("error")
        try:
            function()
        finally:
            torch.cuda.set_sync_debug_mode(before)


RECORDERS: dict[str, Callable[[Callable[[], None], Callable[[], None], torch.device], Callable[[], object]]] = {
    "cuda": cuda_graph
}
"""What records a step, by the type of the device; on others steps are run one operation at a time."""
