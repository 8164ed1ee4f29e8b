"""The checks of types and shapes that all tests run under.

jaxtyping remembers what every name in a shape stands for during a call. A function without shapes has nothing to
remember, and beartype alone checks its types in a fraction of the time.
"""

import dataclasses
import inspect
from typing import get_args

import jaxtyping
from beartype import beartype
from beartype.roar import BeartypeDecorHintException

_with_shapes = jaxtyping.jaxtyped


def install():
    """Check every annotated function and dataclass of roadproof that is imported from now on."""
    # The import hook puts this name before each of them.
    jaxtyping.jaxtyped = _checked
    jaxtyping.install_import_hook("roadproof", "beartype.beartype")


def _checked(*, typechecker):
    def check(found):
        if inspect.isfunction(found):
            return _checked_function(found, typechecker)
        if dataclasses.is_dataclass(found) and "__init__" in vars(found):
            found.__init__ = _checked_function(found.__init__, typechecker)
            return found
        return _with_shapes(found, typechecker=typechecker)

    return check


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
