"""Lanes joined into long tracks and laid out flat, so that many agents can be placed at once."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float, Int

from roadproof.roads.polylines import interpolated
from roadproof.roads.roadmap import RoadMap

SPACING_M = 0.5
SIDE_FORCE_MPS2 = 2.2


class Tracks:
    """Lanes of a kind, joined where one way leads on.

    Attributes:
        length_m: length of each track.
        successors: for each track, the tracks that go on from its end.
        predecessors: for each track, the tracks that lead to its start.
        junction: for each track, the id of the junction that it crosses, or None.
        place: for the index of each lane, its track and where on the track the lane starts, in metres.
    """

    def __init__(self, road_map: RoadMap, kind: str) -> None:
        lanes = {lane.index: lane for lane in road_map.lanes if lane.kind == kind}
        after = {i: [k for k in lane.successors if k in lanes] for i, lane in lanes.items()}
        before: dict[int, list[int]] = {i: [] for i in lanes}
        for i, others in after.items():
            for k in others:
                before[k].append(i)

        def goes_on(i: int) -> bool:
            """Whether the lane has one successor that belongs on the same track."""
            return (
                len(after[i]) == 1
                and len(before[after[i][0]]) == 1
                and (kind != "driving" or lanes[after[i][0]].junction == lanes[i].junction)
            )

        self.chains: list[list[int]] = []
        left = dict.fromkeys(lanes)
        starts = [i for i in lanes if not any(goes_on(k) for k in before[i])]
        while left:
            chain = [starts.pop(0) if starts else next(iter(left))]
            del left[chain[0]]
            while goes_on(chain[-1]) and after[chain[-1]][0] in left:
                chain.append(after[chain[-1]][0])
                del left[chain[-1]]
            self.chains.append(chain)
        first = {chain[0]: t for t, chain in enumerate(self.chains)}
        self.successors = [tuple(first[k] for k in after[chain[-1]]) for chain in self.chains]
        self.predecessors: list[tuple[int, ...]] = [() for _ in self.chains]
        for t, others in enumerate(self.successors):
            for k in others:
                self.predecessors[k] = (*self.predecessors[k], t)
        self.junction = [lanes[chain[0]].junction for chain in self.chains]
        self.place: dict[int, tuple[int, float]] = {}
        lines = [self._joined(road_map, t) for t in range(len(self.chains))]
        self.length_m: Float[np.ndarray, " t"] = np.array([line[-1, 0] for line in lines])
        self._lay_out(lines)

    def _joined(self, road_map: RoadMap, track: int) -> Float[np.ndarray, "n 3"]:
        """Station, x and y along a track."""
        at = 0.0
        parts: list[Float[np.ndarray, "_ 3"]] = []
        for index in self.chains[track]:
            lane = road_map.lanes[index]
            self.place[index] = (track, at)
            parts.append(np.column_stack([lane.stations_m + at, lane.centre[:, :2]]))
            at += lane.length_m
        line = np.concatenate(parts)
        return line[np.concatenate([[True], np.diff(line[:, 0]) > 1e-6])]

    def _lay_out(self, lines: list[Float[np.ndarray, "_ 3"]]) -> None:
        counts = [max(2, math.ceil(line[-1, 0] / SPACING_M) + 1) for line in lines]
        self._first: Int[np.ndarray, " t"] = np.cumsum([0, *counts])[:-1]
        self._per_m = (np.array(counts) - 1) / np.maximum(self.length_m, 1e-6)
        self._last = np.array(counts) - 2
        stations: list[Float[np.ndarray, " _"]] = [
            np.linspace(0.0, float(line[-1, 0]), n) for line, n in zip(lines, counts, strict=True)
        ]
        points = [interpolated(s, line[:, 0], line[:, 1:]) for s, line in zip(stations, lines, strict=True)]
        # A map may have no lanes of a kind.
        self._x, self._y = np.concatenate([np.empty((0, 2)), *points]).T.copy()
        yaws: list[Float[np.ndarray, " _"]] = []
        limits: list[Float[np.ndarray, " _"]] = []
        for first, n, s in zip(self._first.tolist(), counts, stations, strict=True):
            x, y = self._x[first : first + n], self._y[first : first + n]
            yaw = np.unwrap(np.arctan2(np.gradient(y), np.gradient(x)))
            curvature = np.abs(np.gradient(yaw, s)) if n > 2 and s[-1] > 1e-3 else np.zeros(n)
            yaws.append(yaw)
            limits.append(np.sqrt(SIDE_FORCE_MPS2 / np.maximum(curvature, 1e-3)))
        self._yaw: Float[np.ndarray, " p"] = np.concatenate([np.empty(0), *yaws])
        self._limit: Float[np.ndarray, " p"] = np.concatenate([np.empty(0), *limits])

    def _cells(
        self, track: Int[np.ndarray, "*n"], s_m: Float[np.ndarray, "*n"]
    ) -> tuple[Int[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
        at = s_m * self._per_m[track]
        cell = np.minimum(np.maximum(at, 0.0).astype(np.intp), self._last[track])
        return self._first[track] + cell, at - cell

    def points(
        self, track: Int[np.ndarray, "*n"], s_m: Float[np.ndarray, "*n"]
    ) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
        """x, y and the speed a bend allows, at places on tracks; beyond an end the track goes on straight."""
        cell, share = self._cells(track, s_m)
        x, y = self._x[cell], self._y[cell]
        return x + share * (self._x[cell + 1] - x), y + share * (self._y[cell + 1] - y), self._limit[cell]

    def yaws(self, track: Int[np.ndarray, "*n"], s_m: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Direction of travel at places on tracks."""
        cell, share = self._cells(track, s_m)
        return self._yaw[cell] + np.clip(share, 0.0, 1.0) * (self._yaw[cell + 1] - self._yaw[cell])

    def lane_at(self, track: int, s_m: float) -> tuple[int, float]:
        """The lane at a place on a track, and how far along it."""
        for index in reversed(self.chains[track]):
            at = self.place[index][1]
            if s_m >= at:
                return index, s_m - at
        return self.chains[track][0], 0.0

    def conflicts(self, clear_m: float) -> Bool[np.ndarray, "t t"]:
        """Whether two tracks that cross the same junction, from different arms, come nearer than `clear_m`."""
        count = len(self.chains)
        conflict = np.zeros((count, count), dtype=bool)
        lines = [
            np.stack([self._x[first : first + last + 2], self._y[first : first + last + 2]], axis=1)
            for first, last in zip(self._first.tolist(), self._last.tolist(), strict=True)
        ]
        for a in range(count):
            for b in range(a):
                if self.junction[a] is None or self.junction[a] != self.junction[b]:
                    continue
                if set(self.predecessors[a]) & set(self.predecessors[b]):
                    continue
                apart = np.linalg.norm(lines[a][:, None] - lines[b][None], axis=2).min()
                conflict[a, b] = conflict[b, a] = apart < clear_m
        return conflict
