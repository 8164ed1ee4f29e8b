"""Cars and people in the scene: those in view are put where they are, with the dark spots below them."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

from roadproof.datatypes import VehicleState
from roadproof.geometry import CameraModel
from roadproof.roads.roadmap import RoadMap, Surface
from roadproof.simulators.town.engine import Node, Path, Texture, core
from roadproof.simulators.town.ground import LitGround
from roadproof.simulators.town.meshes import Mesh, MeshBuilder
from roadproof.simulators.town.models import PAINTS, Body, car, person
from roadproof.simulators.town.shading import Layer, dress, mesh_node, shaded, turned
from roadproof.simulators.town.streets import KERB_M
from roadproof.traffic.agents import NOBODY, Agents

HEADINGS = 8
PERSON_LOOKS = 12
STEPS_M = 1.5
STRIDES = (-1.0, -0.4, 0.4, 1.0, 0.4, -0.4)
REACH_M, TALL_M = 3.0, 2.2
CAR_SHADE_M, PERSON_SHADE_M = (2.55, 1.25), (0.42, 0.42)


class AgentNodes:
    """All cars and people of a drive, as they are drawn."""

    def __init__(self, root: Path, roads: RoadMap, camera: CameraModel, shade: Texture) -> None:
        self._root, self._roads, self._camera, self._shade = root, roads, camera, shade
        self._cars, self._people = NOBODY, NOBODY
        self._nodes: tuple[list[_Figure], list[_Figure]] = ([], [])
        self._models: dict[tuple[int, float | None], list[Node]] = {}
        self._lit: LitGround

    def relight(self, lit: LitGround) -> None:
        """Colour everybody anew after a change of weather."""
        self._lit = lit
        self._models.clear()

    def populate(self, cars: Agents, people: Agents) -> None:
        """Take note of who is there and where; nothing is moved before it is looked at."""
        if (len(cars), len(people)) != (len(self._cars), len(self._people)):
            for figure in (*self._nodes[0], *self._nodes[1]):
                figure.remove()
            self._nodes = (
                [_Figure(self._root, self._shade, CAR_SHADE_M) for _ in range(len(cars))],
                [_Figure(self._root, self._shade, PERSON_SHADE_M) for _ in range(len(people))],
            )
        self._cars, self._people = cars, people

    def see(self, state: VehicleState, *, everybody: bool = False) -> None:
        """Put everybody in view of the camera of a vehicle where they are, and leave out the rest.

        Args:
            state: where the vehicle is now.
            everybody: whether to show everybody, as cameras other than the vehicle's own need.
        """
        for agents, figures, on_foot in (
            (self._cars, self._nodes[0], False),
            (self._people, self._nodes[1], True),
        ):
            if not figures:
                continue
            seen = in_view(self._camera, state, np.stack([agents.x_m, agents.y_m], axis=1))
            chosen = np.flatnonzero(seen | everybody)
            for hidden in set(range(len(figures))) - set(chosen.tolist()):
                figures[hidden].hide()
            if not len(chosen):
                continue
            points = np.stack([agents.x_m[chosen], agents.y_m[chosen]], axis=1)
            raised = self._roads.surface_at(points) == Surface.SIDEWALK if on_foot else np.zeros(len(chosen), bool)
            dark = self._lit.sunlit_at(points) < 0.5
            for k, i in enumerate(chosen.tolist()):
                yaw = float(agents.yaw_rad[i])
                stride = stride_at(float(agents.travelled_m[i])) if on_foot else None
                models = self._lit_models(int(agents.look[i]), stride)
                heading = round(yaw / (2 * math.pi / HEADINGS)) % HEADINGS
                model = models[heading + (HEADINGS if dark[k] else 0)]
                figures[i].show(model, float(points[k, 0]), float(points[k, 1]), yaw, raised=bool(raised[k]))

    def _lit_models(self, look: int, stride: float | None) -> list[Node]:
        """Nodes of an agent's mesh, lit for each heading, in the sun and then in the shade."""
        key = (look % (len(Body) * len(PAINTS) if stride is None else PERSON_LOOKS), stride)
        if key not in self._models:
            mesh = figure(*key)
            self._models[key] = [
                mesh_node(
                    mesh,
                    shaded(turned(mesh, 2 * math.pi * k / HEADINGS), self._lit.sky, np.full(len(mesh.points), sun)),
                )
                for sun in (1.0, 0.0)
                for k in range(HEADINGS)
            ]
        return self._models[key]


def stride_at(travelled_m: float) -> float:
    """Phase of the step of someone who has walked this far, −1 to 1."""
    return STRIDES[int(travelled_m / STEPS_M * 6) % 6]


def figure(look: int, stride: float | None) -> Mesh:
    """The shape of an agent: a person at this phase of the step, or a car if there is none."""
    if stride is not None:
        return person(look % PERSON_LOOKS, stride)
    look %= len(Body) * len(PAINTS)
    return car(Body(look % len(Body)), PAINTS[look // len(Body)])


def in_view(camera: CameraModel, state: VehicleState, points_m: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    """Whether an agent may be seen at each point: never False for one of which a part is within the picture's sides."""
    c, s = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
    away = points_m - (state.x_m, state.y_m)
    ahead = away @ (c, s) - camera.forward_m
    beside = np.abs(away @ (-s, c) - camera.left_m)
    pitch = math.radians(camera.pitch_deg)
    lift = max(-camera.up_m * math.sin(pitch), (TALL_M - camera.up_m) * math.sin(pitch))
    depth = ahead * math.cos(pitch) + lift + REACH_M
    return (depth > 0) & (beside - REACH_M < depth * math.tan(math.radians(camera.fov_deg) / 2))


class _Figure:
    """One car or person in the scene, with the dark spot below."""

    def __init__(self, root: Path, shade: Texture, half_m: tuple[float, float]) -> None:
        self._holder = core.PandaNode("agent")
        self._path = root.attach_new_node(self._holder)
        dress(self._path, Layer.SOLID)
        builder = MeshBuilder()
        builder.quad(np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) * np.append(half_m, 1))
        self._spot = self._path.attach_new_node(mesh_node(builder.build()))
        self._spot.set_texture(shade)
        dress(self._spot, Layer.SHADE)
        self._path.hide()
        self._raised, self._visible = False, False
        self._model: Node = None

    def show(self, model: Node, x_m: float, y_m: float, yaw_rad: float, *, raised: bool) -> None:
        """Show a model at a place; `raised` stands it on the pavement rather than on the road."""
        self._path.set_pos_hpr(x_m, y_m, KERB_M if raised else 0.0, math.degrees(yaw_rad), 0.0, 0.0)
        if raised != self._raised:
            self._raised = raised
            dress(self._spot, Layer.PAVEMENT_SHADE if raised else Layer.SHADE)
        if model is not self._model:
            if self._model is not None:
                self._holder.remove_child(self._model)
            self._holder.add_child(model)
            self._model = model
        if not self._visible:
            self._visible = True
            self._path.show()

    def hide(self) -> None:
        """Leave the figure out of what is seen."""
        if self._visible:
            self._visible = False
            self._path.hide()

    def remove(self) -> None:
        """Take the figure out of the scene."""
        self._path.remove_node()
