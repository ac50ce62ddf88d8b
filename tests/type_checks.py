"""Checks of types and shapes of every call into the package, at a fraction of what `jaxtyping.jaxtyped` costs.

That decorator binds each call to the signature, checks the arguments before the call, and once more with the result.
Here beartype checks arguments and result once, in the same context of named axes, and a function is prepared when it
is first called.
"""

import functools
import inspect
import typing
from collections.abc import Callable
from dataclasses import is_dataclass
from types import FunctionType
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype

slow_jaxtyped = jaxtyping.jaxtyped
CONTEXT = slow_jaxtyped("context")
check = beartype(conf=BeartypeConf(violation_type=jaxtyping.TypeCheckError))


def jaxtyped(fn: Any = None, *, typechecker: Any) -> Any:
    """What the import hook of jaxtyping puts on each function and class of the package."""
    if fn is None:
        return functools.partial(jaxtyped, typechecker=typechecker)
    if inspect.isclass(fn):
        if is_dataclass(fn) and not hasattr(fn.__init__, "types_are_checked"):
            fn.__init__ = checked(fn.__init__)
        return fn
    annotations = list(inspect.get_annotations(fn).values())
    if not annotations:
        return fn
    # Axes named by an argument's value need the bound call; generators run after their context has ended.
    by_value = any("{" in str(annotation) for annotation in annotations)
    if by_value or fn.__code__.co_flags & (
        inspect.CO_GENERATOR | inspect.CO_COROUTINE | inspect.CO_ASYNC_GENERATOR
    ):
        return slow_jaxtyped(fn, typechecker=typechecker)
    return checked(fn)


def checked(fn: FunctionType) -> Callable:
    """The function with its arguments and its result checked."""
    prepared, has_axes = None, False

    @functools.wraps(fn)
    def wrapper(*args, **kwargs):
        __tracebackhide__ = True
        nonlocal prepared, has_axes
        if jaxtyping.config.jaxtyping_disable:
            return fn(*args, **kwargs)
        if prepared is None:
            resolved = with_resolved_annotations(fn)
            has_axes = any("jaxtyping" in str(each) for each in resolved.__annotations__.values())
            prepared = check(resolved)
        if not has_axes:
            return prepared(*args, **kwargs)
        with CONTEXT:
            return prepared(*args, **kwargs)

    wrapper.types_are_checked = True
    return wrapper


def with_resolved_annotations(fn: FunctionType) -> FunctionType:
    """A copy whose annotations are no strings; those that only a type checker can resolve allow anything."""
    copy = FunctionType(fn.__code__, fn.__globals__, fn.__name__, fn.__defaults__, fn.__closure__)
    copy.__kwdefaults__, copy.__qualname__, copy.__module__ = (
        fn.__kwdefaults__,
        fn.__qualname__,
        fn.__module__,
    )
    copy.__annotations__ = {
        name: resolved(annotation, fn.__globals__) for name, annotation in inspect.get_annotations(fn).items()
    }
    return copy


def resolved(annotation: Any, names: dict[str, Any]) -> Any:
    def fn(): ...

    fn.__annotations__ = {"value": annotation}
    try:
        return typing.get_type_hints(fn, names, include_extras=True)["value"]
    except Exception:  # whatever keeps a name from being found
        return Any


def install() -> None:
    """The package's modules that are imported from now on are checked this way."""
    jaxtyping.jaxtyped = jaxtyped
