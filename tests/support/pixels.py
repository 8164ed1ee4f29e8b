"""Pixels of a canvas for the kernels that paint rectangles, and what plain operations paint there."""

import numpy as np
import torch

from roadproof.compositing.composite import blend
from roadproof.compositing.view import CanvasPixels
from roadproof.coverage import FOOTPRINT_VARIANCE, Footprints
from roadproof.patterns import coverages, visibilities
from roadproof.photometry import AffineResponse


def some_pixels(many, own=None, seed=0, device="cpu"):
    """Pixels all over the canvas, near and far; `own` patterns have some of their own each."""
    rng = np.random.default_rng(seed)
    rows = () if own is None else (own,)
    centre = rng.uniform(-5, 405, (*rows, many, 2))
    jacobian = rng.normal(size=(*rows, many, 2, 2)) * rng.uniform(0.5, 20, (*rows, many, 1, 1))
    made = Footprints.made(torch.tensor(centre).float(), torch.tensor(jacobian).float(), FOOTPRINT_VARIANCE["area"])
    parts = (part if own is None else part[:, None] for part in (made.centre, made.jacobian, made.features))
    clean, gain, bias = (torch.tensor(rng.uniform(low, 1, (*rows, many, 3))).float() for low in (0, 0.3, -0.8))
    response = AffineResponse(torch.eye(3) * 1.2, torch.full((3,), -0.1))
    return CanvasPixels(
        footprints=Footprints(*(part.to(device) for part in parts), made.variance),
        clean=clean.to(device),
        gain=gain.to(device),
        bias=bias.to(device),
        response=response,
    )


def both(paint, pixels, unit, space):
    """Colours and gradients in the points, by a kernel and by plain operations."""
    found = []
    for each in (
        paint,
        lambda pattern, here: blend(
            visibilities(coverages(pattern, here.footprints)), here.response(pattern.colours), here
        ),
    ):
        leaf = unit.clone().requires_grad_()
        colours = each(space.pattern(leaf), pixels)
        weight = torch.randn(colours.shape, generator=torch.Generator().manual_seed(1)).to(unit.device)
        found.append((colours.detach(), torch.autograd.grad((colours * weight).sum(), leaf)[0]))
    return found
