# Commands of a batch; see __init__.pyi.

from carla import ActorBlueprint, Transform, Vector3D, VehicleControl

class Command: ...
class _Future: ...

FutureActor: _Future

class Response:
    actor_id: int
    error: str

class SpawnActor(Command):
    def __init__(self, blueprint: ActorBlueprint, transform: Transform) -> None: ...
    def then(self, command: Command) -> SpawnActor: ...

class DestroyActor(Command):
    def __init__(self, actor: int) -> None: ...

class ApplyVehicleControl(Command):
    def __init__(self, actor_id: int, control: VehicleControl) -> None: ...

class ApplyTransform(Command):
    def __init__(self, actor_id: int, transform: Transform) -> None: ...

class ApplyTargetVelocity(Command):
    def __init__(self, actor_id: int, velocity: Vector3D) -> None: ...

class SetSimulatePhysics(Command):
    def __init__(self, actor: int | _Future, enabled: bool) -> None: ...
