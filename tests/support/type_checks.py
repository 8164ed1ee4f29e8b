"""The checks of types and shapes that all tests run under.

jaxtyping remembers what every name in a shape stands for during a call. A function without shapes has nothing to
remember, and beartype alone checks its types in a fraction of the time.
"""

import dataclasses
import inspect
import re
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
        if inspect.isfunction(found) and not _names_a_shape(found):
            return _types_alone(found, typechecker)
        if dataclasses.is_dataclass(found) and "__init__" in vars(found) and not _names_a_shape(found.__init__):
            found.__init__ = _types_alone(found.__init__, typechecker)
            return found
        return _with_shapes(found, typechecker=typechecker)

    return check


def _types_alone(function, typechecker):
    try:
        return beartype(function)
    except BeartypeDecorHintException:
        # An annotation that only type checkers understand: jaxtyping checks the others.
        return _with_shapes(function, typechecker=typechecker)


def _names_a_shape(function):
    words = re.findall(r"\w+", " ".join(map(str, inspect.get_annotations(function).values())))
    return any(_is_shape(function.__globals__.get(word)) for word in words)


def _is_shape(found):
    if isinstance(found, type) and issubclass(found, jaxtyping.AbstractArray | jaxtyping.AbstractDtype):
        return True
    return any(_is_shape(each) for each in get_args(found))
