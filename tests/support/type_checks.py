"""The checks of types and shapes that all tests run under.

jaxtyping remembers what every name in a shape stands for during a call. A function without shapes has nothing to
remember, and beartype alone checks its types in a fraction of the time. What a drive calls thousands of times is
checked in its first calls of every test, since the later ones are alike.
"""

import dataclasses
import functools
import inspect
from typing import get_args

import jaxtyping
from beartype import beartype
from beartype.roar import BeartypeDecorHintException

CHECKED_CALLS = 20
"""Of every function, in every test."""

_with_shapes = jaxtyping.jaxtyped
_test = 0


def install():
    """Check every annotated function and dataclass of roadproof that is imported from now on."""
    # The import hook puts this name before each of them.
    jaxtyping.jaxtyped = _checked
    jaxtyping.install_import_hook("roadproof", "beartype.beartype")


def begin_test():
    """Check the first calls of every function again."""
    global _test
    _test += 1


def _checked(*, typechecker):
    def check(found):
        if inspect.isfunction(found):
            return _at_first(found, _checked_function(found, typechecker))
        if dataclasses.is_dataclass(found) and "__init__" in vars(found):
            found.__init__ = _at_first(found.__init__, _checked_function(found.__init__, typechecker))
            return found
        return _with_shapes(found, typechecker=typechecker)

    return check


def _at_first(function, checked):
    during, calls = -1, 0

    @functools.wraps(function)
    def call(*positional, **named):
        nonlocal during, calls
        if during != _test:
            during, calls = _test, 0
        calls += 1
        return (checked if calls <= CHECKED_CALLS else function)(*positional, **named)

    # A failure in a controller of someone else's is told with the last of the files that it went through.
    call.__code__ = call.__code__.replace(co_filename="<type checks>")
    return call


def _checked_function(function, typechecker):
    # A class is not there yet while its methods are made.
    itself = dict.fromkeys(function.__qualname__.split(".")[:-1], object)
    try:
        hints = inspect.get_annotations(function, locals=itself, eval_str=True)
        if not any(map(_is_shape, hints.values())):
            return beartype(function)
    except (NameError, AttributeError, TypeError, BeartypeDecorHintException):
        # A name that only type checkers see: jaxtyping leaves it out, and checks the others.
        pass
    return _with_shapes(function, typechecker=typechecker)


def _is_shape(hint):
    if isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray):
        return True
    return any(map(_is_shape, get_args(hint)))
