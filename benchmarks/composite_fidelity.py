"""How close are composites to what the simulator renders when the paint is really there?

    python benchmarks/composite_fidelity.py DATA --fit 1,2,7,8,13,14,17,18,19,20 --test 5,6,11,12 --json OUT

DATA holds `colour/`: renders of one camera view with the whole canvas painted one colour each (`real/K.png`), what was
painted (`colours.csv`: index, r, g, b), the painted pixels (`painted_mask.png`) and the geometry (`colour.npz`: H_fit).
Colours come in pairs of one hue: indices 2h−1 and 2h. The colour models see the renders named by --fit alone, and the
one reported as chosen is chosen by leaving hues out of those.

Errors are mean absolute ones over paint and channels, in 8-bit levels, of composites rounded to 8 bits. At
the controller's input the paint is every pixel at least half of whose footprint is painted. The bare road beside the
paint comes from the fit renders; beneath the paint it is not known, and taken to be as beside it.
"""

import argparse
import csv
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageFilter

from roadproof.compositing import composite, view_canvas
from roadproof.compositing.published import nearest_canvas_pixels
from roadproof.coverage import Shape
from roadproof.geometry import CANVAS_SIZE_PX, CIL_INPUT, CropResize
from roadproof.io.files import write_json
from roadproof.machine import made_with
from roadproof.patterns import Pattern
from roadproof.photometry import (
    AffineResponse,
    ColourTransform,
    FilmResponse,
    fit_affine,
    fit_colour,
    samples_from_pictures,
)

Composer = Callable[[np.ndarray, CropResize], np.ndarray]


@dataclass(frozen=True)
class Renders:
    """Pictures (N, H, W, 3) of the canvas painted all over, in [0, 1] what was painted (N, 3), and their keys."""

    keys: list[int]
    painted: np.ndarray
    pictures: np.ndarray

    @classmethod
    def read(cls, folder: Path, keys: list[int]) -> "Renders":
        """The renders of a `colour` folder."""
        with (folder / "colours.csv").open() as file:
            rows = {int(row["index"]): [int(row[channel]) for channel in "rgb"] for row in csv.DictReader(file)}
        missing = [key for key in keys if key not in rows or not (folder / "real" / f"{key}.png").is_file()]
        if missing:
            raise SystemExit(f"no colour or render for {missing} in {folder}; it has {sorted(rows)}")
        pictures = [np.asarray(Image.open(folder / "real" / f"{key}.png").convert("RGB")) for key in keys]
        return cls(keys, np.array([rows[key] for key in keys]) / 255, np.stack(pictures))


def fitted_transforms(
    fit: Renders, mask: np.ndarray
) -> tuple[dict[str, ColourTransform], list[dict[str, object]], str]:
    """Colour transforms by name, their cross-validation reports, and the name of the one those choose."""
    samples = samples_from_pictures(
        torch.tensor(fit.painted),
        torch.from_numpy(fit.pictures),
        torch.from_numpy(mask),
        group=(torch.tensor(fit.keys) + 1) // 2,
    )
    transforms: dict[str, ColourTransform] = {}
    reports: list[dict[str, Any]] = []
    for kind, name in ((AffineResponse, "affine"), (FilmResponse, "film")):
        for shading in (False, True):
            result = fit_colour(samples, response=kind, shading=shading)
            transforms["coverage + " + name + (" + shading" if shading else "")] = result.transform
            reports.append(asdict(result.report))
    chosen = min(reports, key=lambda report: report["left_out"] or float("inf"))["model"]
    return transforms, reports, str(chosen)


def ours(transform: ColourTransform, image_from_canvas: np.ndarray, road: np.ndarray) -> Composer:
    """Area coverage and a colour transform."""

    def compose(painted: np.ndarray, view: CropResize) -> np.ndarray:
        seen = view_canvas(view(road)[None].copy(), image_from_canvas[None], view, transform, dtype=torch.float64)
        middle, size = (CANVAS_SIZE_PX - 1) / 2, float(CANVAS_SIZE_PX)
        canvas = torch.tensor([middle, middle, size, size, 0.0], dtype=torch.float64).expand(len(painted), 1, 5)
        frames = composite(Pattern((Shape.RECTANGLE,), canvas, torch.tensor(painted)[:, None]), seen)
        return 255 * frames[:, 0].permute(0, 2, 3, 1).numpy()

    return compose


def published(fit: Renders, inner: np.ndarray, image_from_canvas: np.ndarray, road: np.ndarray) -> Composer:
    """Nearest canvas pixel and one flat affine map, fitted to the means of the renders, as in the released code."""
    means = torch.tensor(fit.pictures[:, inner].mean(1)) / 255
    affine = fit_affine(torch.tensor(fit.painted), means, keep_saturated=True)

    def compose(painted: np.ndarray, view: CropResize) -> np.ndarray:
        on_canvas = nearest_canvas_pixels(image_from_canvas[None], view)[0] < CANVAS_SIZE_PX**2
        flat = np.floor(255 * affine(torch.tensor(painted)).clamp(0, 1).numpy())
        return np.where(on_canvas[..., None], flat[:, None, None], view(road))

    return compose


def floor(fit: Renders, judged: Renders, mask: np.ndarray, road: np.ndarray, *, shaded: bool) -> Composer:
    """What no flat colour, or none with one additive shading for all, can beat: colours taken from the answers."""
    looks = fit.pictures[:, mask].astype(float)
    unsaturated = (looks > 1).mean(1) > 0.98
    shading = (looks - looks.mean(1, keepdims=True)).transpose(1, 0, 2)[:, unsaturated].mean(1)

    def compose(_: np.ndarray, view: CropResize) -> np.ndarray:
        pictures = np.repeat(road[None], len(judged.keys), 0)
        levels = judged.pictures[:, mask].mean(1)[:, None] + shaded * shading[:, None]
        pictures[:, mask] = levels.round().clip(0, 255).astype(np.uint8)
        return np.stack([view(picture) for picture in pictures]).astype(float)

    return compose


def bare_road(fit: Renders, mask: np.ndarray) -> np.ndarray:
    """The picture without paint: the mean render outside the paint, the median colour beside the paint inside it."""
    mean = fit.pictures.mean(0)
    near = np.asarray(Image.fromarray(mask).convert("L").filter(ImageFilter.MaxFilter(13))) > 0
    return np.round(np.where(mask[..., None], np.median(mean[near & ~mask], 0), mean)).astype(np.uint8)


def errors_of(
    methods: dict[str, Composer], judged: Renders, view: CropResize, region: np.ndarray, pictures: Path | None
) -> list[dict[str, object]]:
    """One record a method; optionally a picture of renders, composites and their difference, eightfold."""
    truth = np.stack([view(picture) for picture in judged.pictures]).astype(float)
    resolution = f"{view.width_px}×{view.height_px}"
    records: list[dict[str, object]] = []
    for method, compose in methods.items():
        made = np.round(compose(judged.painted, view).clip(0, 255))
        error = np.abs(made - truth)[:, region].mean(1)
        per_colour = dict(zip(map(str, judged.keys), error.mean(1).round(3).tolist(), strict=True))
        records.append(
            {
                "method": method,
                "resolution": resolution,
                "mae_paint": round(float(error.mean()), 3),
                "mae_channel": error.mean(0).round(3).tolist(),
                "mae_colour": per_colour,
            }
        )
        print(f"  {method:40} {error.mean():6.2f}   worst colour {error.mean(1).max():6.2f}")
        if pictures:
            pictures.mkdir(parents=True, exist_ok=True)
            rows = np.concatenate([truth, made, np.abs(made - truth) * 8 * region[..., None]], 2).clip(0, 255)
            name = "".join(letter if letter.isalnum() else "-" for letter in f"{method} {view.width_px}")
            Image.fromarray(np.concatenate(rows, 0).astype(np.uint8)).save(pictures / f"{name}.png")
    return records


def main() -> None:
    """Fit, composite, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--fit", required=True, help="indices of the renders to fit on, with commas between")
    parser.add_argument("--test", required=True, help="indices of the renders to judge by")
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--pictures", type=Path, help="folder for render | composite | 8 × error")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    folder = arguments.data / "colour"
    fit, test = (
        Renders.read(folder, [int(key) for key in keys.split(",")]) for keys in (arguments.fit, arguments.test)
    )
    if {(key + 1) // 2 for key in fit.keys} & {(key + 1) // 2 for key in test.keys}:
        print("note: --fit and --test share hues; the errors of --test are not those of unseen hues")
    mask, inner = (
        np.asarray(Image.open(folder / name).convert("L")) > 0 for name in ("painted_mask.png", "inner_mask.png")
    )
    with np.load(folder / "colour.npz", allow_pickle=False) as stored:
        image_from_canvas = stored["H_fit"]
    transforms, reports, chosen = fitted_transforms(fit, mask)
    road = bare_road(fit, mask)
    height, width = mask.shape
    whole = CropResize(
        left_px=0, top_px=0, right_px=width, bottom_px=height, width_px=width, height_px=height, resampling="area"
    )
    share = CIL_INPUT(np.repeat(mask[..., None] * np.uint8(255), 3, 2))[..., 0] / 255
    records: list[dict[str, object]] = []
    for view, region in ((whole, mask), (CIL_INPUT, share >= 0.5)):
        for split, judged in (("unseen", test), ("seen", fit)):
            print(f"{view.width_px}×{view.height_px}, {split} colours")
            methods = {"published": published(fit, inner, image_from_canvas, road)}
            methods |= {name: ours(transform, image_from_canvas, road) for name, transform in transforms.items()}
            methods["floor: true mean colour"] = floor(fit, judged, mask, road, shaded=False)
            methods["floor: true mean colour, shared shading"] = floor(fit, judged, mask, road, shaded=True)
            pictures = arguments.pictures if split == "unseen" else None
            found = errors_of(methods, judged, view, region, pictures)
            records += [{"split": split, "paint_pixels": int(region.sum())} | record for record in found]
    result = {
        "benchmark": "composite_fidelity",
        "version": 1,
        "fit": fit.keys,
        "test": test.keys,
        "chosen_by_cross_validation": chosen,
        "cross_validation": reports,
        "transforms": {name: transform.to_dict() for name, transform in transforms.items()},
        "records": records,
        "seed": "none: nothing is drawn at random",
        "device": "cpu",
        "made_with": made_with(),
    }
    write_json(arguments.json, result)


if __name__ == "__main__":
    main()
