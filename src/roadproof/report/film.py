"""Two drives side by side, without and with paint: a film small enough for a page, and pictures of the passage."""

from __future__ import annotations

import importlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from roadproof.datatypes import Control, Observation
from roadproof.driving.deviation import lateral_m, passage
from roadproof.driving.drive_store import load_episodes
from roadproof.driving.episode import Episode
from roadproof.driving.evaluation import Evaluation, path_of
from roadproof.driving.rollout import replay, rollout
from roadproof.io.arrays import write_archive
from roadproof.io.files import write_atomically
from roadproof.report.words import in_words
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import PatternImage, Simulator

FILM, POSTER, STRIP = "film.mp4", "film.jpg", "strip.npz"
MOST_BYTES = 4_500_000
"""In base64 a third more: a page of about 6 MB."""

VIEW = (640, 480)
CAPTION_PX = 96
STRIP_COLUMNS = 6
STRIP_SIZE = (400, 300)
STRIP_HORIZON_M = 14.0
EVENT_SHOWN_S = 3.0
STANDS_MPS = 0.1
INK, PAPER, FAINT, CLEAN, PAINTED = (30, 33, 38), (250, 249, 246), (110, 114, 120), (36, 92, 168), (184, 58, 26)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Strip:
    """Pictures of one passage over the canvas at the same instants of both drives.

    Args:
        time_s: of each.
        lateral_m: of the painted drive beside the clean path, left positive.
        clean: camera pictures without paint.
        painted: with it.
    """

    time_s: Float[np.ndarray, " n"]
    lateral_m: Float[np.ndarray, " n"]
    clean: UInt8[np.ndarray, "n h w 3"]
    painted: UInt8[np.ndarray, "n h w 3"]

    def save(self, path: Path) -> None:
        """Write one NumPy archive.

        Raises:
            OutputError: it cannot be written.
        """
        write_archive(path, {name: getattr(self, name) for name in self.__slots__})


def film_trial(simulator: Simulator, evaluation: Evaluation, paint: PatternImage, folder: Path) -> bool:
    """Drive the shown trial's two drives again, with the camera's full pictures, and keep film, poster and strip.

    The drives are replayed from their controls, so they are the judged ones.

    Args:
        simulator: an open one, as evaluated in.
        evaluation: what was judged.
        paint: what was painted.
        folder: of the evaluation.

    Returns:
        Whether there is a film; without PyAV (extra `video`) there are poster and strip alone.

    Raises:
        OutputError: the folder cannot be written.
    """
    trial = evaluation.shown()
    clean, painted = load_episodes(folder, (trial.clean, trial.painted))
    begun = evaluation.shown().start.of(evaluation.scenario)
    bare = _pictures(simulator, begun, clean, None)
    driven = _pictures(simulator, begun, painted, paint)
    beside = lateral_m(path_of(clean), path_of(painted))
    seen = passage(path_of(clean), evaluation.scenario.canvas, horizon_m=STRIP_HORIZON_M)
    last = min(len(clean), len(painted)) - 1
    first, end = min(seen.start, last), min(seen.stop - 1, last)
    steps: list[int] = sorted({round(first + (end - first) * k / (STRIP_COLUMNS - 1)) for k in range(STRIP_COLUMNS)})
    Strip(
        time_s=painted.time_s[steps],
        lateral_m=beside[steps],
        clean=_reduced([_shown(bare, k) for k in steps]),
        painted=_reduced([_shown(driven, k) for k in steps]),
    ).save(folder / STRIP)
    pages = _Pages(clean, painted, beside, bare, driven)
    middle = int(np.abs(beside[: last + 1]).argmax())
    write_atomically(folder / POSTER, lambda part: pages.page(middle).save(part, format="JPEG", quality=82))
    try:
        av: Any = importlib.import_module("av")
    except ImportError:
        return False
    rate = Fraction(1 / clean.dt_s).limit_denominator(1000)
    write_atomically(folder / FILM, lambda part: _encode(av, part, pages, rate))
    return True


def _pictures(simulator: Simulator, scenario: Scenario, episode: Episode, paint: PatternImage | None) -> list[bytes]:
    """The camera's pictures of a drive as JPEG, which is a tenth of the memory.

    A car that stands for good, at a rail until its time is up, say, is shown for a moment only.
    """
    kept: list[bytes] = []
    moving = np.flatnonzero(episode.speed_mps > STANDS_MPS)
    enough = int(moving[-1]) + 1 + round(EVENT_SHOWN_S / episode.dt_s) if moving.size else 1

    def keep(seen: Observation, _: Control | None) -> None:
        picture = Image.fromarray(seen.shown)
        file = io.BytesIO()
        picture.resize(VIEW, Image.Resampling.LANCZOS).save(file, format="JPEG", quality=92)
        kept.append(file.getvalue())

    rollout(
        simulator,
        replay(episode),
        scenario,
        weather=episode.weather,
        pattern=paint,
        cars=episode.cars,
        pedestrians=episode.pedestrians,
        seed=episode.seed,
        full_pictures=True,
        on_step=keep,
        until=lambda _: len(kept) >= enough,
    )
    return kept


def _shown(pictures: Sequence[bytes], step: int) -> bytes:
    """The picture of a step; after the last one, that."""
    return pictures[min(step, len(pictures) - 1)]


def _opened(picture: bytes) -> Image.Image:
    return Image.open(io.BytesIO(picture)).convert("RGB")


def _reduced(pictures: Sequence[bytes]) -> UInt8[np.ndarray, "n h w 3"]:
    reduced: list[np.ndarray] = [
        np.asarray(_opened(picture).resize(STRIP_SIZE, Image.Resampling.LANCZOS)) for picture in pictures
    ]
    return np.stack(reduced)


class _Pages:
    """The film's images, one for each instant of the longer drive."""

    def __init__(
        self,
        clean: Episode,
        painted: Episode,
        beside: Float[np.ndarray, " n"],
        bare: Sequence[bytes],
        driven: Sequence[bytes],
    ) -> None:
        titles = ["without paint", "with paint"]
        if painted.paint.predicted:
            titles = [f"{title}, predicted" for title in titles]
        self._sides = ((clean, bare, titles[0], CLEAN), (painted, driven, titles[1], PAINTED))
        self._beside = beside
        self._fonts = [cast("ImageFont.FreeTypeFont", ImageFont.load_default(size)) for size in (26, 19)]

    def __len__(self) -> int:
        return max(len(pictures) for _, pictures, _, _ in self._sides)

    def page(self, step: int) -> Image.Image:
        page = Image.new("RGB", (2 * VIEW[0], VIEW[1] + CAPTION_PX), PAPER)
        pen = ImageDraw.Draw(page)
        for column, (episode, pictures, title, colour) in enumerate(self._sides):
            left, k = column * VIEW[0], min(step, len(pictures) - 1)
            page.paste(_opened(pictures[k]), (left, CAPTION_PX))
            pen.rectangle((left, CAPTION_PX - 6, left + VIEW[0], CAPTION_PX - 1), fill=colour)
            pen.text((left + 20, 12), title, colour, self._fonts[0])
            beside = (
                f"{abs(self._beside[k]):.2f} m to the {'left' if self._beside[k] > 0 else 'right'}" if column else ""
            )
            words = f"{abs(3.6 * episode.speed_mps[k]):.0f} km/h   {episode.time_s[k]:.1f} s   {beside}"
            pen.text((left + 20, 50), words, INK, self._fonts[1])
            words, fresh = told(episode, k, len(pictures))
            pen.text((left + VIEW[0] - 20, 14), words, PAINTED if fresh else FAINT, self._fonts[0], anchor="ra")
        pen.line((VIEW[0], 0, VIEW[0], page.height), PAPER, 3)
        return page


def told(episode: Episode, step: int, shown: int) -> tuple[str, bool]:
    """What has just happened at a step, and True; or, with the last of the pictures shown, how the drive ends."""
    now_s = float(episode.time_s[step])
    for event in reversed(episode.events):
        if 0 <= now_s - event.time_s < EVENT_SHOWN_S:
            return in_words(event.kind), True
    if step < shown - 1:
        return "", False
    if shown == len(episode):
        return str(episode.ending), False
    return f"stands: {episode.ending} after {episode.time_s[-1]:.0f} s", False


def _encode(av: Any, path: Path, pages: _Pages, rate: Fraction) -> None:  # noqa: ANN401
    """H.264, coarser until the film is small enough."""
    for quality in (26, 30, 34, 38):
        with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
            options = {"crf": str(quality), "threads": "1", "preset": "veryfast"}
            stream = container.add_stream("libx264", rate=rate, options=options)
            stream.width, stream.height, stream.pix_fmt = 2 * VIEW[0], VIEW[1] + CAPTION_PX, "yuv420p"
            for step in range(len(pages)):
                image = av.VideoFrame.from_ndarray(np.asarray(pages.page(step)), "rgb24")
                container.mux(stream.encode(image))
            container.mux(stream.encode())
        if path.stat().st_size <= MOST_BYTES:
            return
