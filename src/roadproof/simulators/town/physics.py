"""The car and what it can hit, in Bullet: fixed substeps, a fresh world for every drive, the same result every time.

Convention:
    Bullet's vehicle looks along +y, so its heading is yaw − 90°. The car's origin is the middle of its axles, on the
    ground. `steer` is positive to the right, Bullet's to the left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from roadproof.datatypes import Control, VehicleState
from roadproof.simulators.town.engine import Node, Path, bullet, core
from roadproof.simulators.town.meshes import Pose
from roadproof.simulators.town.models import CAR_HALF_M
from roadproof.simulators.town.scenery import Solid
from roadproof.simulators.tracker.judge import HEIGHT_M, TRACK_M, Contact
from roadproof.traffic.agents import CAR_LENGTH_M, CAR_WHEELBASE_M, CAR_WIDTH_M, MAX_STEER_RAD

WHEEL_RADIUS_M = 0.33
MASS_KG = 1500.0
STEER_RATE_RAD_S = 2.5
TRACTION_N, POWER_W = 6500.0, 95_000.0
ROLLING_N, DRAG_N_S2_PER_M2 = 220.0, 0.42
BRAKING_MPS2 = 8.0
SUBSTEP_S = 0.01
SETTLE_STEPS = 60
TOUCH_M = 0.02
TOUCHABLE_M = 40.0
BLOCK_M = 30.0


class Physics:
    """One drive: a car on flat ground among solid things and moving cars.

    Args:
        solids: the things that stand about and can be hit.
        start: pose and speed of the driven car.
        cars: poses of the other cars.
    """

    def __init__(self, solids: Sequence[Solid], start: VehicleState, cars: Sequence[Pose] = ()) -> None:
        self._world = bullet.BulletWorld()
        self._world.set_gravity(core.Vec3(0, 0, -9.81))
        self._root = core.NodePath("physics")
        self._kinds: dict[str, Contact] = {}
        ground = bullet.BulletRigidBodyNode("ground")
        ground.add_shape(bullet.BulletPlaneShape(core.Vec3(0, 0, 1), 0))
        ground.set_friction(1.0)
        self._place(ground)
        self._blocks: dict[tuple[int, int], list[int]] = {}
        for i, solid in enumerate(solids):
            self._blocks.setdefault(_block(solid.pose.x_m, solid.pose.y_m), []).append(i)
        self._solids = tuple(solids)
        self._near: dict[tuple[int, int], Path] = {}
        self._parts: dict[str, list[Contact]] = {}
        self._surround(start.x_m, start.y_m)
        self._cars: list[Path] = []
        self._stands = np.zeros((0, 2))
        self.replace_cars(cars)
        self._chassis, self._path, self._vehicle = self._make_car(start)
        self._steer_rad = 0.0
        self._settle(start)

    def step(self, control: Control, dt_s: float) -> None:
        """Drive on by a whole number of substeps."""
        count = max(1, round(dt_s / SUBSTEP_S))
        wanted, reach = -control.steer * MAX_STEER_RAD, STEER_RATE_RAD_S * count * SUBSTEP_S
        self._steer_rad += min(max(wanted - self._steer_rad, -reach), reach)
        position = self._path.get_pos()
        self._surround(position.x, position.y)
        self._drive(control)
        self._advance(count)

    def replace_cars(self, cars: Sequence[Pose]) -> None:
        """Put others in the place of the other cars; afterwards `move_cars` moves as many."""
        for path in self._cars:
            self._world.remove(path.node())
            path.remove_node()
        self._cars.clear()
        for i, pose in enumerate(cars):
            node = self._box(f"car-{i}", CAR_HALF_M, HEIGHT_M)
            node.set_kinematic(True)
            self._kinds[node.get_name()] = Contact("vehicle", f"car {i}")
            self._cars.append(self._place(node))
            self._stand(self._cars[-1], pose, HEIGHT_M)
        self._stands = np.array([(pose.x_m, pose.y_m) for pose in cars]).reshape(-1, 2)

    def move_cars(self, places: Float[np.ndarray, "n 3"]) -> None:
        """Put the other cars where they are now: x, y, yaw. What is far off and stays so is not moved: nobody sees."""
        position = self._path.get_pos()
        here, reach = (position.x, position.y), TOUCHABLE_M * TOUCHABLE_M
        near = ((places[:, :2] - here) ** 2).sum(axis=1) < reach
        near |= ((self._stands - here) ** 2).sum(axis=1) < reach
        self._stands[near] = places[near, :2]
        for i in np.flatnonzero(near).tolist():
            x, y, yaw = places[i].tolist()
            self._cars[i].set_pos_hpr(x, y, HEIGHT_M / 2, math.degrees(yaw), 0.0, 0.0)

    def state(self) -> VehicleState:
        """Pose and forward speed of the driven car."""
        position, forward = self._path.get_pos(), self._path.get_quat().get_forward()
        velocity = self._chassis.get_linear_velocity()
        flat = math.hypot(forward.x, forward.y)
        speed = (velocity.x * forward.x + velocity.y * forward.y) / max(flat, 1e-6)
        return VehicleState(position.x, position.y, 0.0, math.atan2(forward.y, forward.x), speed)

    def contacts(self) -> list[Contact]:
        """What the car touches now, the ground aside, in order of name."""
        found: set[Contact] = set()
        node: Node
        part: int
        for contact in self._world.contact_test(self._chassis).get_contacts():
            if contact.get_manifold_point().get_distance() > TOUCH_M:
                continue
            for node, part in (
                (contact.get_node0(), contact.get_idx0()),
                (contact.get_node1(), contact.get_idx1()),
            ):
                if node.get_name() in self._parts:
                    found.add(self._parts[node.get_name()][part])
                elif node.get_name() in self._kinds:
                    found.add(self._kinds[node.get_name()])
        return sorted(found, key=lambda contact: contact.name)

    def close(self) -> None:
        """Take everything out of the physics world."""
        self._world.remove(self._vehicle)
        for body in self._world.get_rigid_bodies():
            self._world.remove(body)
        self._root.remove_node()

    def _surround(self, x_m: float, y_m: float) -> None:
        """Keep the solids of the blocks around the car in the world: Bullet's time grows with all there is."""
        column, row = _block(x_m, y_m)
        wanted = {(column + i, row + j) for i in (-1, 0, 1) for j in (-1, 0, 1)} & self._blocks.keys()
        if wanted == self._near.keys():
            return
        for key in sorted(self._near.keys() - wanted):
            path = self._near.pop(key)
            self._world.remove(path.node())
            path.remove_node()
        for key in sorted(wanted - self._near.keys()):
            name = f"block {key[0]} {key[1]}"
            block = bullet.BulletRigidBodyNode(name)
            for solid in (self._solids[i] for i in self._blocks[key]):
                middle = core.Vec3(solid.pose.x_m, solid.pose.y_m, solid.pose.z_m + solid.height_m / 2)
                turn = core.Vec3(math.degrees(solid.pose.yaw_rad), 0.0, 0.0)
                half = core.Vec3(solid.half_m[0], solid.half_m[1], solid.height_m / 2)
                block.add_shape(bullet.BulletBoxShape(half), core.TransformState.make_pos_hpr(middle, turn))
            self._parts[name] = [
                Contact("static", self._solids[i].thing or f"{self._solids[i].name} {i}") for i in self._blocks[key]
            ]
            self._near[key] = self._place(block)

    def _place(self, node: Node) -> Path:
        self._world.attach(node)
        return self._root.attach_new_node(node)

    def _box(self, name: str, half_m: tuple[float, float], height_m: float) -> Node:
        node = bullet.BulletRigidBodyNode(name)
        node.add_shape(bullet.BulletBoxShape(core.Vec3(half_m[0], half_m[1], height_m / 2)))
        return node

    def _stand(self, path: Path, pose: Pose, height_m: float) -> None:
        path.set_pos_hpr(pose.x_m, pose.y_m, pose.z_m + height_m / 2, math.degrees(pose.yaw_rad), 0.0, 0.0)

    def _make_car(self, start: VehicleState) -> tuple[Node, Path, Node]:
        chassis = bullet.BulletRigidBodyNode("ego")
        chassis.set_mass(MASS_KG)
        shape = bullet.BulletBoxShape(core.Vec3(CAR_WIDTH_M / 2, CAR_LENGTH_M / 2, 0.5))
        chassis.add_shape(shape, core.TransformState.make_pos(core.Vec3(0, 0, 0.75)))
        chassis.set_deactivation_enabled(False)
        path = self._place(chassis)
        path.set_pos_hpr(start.x_m, start.y_m, 0.05, math.degrees(start.yaw_rad) - 90.0, 0.0, 0.0)
        vehicle = bullet.BulletVehicle(self._world, chassis)
        vehicle.set_coordinate_system(bullet.ZUp)
        self._world.attach(vehicle)
        for y in (CAR_WHEELBASE_M / 2, -CAR_WHEELBASE_M / 2):
            for x in (-TRACK_M / 2, TRACK_M / 2):
                wheel = vehicle.create_wheel()
                wheel.set_chassis_connection_point_cs(core.Point3(x, y, 0.55))
                wheel.set_front_wheel(y > 0)
                wheel.set_wheel_direction_cs(core.Vec3(0, 0, -1))
                wheel.set_wheel_axle_cs(core.Vec3(1, 0, 0))
                wheel.set_wheel_radius(WHEEL_RADIUS_M)
                wheel.set_max_suspension_travel_cm(30.0)
                wheel.set_suspension_stiffness(45.0)
                wheel.set_wheels_damping_relaxation(3.2)
                wheel.set_wheels_damping_compression(4.4)
                wheel.set_friction_slip(2.2)
                wheel.set_roll_influence(0.08)
        return chassis, path, vehicle

    def _settle(self, start: VehicleState) -> None:
        """Let the springs come to rest, then start exactly where and as fast as asked."""
        for _ in range(SETTLE_STEPS):
            self._drive(Control(0.0, brake=1.0))
            self._advance(1)
        height = self._path.get_z()
        yaw = start.yaw_rad
        self._path.set_pos_hpr(start.x_m, start.y_m, height, math.degrees(yaw) - 90.0, 0.0, 0.0)
        self._chassis.set_angular_velocity(core.Vec3(0))
        along = core.Vec3(math.cos(yaw) * start.speed_mps, math.sin(yaw) * start.speed_mps, 0.0)
        self._chassis.set_linear_velocity(along)

    def _advance(self, substeps: int) -> None:
        # A little more than the whole, so that rounding never leaves a substep for the next call.
        self._world.do_physics(substeps * SUBSTEP_S * (1 + 1e-6), substeps, SUBSTEP_S)

    def _drive(self, control: Control) -> None:
        """Set the wheels: rear drive with a power limit, all brakes, rolling and air drag."""
        velocity = self._chassis.get_linear_velocity()
        speed = math.hypot(velocity.x, velocity.y)
        force = control.throttle * min(TRACTION_N, POWER_W / max(speed, 1.0))
        degrees = math.degrees(self._steer_rad)
        # Bullet's brake is an impulse per wheel and substep.
        brake = control.brake * BRAKING_MPS2 * MASS_KG * SUBSTEP_S / 4
        for wheel in (0, 1):
            self._vehicle.set_steering_value(degrees, wheel)
        for wheel in (2, 3):
            self._vehicle.apply_engine_force(force / 2, wheel)
        for wheel in range(4):
            self._vehicle.set_brake(brake, wheel)
        if speed > 0.1:
            drag = (ROLLING_N + DRAG_N_S2_PER_M2 * speed * speed) / speed
            self._chassis.apply_central_force(core.Vec3(-velocity.x * drag, -velocity.y * drag, 0.0))


def _block(x_m: float, y_m: float) -> tuple[int, int]:
    return math.floor(x_m / BLOCK_M), math.floor(y_m / BLOCK_M)
