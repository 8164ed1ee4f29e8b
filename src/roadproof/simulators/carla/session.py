"""One connection to a CARLA server: every call has a time limit, and what is changed is put back.

A call that finds no answer ends the session: the server may have stepped or not, so nothing that follows would mean
anything.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from jaxtyping import UInt8

from roadproof.errors import ScenarioError, SimulatorError
from roadproof.roads.roadmap import RoadMap

try:
    import carla
except ImportError as error:  # pragma: no cover - the extra is installed where this is tested
    raise SimulatorError("CARLA needs its client, which is not installed: pip install 'roadproof[carla]'") from error

FAREWELL_S = 2.0

Result = TypeVar("Result")


class Session:
    """A connection in synchronous mode.

    Args:
        host: name or address of the server.
        port: the server's port for calls.
        dt_s: simulated seconds per step.
        patience_s: longest wait for a call and for a picture, seconds.
        loading_s: longest wait where a map is loaded or the weather changes, seconds.

    Attributes:
        where: HOST:PORT of the server.
        lost: whether a call found no answer, or the session is closed.
        painted: whether objects have textures that are not the map's own.
        found: the world's settings and weather before anything was changed, which are put back.

    Raises:
        SimulatorError: no server answers there, or it is one of another version.
    """

    def __init__(self, host: str, port: int, *, dt_s: float, patience_s: float, loading_s: float) -> None:
        self.where, self.patience_s, self._loading_s = f"{host}:{port}", patience_s, loading_s
        self.lost = False
        self.painted = False
        self._last_paint: tuple[list[str], UInt8[np.ndarray, "h w 3"]] | None = None
        self._texture: tuple[carla.TextureColor, UInt8[np.ndarray, "h w 3"]] | None = None
        self._actors: list[carla.Actor | int] = []
        self._maps: dict[str, RoadMap] = {}
        self.client = self.ask("a connection", lambda: carla.Client(host, port, worker_threads=1))
        self.client.set_timeout(patience_s)
        self._check_version()
        self.world = self.ask("its world", self.client.get_world)
        self.found = self.ask("its settings", self.world.get_settings), self.ask("its weather", self.world.get_weather)
        self._weather_changed = False
        self._dt_s = dt_s
        try:
            self._synchronise()
        except SimulatorError:
            self.close()
            raise

    def ask(self, what: str, call: Callable[[], Result]) -> Result:
        """The answer to a call.

        Raises:
            SimulatorError: no answer came in time, or the server refused.
        """
        if self.lost:
            raise SimulatorError(f"the connection to the CARLA server at {self.where} is lost; open it again")
        try:
            return call()
        except RuntimeError as error:
            text = " ".join(str(error).split())
            if "time-out" not in text:
                raise SimulatorError(f"the CARLA server at {self.where} refused {what}: {text}") from None
            self.lost = True
            raise SimulatorError(
                f"the CARLA server at {self.where} did not answer for {what} in time; check that it runs, that host "
                "and port are right, and that no other client holds it in synchronous mode"
            ) from None

    def patiently(self, what: str, call: Callable[[], Result]) -> Result:
        """The answer to a call that may take as long as loading a map, of a server that is there now."""
        self.ask("its version", self.client.get_server_version)
        self.client.set_timeout(self._loading_s)
        try:
            return self.ask(what, call)
        finally:
            self.client.set_timeout(self.patience_s)

    def tick(self) -> int:
        """Take a step, and return the number of its frame."""
        return self.ask("a tick", self.world.tick)

    def map_name(self) -> str:
        """The name of the map that is loaded, without its path."""
        return Path(self.ask("its map", self.world.get_map).name).name

    def road_map(self, name: str) -> RoadMap:
        """The map of this name, loaded if another one is; read from the server's own OpenDRIVE.

        Raises:
            ScenarioError: the server has no such map, or it cannot be read.
        """
        if self.map_name() != name:
            self._load(name)
        if name not in self._maps:
            text = self.ask("its map", self.world.get_map).to_opendrive()
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "map.xodr"
                path.write_text(text, encoding="utf-8")
                self._maps[name] = RoadMap.from_opendrive(path)
        return self._maps[name]

    def reload(self) -> None:
        """Load the map anew: whatever was painted is as it was, and all actors are gone."""
        self.clear()
        self.world = self.patiently("its map", lambda: self.client.reload_world(False))
        self._synchronise()
        self.painted, self._last_paint = False, None

    def set_weather(self, weather: carla.WeatherParameters) -> None:
        """Have the server show a weather."""
        self._weather_changed = True
        self.patiently("the weather", lambda: self.world.set_weather(weather))
        # Setting it gives no answer; asking for it does, once it is set.
        self.patiently("the weather", self.world.get_weather)

    def library(self) -> carla.BlueprintLibrary:
        """The blueprints of everything that can be spawned."""
        return self.ask("its blueprints", self.world.get_blueprint_library)

    def paint(self, names: Sequence[str], picture: UInt8[np.ndarray, "h w 3"]) -> None:
        """Put a picture on objects until the map is loaded anew; the server says nothing of what it cannot paint."""
        wanted = list(names)
        last = self._last_paint
        if last is not None and last[0] == wanted and np.array_equal(last[1], picture):
            return
        texture = self._textured(picture)
        self.painted, self._last_paint = True, None
        self.patiently(
            "a texture",
            lambda: self.world.apply_color_texture_to_objects(wanted, carla.MaterialParameter.Diffuse, texture),
        )
        self._last_paint = wanted, picture

    def _textured(self, picture: UInt8[np.ndarray, "h w 3"]) -> carla.TextureColor:
        """A picture as the client takes it: a pixel at a time, so those that are as before are left."""
        if self._texture is None or self._texture[1].shape != picture.shape:
            height, width = picture.shape[:2]
            texture, changed = carla.TextureColor(width, height), np.ones((height, width), bool)
        else:
            texture, before = self._texture
            changed = (picture != before).any(axis=-1)
        put = carla.Color(0, 0, 0, 255)
        rows, columns = np.nonzero(changed)
        for row, column, (put.r, put.g, put.b) in zip(
            rows.tolist(), columns.tolist(), picture[changed].tolist(), strict=True
        ):
            texture.set(column, row, put)
        self._texture = texture, picture.copy()
        return texture

    def keep(self, *actors: carla.Actor | int) -> None:
        """Keep actors, or those of these ids, until the end of the drive, which destroys them."""
        self._actors.extend(actors)

    def batch(self, what: str, commands: Sequence[carla.command.Command]) -> list[int]:
        """Send commands, and return the ids of their actors.

        Raises:
            SimulatorError: a command is refused; the actors that the others made are destroyed again.
        """
        # Never with a tick: the client waits for it with the interpreter's lock held, and what brings the tick may
        # wait for that lock, as when a picture comes or a sensor that was stopped is forgotten.
        answers = self.ask(what, lambda: self.client.apply_batch_sync(list(commands), False))
        refused = next((answer.error for answer in answers if answer.error), None)
        if refused is not None:
            pairs = zip(commands, answers, strict=True)
            made = [
                answer.actor_id
                for command, answer in pairs
                if isinstance(command, carla.command.SpawnActor) and not answer.error
            ]
            self.ask(what, lambda: self.client.apply_batch_sync([carla.command.DestroyActor(i) for i in made], False))
            raise SimulatorError(f"the CARLA server at {self.where} refused {what}: {refused}")
        return [answer.actor_id for answer in answers]

    def clear(self) -> None:
        """Destroy the actors of the last drive."""
        commands = self._farewells()
        if commands:
            self.batch("the end of a drive", commands)

    def close(self) -> None:
        """Destroy what is left, load a painted map anew and put weather and settings back.

        A server that does not answer is told so too, without a wait: it does as told if it ever goes on.
        """
        self.lost, lost = False, self.lost
        commands = self._farewells()
        with contextlib.suppress(SimulatorError):
            if lost:
                self.client.set_timeout(FAREWELL_S)
                self.ask("the end of a drive", lambda: self.client.apply_batch(commands))
            elif commands:
                self.batch("the end of a drive", commands)
        with contextlib.suppress(SimulatorError):
            if self.painted and not lost:
                self.reload()
        settings, weather = self.found
        self.lost, lost = False, lost or self.lost
        with contextlib.suppress(SimulatorError):
            if self._weather_changed and lost:
                self.ask("the weather", lambda: self.world.set_weather(weather))
            elif self._weather_changed:
                self.set_weather(weather)
        self.lost = False
        with contextlib.suppress(SimulatorError):
            self.ask("its settings", lambda: self.world.apply_settings(settings))
        self.lost = True

    def _farewells(self) -> list[carla.command.Command]:
        """Commands that destroy all actors; sensors no longer listen."""
        actors, self._actors = self._actors, []
        for actor in actors:
            # One that is gone raises; all others and the settings come after it.
            with contextlib.suppress(RuntimeError):
                if isinstance(actor, carla.Sensor) and actor.is_listening:
                    actor.stop()
        ids = [actor if isinstance(actor, int) else actor.id for actor in reversed(actors)]
        return [carla.command.DestroyActor(i) for i in ids]

    def _load(self, name: str) -> None:
        maps = [Path(path).name for path in self.ask("its maps", self.client.get_available_maps)]
        if name not in maps:
            raise ScenarioError(
                f"the CARLA server at {self.where} has no map {name!r}, expected one of {', '.join(sorted(maps))}"
            )
        self.clear()
        self.world = self.patiently(f"the map {name}", lambda: self.client.load_world(name, False))
        self.painted, self._last_paint = False, None
        self._synchronise()

    def _synchronise(self) -> None:
        settings = self.ask("its settings", self.world.get_settings)
        settings.synchronous_mode, settings.fixed_delta_seconds = True, self._dt_s
        settings.no_rendering_mode = False
        self.ask("synchronous mode", lambda: self.world.apply_settings(settings))

    def _check_version(self) -> None:
        own = importlib.metadata.version("carla")
        theirs = self.version = self.ask("its version", self.client.get_server_version)
        if theirs.split("-")[0].split(".")[:3] != own.split("-")[0].split(".")[:3]:
            raise SimulatorError(
                f"the CARLA server at {self.where} is version {theirs}, its client here is {own}; install the "
                f"client of the server: pip install carla=={theirs.split('-')[0]}"
            )
