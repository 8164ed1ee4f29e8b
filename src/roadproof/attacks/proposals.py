"""How black-box methods choose the next points; the one room that knows their libraries, which are extras.

A proposer gets the trials so far, as points of the unit cube and their values (to be made large), and gives new points.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from jaxtyping import Float

from roadproof.attacks.expected_improvement import most_promising
from roadproof.errors import RoadproofError
from roadproof.search_space import PUBLISHED_BO_LEVELS, SearchSpace, derived_seed

Cube = Float[np.ndarray, "_ d"]
"""Some points of the unit cube."""

Propose: TypeAlias = Callable[[Cube, Float[np.ndarray, " t"], int], Cube]
"""Points tried, their values, how many new ones are wanted; the new points."""

PUBLISHED_ACQUISITION = {"drawn": 100_000, "climbs": 250}
"""How the authors maximise the expected improvement: random points, and runs of L-BFGS-B."""

_CMA_SIGMA = 1 / 6
_CMA_SIGMA_NEAR = 1 / 30


def random(space: SearchSpace, seed: int) -> Propose:
    """Points drawn as the authors draw the starts of their gradient search."""

    def propose(tried: Cube, _: Float[np.ndarray, " t"], count: int) -> Cube:
        return np.concatenate(
            [
                space.random((1,), torch.Generator().manual_seed(derived_seed(seed, len(tried) + i)))
                .flatten(1)
                .double()
                for i in range(count)
            ]
        )

    return propose


def natural_ranges(space: SearchSpace) -> Float[np.ndarray, " d"]:
    """Range of every parameter of a published family in degrees, pixels and colour levels; all begin at 0."""
    colours = (PUBLISHED_BO_LEVELS,) * (len(space.names) - len(space.shape_ranges))
    return np.tile((*space.shape_ranges, *colours), space.figures)


def published_bo(ranges: Float[np.ndarray, " d"], random_calls: int, seed: int) -> Propose:
    """Bayesian optimisation as the authors had it.

    Expected improvement (ξ = 0) of a Gaussian process with one Matérn-5/2 length for all inputs, which are not scaled;
    noise 1e-6, values normalised, 25 restarts of the fit; the improvement is maximised over 100,000 random points and
    250 runs of L-BFGS-B.

    Args:
        ranges: range of each parameter in natural units, all beginning at 0, (D,).
        random_calls: number of points drawn uniformly before the first guided one.
        seed: seed of everything random; the authors' was 42.
    """
    try:
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import Matern
    except ImportError as error:
        raise _missing(error) from None

    def propose(tried: Cube, value: Float[np.ndarray, " t"], count: int) -> Cube:
        if len(tried) < random_calls:
            drawn = np.random.RandomState(seed).uniform(size=(random_calls, len(ranges)))
            return drawn[len(tried) : len(tried) + count]
        state = np.random.RandomState(derived_seed(seed, len(tried)))  # the library takes no other
        process = GaussianProcessRegressor(
            kernel=Matern(nu=2.5), alpha=1e-6, n_restarts_optimizer=25, random_state=state
        )
        with warnings.catch_warnings():
            # The length scale often ends at its bound on inputs that are not scaled; as published.
            warnings.simplefilter("ignore")
            process.fit(tried * ranges, (value - value.mean()) / (value.std() or 1.0))
        return most_promising(process, ranges, state, **PUBLISHED_ACQUISITION)[None] / ranges

    return propose


def optuna(sampler: Literal["gp", "tpe"], dimensions: int, seed: int) -> Propose:
    """Optuna's Gaussian process or tree of Parzen estimators, on inputs scaled to the unit cube."""
    try:
        import optuna as library
    except ImportError as error:
        raise _missing(error) from None
    library.logging.set_verbosity(library.logging.WARNING)
    ranges = {f"p{index:03d}": library.distributions.FloatDistribution(0.0, 1.0) for index in range(dimensions)}

    def propose(tried: Cube, value: Float[np.ndarray, " t"], count: int) -> Cube:
        fresh = derived_seed(seed, len(tried))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # some options of the samplers are marked experimental
            chosen: Any = (
                library.samplers.GPSampler(seed=fresh, deterministic_objective=True)
                if sampler == "gp"
                else library.samplers.TPESampler(seed=fresh, multivariate=True, constant_liar=True)
            )
            study = library.create_study(direction="maximize", sampler=chosen)
            study.add_trials(
                [
                    library.trial.create_trial(
                        params=dict(zip(ranges, map(float, point), strict=True)),
                        distributions=dict(ranges),
                        value=float(found),
                    )
                    for point, found in zip(tried, value, strict=True)
                ]
            )
            asked = [study.ask(dict(ranges)) for _ in range(count)]
        return np.array([[trial.params[name] for name in ranges] for trial in asked])

    return propose


def cma_es(dimensions: int, seed: int, given: int = 0) -> Propose:
    """Covariance matrix adaptation, begun at the centre of the cube with a sixth of its side.

    Args:
        dimensions: number of dimensions of the unit cube.
        seed: seed of the points it draws.
        given: number of first trials that come from another search; if above 0, CMA-ES begins at the best of them with
            a thirtieth of the side.
    """
    try:
        from cmaes import CMA
    except ImportError as error:
        raise _missing(error) from None

    def propose(tried: Cube, value: Float[np.ndarray, " t"], count: int) -> Cube:
        bounds = np.tile([0.0, 1.0], (dimensions, 1))
        middle = tried[value[:given].argmax()] if given else np.full(dimensions, 0.5)
        sigma = _CMA_SIGMA_NEAR if given else _CMA_SIGMA
        tried, value = tried[given:], value[given:]
        search: Any = CMA(mean=middle, sigma=sigma, bounds=bounds, seed=seed)
        size = search.population_size
        # Its state follows from its seed and the trials: all generations are gone through again, in milliseconds.
        for first in range(0, len(tried) - size + 1, size):
            for _ in range(size):
                search.ask()
            each = slice(first, first + size)
            search.tell(list(zip(tried[each], -value[each], strict=True)))
        for _ in range(len(tried) % size):
            search.ask()
        return np.array([search.ask() for _ in range(count)])

    return propose


def _missing(error: ImportError) -> RoadproofError:
    return RoadproofError(f"this search needs {error.name}; install roadproof[blackbox]")
