"""Fitting a colour transform, and how far to trust it.

A seen value at the end of the scale counts only where the model says it should be visible, so a saturated channel
neither bends the fit nor is forgotten by it. The loss is pseudo-Huber: quadratic for small errors,
linear for large ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from scipy import optimize
from torch import Tensor

from roadproof.errors import ColourError
from roadproof.photometry.responses import (
    SATURATED,
    AffineResponse,
    FilmResponse,
    fit_affine,
    saturated,
)
from roadproof.photometry.samples import ColourSamples, distinct
from roadproof.photometry.transform import ColourTransform, RadialShading, squared_radius

_LARGE = 8 / 255
_FOLDS = 12
_MOST_STEPS = 100
# Logarithms of exposure, contrast and encoding, for pictures encoded twice and once.
_FILM_STARTS = ((-1.5, -1.5, -1.5, 0.4, 0.0), (0.0, 0.0, 0.0, 0.3, 0.9))

FittedKind = type[AffineResponse] | type[FilmResponse]


@dataclass(frozen=True, kw_only=True, slots=True)
class FitReport:
    """How well a colour transform predicts, in 8-bit levels, per sample and channel, after clipping.

    Args:
        model: name of the fitted model: "film" or "affine", with " + radial shading" where that was fitted.
        samples: number of samples it was fitted to.
        residual: mean absolute error on the fitted samples, 8-bit levels.
        left_out: mean absolute error on groups left out of the fit in turn, in at most twelve folds, 8-bit levels; None
            if the rest of the groups does not determine the model.
    """

    model: str
    samples: int
    residual: float
    left_out: float | None


@dataclass(frozen=True, slots=True)
class ColourFit:
    """A fitted colour transform and its report."""

    transform: ColourTransform
    report: FitReport


def fit_colour(
    samples: ColourSamples,
    *,
    response: FittedKind | None = None,
    shading: bool | None = None,
) -> ColourFit:
    """Fit the transform from painted to seen colour; what is not given is chosen by cross-validation.

    Args:
        samples: painted and seen colours.
        response: kind of response to fit; None tries both kinds.
        shading: whether to fit a radial shading, which needs samples with pixels; None tries both if there are pixels.

    Returns:
        The fit with the smallest error on left-out groups or, if that cannot be computed, on the samples.

    Raises:
        ColourError: there are no samples, too few colours, too many saturated, or shading is asked for without pixels.

    References:
        The paper, section on colour (C, b), for the affine response; the rest is our own.
    """
    if not len(samples):
        raise ColourError("no colour samples; paint at least four colours and record them")
    if shading and samples.pixel is None:
        raise ColourError("shading needs to know where each colour was seen; give samples with pixels")
    responses = (FilmResponse, AffineResponse) if response is None else (response,)
    shadings = ((False, True) if samples.pixel is not None else (False,)) if shading is None else (shading,)
    fits = [_fit(samples, kind, shade) for kind in responses for shade in shadings]
    return _best(fits)


def _best(fits: list[ColourFit | ColourError]) -> ColourFit:
    done = [fit for fit in fits if isinstance(fit, ColourFit)]
    if not done:
        raise next(fit for fit in fits if isinstance(fit, ColourError))

    def error(fit: ColourFit) -> tuple[bool, float]:
        return fit.report.left_out is None, fit.report.residual if fit.report.left_out is None else fit.report.left_out

    return min(done, key=error)


def _fit(samples: ColourSamples, kind: FittedKind, shade: bool) -> ColourFit | ColourError:
    try:
        parameters = _solve(samples, kind, shade)
    except ColourError as error:
        return error
    transform = _transform(parameters, samples, kind, shade)
    left_out = _left_out_errors(samples, kind, shade, start=parameters)
    report = FitReport(
        model=("film" if kind is FilmResponse else "affine") + (" + radial shading" if shade else ""),
        samples=len(samples),
        residual=float(_errors(transform, samples).mean()),
        left_out=None if left_out is None else float(left_out.mean()),
    )
    return ColourFit(transform, report)


def _left_out_errors(samples: ColourSamples, kind: FittedKind, shade: bool, start: Tensor) -> Tensor | None:
    """Errors of each sample under a fit to the other groups, (N, 3); None if those do not determine the model."""
    errors = torch.zeros_like(samples.seen, dtype=torch.float64)
    fold = samples.groups % _FOLDS
    for left_out in range(min(_FOLDS, int(fold.max()) + 1)):
        out = fold == left_out
        try:
            # From the fit to all samples, a fold needs a few steps only.
            parameters = _solve(samples.at(~out), kind, shade, start)
        except ColourError:
            return None
        errors[out] = _errors(_transform(parameters, samples, kind, shade), samples.at(out))
    return errors


def _errors(transform: ColourTransform, samples: ColourSamples) -> Float[Tensor, "n 3"]:
    """Absolute errors of the predicted colours in 8-bit levels."""
    pixel = torch.zeros(len(samples), 2, dtype=torch.float64) if samples.pixel is None else samples.pixel
    return 255 * (transform(samples.painted.double(), pixel.double()) - samples.seen).abs()


def _solve(samples: ColourSamples, kind: FittedKind, shade: bool, start: Tensor | None = None) -> Tensor:
    """Parameters of the response, then gain and offset of the shading if there is any."""
    painted, seen = samples.painted.double(), samples.seen.double()
    if kind is AffineResponse:
        affine = fit_affine(painted, seen)
        starts = [torch.cat([affine.matrix.reshape(-1), affine.offset])]
        if not shade:
            return starts[0]
    else:
        _check_film(painted, seen)
        starts = [torch.tensor(values, dtype=torch.float64) for values in _FILM_STARTS]
    if start is not None:
        starts = [start]
    elif shade:
        starts = [torch.cat([values, torch.zeros(2)]) for values in starts]
    problem = _ColourProblem(samples, kind, shade)

    def residuals(at: Float[np.ndarray, " p"]) -> Float[np.ndarray, " n"]:
        return problem.residuals(torch.tensor(at)).numpy()

    def jacobian(at: Float[np.ndarray, " p"]) -> Float[np.ndarray, "n p"]:
        return problem.jacobian(torch.tensor(at)).numpy()

    solve = cast("Any", optimize).least_squares
    ends = [solve(residuals, begin, jacobian, x_scale="jac", max_nfev=_MOST_STEPS) for begin in starts]
    return torch.tensor(min(ends, key=lambda end: end.cost).x)


class _ColourProblem:
    """Differences of predicted and seen colours, made robust and one-sided where the seen value is saturated."""

    def __init__(self, samples: ColourSamples, kind: FittedKind, shade: bool) -> None:
        self._response = kind.from_parameters
        self._colours, self._which = distinct(samples.painted.double())
        self._seen = samples.seen.double()
        self._dark, self._bright = self._seen <= SATURATED, self._seen >= 1 - SATURATED
        self._shade = shade
        self._at = _shading_feature(samples) if shade else torch.zeros(len(samples), 1, dtype=torch.float64)

    def residuals(self, parameters: Float[Tensor, " p"]) -> Float[Tensor, " n"]:
        gain, offset = self._gain_and_offset(parameters)
        return self._robust(gain * self._flat(parameters)[self._which] + offset - self._seen).reshape(-1)

    def jacobian(self, parameters: Float[Tensor, " p"]) -> Float[Tensor, "n p"]:
        leaf = parameters.clone().requires_grad_()
        flat = self._flat(leaf)
        each = torch.eye(flat.numel(), dtype=flat.dtype).reshape(-1, *flat.shape)
        (slope,) = torch.autograd.grad(flat, leaf, each, is_grads_batched=True)
        gain, offset = self._gain_and_offset(parameters)
        seen = flat.detach()[self._which]
        columns = gain[..., None] * slope.reshape(*flat.shape, -1)[self._which]
        if self._shade:
            columns[..., -2], columns[..., -1] = self._at * seen, self._at
        error = (gain * seen + offset - self._seen).requires_grad_()
        (weight,) = torch.autograd.grad(self._robust(error).sum(), error)
        return (weight[..., None] * columns).reshape(-1, len(parameters))

    def _flat(self, parameters: Tensor) -> Tensor:
        return self._response(parameters[:-2] if self._shade else parameters)(self._colours)

    def _gain_and_offset(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        gain, offset = parameters[-2:] if self._shade else (0.0, 0.0)
        return 1 + gain * self._at, offset * self._at

    def _robust(self, error: Tensor) -> Tensor:
        over, under = error.clamp_min(0.0), error.clamp_max(0.0)
        error = torch.where(self._dark, over, torch.where(self._bright, under, error))
        # e ↦ sign(e) √ρ(e) with ρ the pseudo-Huber loss, written so that it is smooth at 0.
        return error * (2 / (1 + (1 + (error / _LARGE).square()).sqrt())).sqrt()


def _transform(parameters: Tensor, samples: ColourSamples, kind: FittedKind, shade: bool) -> ColourTransform:
    if not shade:
        return ColourTransform(kind.from_parameters(parameters))
    assert samples.size_px is not None
    width, height = samples.size_px
    shading = RadialShading(width_px=width, height_px=height, gain=float(parameters[-2]), offset=float(parameters[-1]))
    return ColourTransform(kind.from_parameters(parameters[:-2]), shading)


def _check_film(painted: Tensor, seen: Tensor) -> None:
    usable = len(distinct(painted[(~saturated(seen)).any(1)])[0])
    if usable < 4 or bool(saturated(seen).all(0).any()):
        raise ColourError(
            f"{usable} painted colours are seen unsaturated (a channel at neither 0 nor 255), expected at least 4, and "
            "every channel among them; paint more colours, or colours of middle brightness"
        )


def _shading_feature(samples: ColourSamples) -> Float[Tensor, "n 1"]:
    assert samples.pixel is not None
    assert samples.size_px is not None
    return squared_radius(samples.pixel.double(), *samples.size_px)[:, None]
