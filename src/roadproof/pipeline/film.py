"""Two drives side by side, without and with paint: a film small enough for a page, and pictures of the passage."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import TypeAlias, cast

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from roadproof.datatypes import Observation
from roadproof.driving.deviation import beside_m, passage, path_of
from roadproof.driving.drive_store import load_episodes
from roadproof.driving.episode import Episode
from roadproof.driving.rollout import look_again
from roadproof.errors import EpisodeError
from roadproof.geometry import CanvasPlacement
from roadproof.io.files import write_atomically
from roadproof.io.records import RecordFile, Saved
from roadproof.io.video import can_film, film_file
from roadproof.processes import Pool, open_or_here
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import PatternImage, Simulator

FILM, POSTER, STRIP = "film.mp4", "film.jpg", "strip.npz"
MOST_BYTES = 4_500_000
"""The film may be so large: in base64 it is a third more, which makes a page of about 6 MB."""
QUALITIES = (26, 30, 34, 38)

VIEW = (640, 480)
PICTURE_S = 0.1
"""Time from one picture of the film to the next: drawing them takes most of its time."""

CAPTION_PX = 96
MOMENTS = 25
"""Pictures of a passage: enough to move through it, a picture every third step or so."""

STRIP_SIZE = (400, 300)
FILMED_M = 14.0
"""Distance before the canvas at which the first picture is taken; the last is taken at the canvas' end."""

EVENT_SHOWN_S = 3.0
STANDS_MPS = 0.1
INK, PAPER, FAINT, CLEAN, PAINTED = (30, 33, 38), (250, 249, 246), (110, 114, 120), (36, 92, 168), (184, 58, 26)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Strip(Saved):
    """Pictures of one passage over the canvas, at the same instants of both drives.

    Args:
        time_s: time of each picture since the start, seconds, (n,).
        lateral_m: distance of the painted drive beside the clean path at each picture, metres, left positive, (n,).
        clean: camera pictures of the drive over the bare road, (n, height, width, 3).
        painted: camera pictures of the drive over the paint, (n, height, width, 3).

    Raises:
        EpisodeError: there are not as many of all, there is none, or a number is not finite.
    """

    time_s: Float[np.ndarray, " n"]
    lateral_m: Float[np.ndarray, " n"]
    clean: UInt8[np.ndarray, "n height width 3"]
    painted: UInt8[np.ndarray, "n height width 3"]

    def __post_init__(self) -> None:
        counts = {len(self.time_s), len(self.lateral_m), len(self.clean), len(self.painted)}
        if len(counts) > 1 or not len(self.time_s):
            raise EpisodeError("the strip has not one picture of each drive at each time, or none at all")
        if not (np.isfinite(self.time_s).all() and np.isfinite(self.lateral_m).all()):
            raise EpisodeError("the strip has times or distances that are not finite")


Strip.FILE = RecordFile(kind=Strip, header=None, error=EpisodeError, remedy="evaluate again", level=1)


@dataclass(frozen=True, slots=True, eq=False)
class _Side:
    """One of the two drives: its title, colour and episode, and its camera pictures as JPEG, a tenth of the memory.

    There is a picture of the first of `shown` steps, of every `each`-th after it, and of those of the strip.
    """

    title: str
    colour: tuple[int, int, int]
    episode: Episode
    each: int
    shown: int
    pictures: Mapping[int, bytes]

    def picture(self, step: int) -> Image.Image:
        """The picture of a step; after the last picture, that one stays."""
        taken = self.pictures.get(step) or self.pictures[max(self.pictures)]
        return Image.open(io.BytesIO(taken)).convert("RGB")

    def told(self, step: int) -> int:
        """The step whose state is told beside the picture: with the last picture, that of the last step."""
        return step if step + self.each < self.shown else self.shown - 1


def forget_film(folder: Path) -> None:
    """Take away the film, poster and strip of a folder, which are of other drives; there may be none."""
    for name in (FILM, POSTER, STRIP):
        (folder / name).unlink(missing_ok=True)


def film_drives(
    simulator: Simulator,
    start: Scenario,
    files: tuple[str, str],
    paint: PatternImage,
    folder: Path,
    *,
    pool: Pool[Simulator] | None = None,
) -> bool:
    """Drive two judged drives again, with the camera's full pictures, and keep film, poster and strip.

    The drives are replayed from their controls, so they are the judged ones.

    Args:
        simulator: an open simulator of the kind that drove them.
        start: their scenario, with the start that they had.
        files: the names of the files of the drive without paint and of the one with it.
        paint: picture of the canvas as it was painted.
        folder: the folder of those files, which gets film.mp4, film.jpg and strip.npz.
        pool: processes that are open already and drive instead.

    Returns:
        Whether there is a film; without PyAV (extra `video`) there are poster and strip alone.

    Raises:
        OutputError: the folder cannot be written.
    """
    clean, painted = load_episodes(folder, files)
    (folder / FILM).unlink(missing_ok=True)  # perhaps of other drives
    predicted = ", predicted" if painted.paint.predicted else ""
    last = min(len(clean), len(painted)) - 1
    steps = sorted(set(passage_steps(clean, painted, start.canvas, MOMENTS)))
    takes: list[_Take] = [
        (f"without paint{predicted}", CLEAN, clean, None),
        (f"with paint{predicted}", PAINTED, painted, paint),
    ]
    with open_or_here(pool, simulator) as driving:
        taken = {side.colour: side for _, side in driving.each(partial(_filmed, start, steps), takes)}
    sides = taken[CLEAN], taken[PAINTED]
    beside = beside_m(clean, painted)
    each = sides[0].each
    bare, driven = (
        np.stack([np.asarray(side.picture(k).resize(STRIP_SIZE, Image.Resampling.LANCZOS)) for k in steps])
        for side in sides
    )
    Strip(time_s=painted.time_s[steps], lateral_m=beside[steps], clean=bare, painted=driven).save(folder / STRIP)
    poster = _page(sides, beside, int(np.abs(beside[: last + 1]).argmax()) // each * each)
    write_atomically(folder / POSTER, lambda part: poster.save(part, format="JPEG", quality=82))
    if not can_film():
        return False
    for quality in QUALITIES:
        film = film_file(folder / FILM, poster.size, each * clean.dt_s, quality=quality)
        with film as add, ThreadPoolExecutor(1) as encoding:
            added = encoding.submit(lambda: None)
            for step in range(0, max(side.shown for side in sides), each):
                page = np.asarray(_page(sides, beside, step))
                # One image is drawn while the one before is encoded.
                added.result()
                added = encoding.submit(add, page)
            added.result()
        if (folder / FILM).stat().st_size <= MOST_BYTES:
            break
    return True


def pictures_at(
    simulator: Simulator,
    episode: Episode,
    start: Scenario,
    steps: Sequence[int],
    size_px: tuple[int, int],
    *,
    pattern: PatternImage | None = None,
) -> UInt8[np.ndarray, "n h w 3"]:
    """The camera's pictures of a judged drive, of (width, height) px, at those of the steps that come before its end.

    The drive is replayed from its controls, in its scenario with the start that it had.
    """
    look = partial(_resized, size_px)
    kept = look_again(simulator, episode, start, steps, look, pattern=pattern, full_pictures=True)
    return np.stack([kept[step] for step in steps if step in kept])


def _resized(size_px: tuple[int, int], seen: Observation) -> UInt8[np.ndarray, "h w 3"]:
    return np.asarray(Image.fromarray(seen.shown).resize(size_px, Image.Resampling.LANCZOS))


def passage_steps(clean: Episode, painted: Episode, canvas: CanvasPlacement, count: int) -> list[int]:
    """Steps evenly spread over the clean drive's passage, from `FILMED_M` on, as far as the other is beside it."""
    seen, last = passage(path_of(clean), canvas, horizon_m=FILMED_M), len(beside_m(clean, painted)) - 1
    first, end = min(seen.start, last), min(seen.stop - 1, last)
    return [round(first + (end - first) * k / (count - 1)) for k in range(count)]


_Take: TypeAlias = tuple[str, tuple[int, int, int], Episode, PatternImage | None]
"""What is to be filmed: a title, its colour, the drive and its paint."""


def _filmed(start: Scenario, strip: Sequence[int], simulator: Simulator, take: _Take) -> _Side:
    """A drive again, with the camera's pictures at the film's steps and at those of the strip.

    A car that stands for good, at a rail until its time is up, say, is shown for a moment only.
    """
    title, colour, episode, paint = take
    moving = np.flatnonzero(episode.speed_mps > STANDS_MPS)
    enough = min(int(moving[-1]) + 1 + round(EVENT_SHOWN_S / episode.dt_s), len(episode)) if moving.size else 1
    each = max(1, round(PICTURE_S / episode.dt_s))
    steps = (*range(0, enough, each), *(step for step in strip if step < enough))
    kept = look_again(simulator, episode, start, steps, _as_jpeg, pattern=paint, full_pictures=True)
    return _Side(title, colour, episode, each, enough, kept)


def _as_jpeg(seen: Observation) -> bytes:
    file = io.BytesIO()
    Image.fromarray(seen.shown).resize(VIEW, Image.Resampling.BILINEAR).save(file, format="JPEG", quality=92)
    return file.getvalue()


def _page(sides: tuple[_Side, _Side], offset_m: Float[np.ndarray, " n"], step: int) -> Image.Image:
    """One image of the film, with both drives side by side; the offset is told as far as it is known."""
    large, small = _font(26), _font(19)
    page = Image.new("RGB", (2 * VIEW[0], VIEW[1] + CAPTION_PX), PAPER)
    pen = ImageDraw.Draw(page)
    for left, side in zip((0, VIEW[0]), sides, strict=True):
        k, episode = side.told(step), side.episode
        page.paste(side.picture(step), (left, CAPTION_PX))
        pen.rectangle((left, CAPTION_PX - 6, left + VIEW[0], CAPTION_PX - 1), fill=side.colour)
        pen.text((left + 20, 12), side.title, side.colour, large)
        known = left and k < len(offset_m)
        beside = f"{abs(offset_m[k]):.2f} m to the {'left' if offset_m[k] > 0 else 'right'}" if known else ""
        state = f"{abs(3.6 * episode.speed_mps[k]):.0f} km/h   {episode.time_s[k]:.1f} s   {beside}"
        pen.text((left + 20, 50), state, INK, small)
        event, fresh = last_event(episode, k, side.shown)
        pen.text((left + VIEW[0] - 20, 14), event, PAINTED if fresh else FAINT, large, anchor="ra")
    pen.line((VIEW[0], 0, VIEW[0], page.height), PAPER, 3)
    return page


@cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    return cast("ImageFont.FreeTypeFont", ImageFont.load_default(size))


def last_event(episode: Episode, step: int, shown: int) -> tuple[str, bool]:
    """What a drive's caption says at a step.

    Args:
        episode: episode of the drive.
        step: number of the step, counted from the drive's start.
        shown: number of the drive's steps that the film shows.

    Returns:
        An event of the last three seconds, and True; else, with the last picture, how the drive ends, and False; else
        nothing, and False.
    """
    now_s = float(episode.time_s[step])
    for event in reversed(episode.events):
        if 0 <= now_s - event.time_s < EVENT_SHOWN_S:
            return event.kind.replace("-", " "), True
    if step < shown - 1:
        return "", False
    if shown == len(episode):
        return str(episode.ending), False
    return f"stands: {episode.ending} after {episode.time_s[-1]:.0f} s", False
