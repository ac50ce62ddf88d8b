"""What files may contain: JSON that is read strictly, and schemas whose violations are errors in one line.

A schema is a type: a TypedDict, a frozen dataclass, ``list[...]``, with numbers from the names below. Entries that it
does not name are ignored, so that files with notes of their own, or of a later foretrace, can be read.
"""

import json
import re
import sys
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar, is_typeddict

import msgspec
from msgspec import Meta

from foretrace.errors import ForetraceError, shown

LARGEST = sys.float_info.max
MOST = 2**53
"""Largest whole number that every reader of JSON keeps exactly."""
Finite = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
"""A number, neither NaN nor infinite."""
Positive = Annotated[float, Meta(gt=0, le=LARGEST)]
"""A finite number above 0."""
Count = Annotated[int, Meta(ge=0, le=MOST)]
"""A whole number from 0 on."""
# Lists of fixed length, not tuples: msgspec 0.23 confuses their length with the limits of a number in the same union.
Vector2 = Annotated[list[Finite], Meta(min_length=2, max_length=2)]
Vector3 = Annotated[list[Finite], Meta(min_length=3, max_length=3)]
Vector4 = Annotated[list[Finite], Meta(min_length=4, max_length=4)]
Pose = Annotated[list[Finite], Meta(min_length=7, max_length=7)]
"""Position [m] and quaternion (w, x, y, z)."""
Transform = Annotated[list[Vector4], Meta(min_length=4, max_length=4)]
"""A 4 x 4 matrix."""

T = TypeVar("T")
_WORDS = {
    "float": "a finite number",
    "int": "a whole number",
    "bool": "true or false",
    "str": "a text",
    "array": "a list",
    "object": "an object",
    "null": "null",
}
_LIMITS = {
    " of length >= ": " of at least ",
    " of length <= ": " of at most ",
    " >= ": " from ",
    " <= ": " up to ",
    " > ": " above ",
    " < ": " below ",
}


def parse_json(text: str) -> Any:
    """The content of a JSON text, without what JSON does not have or means twice.

    Raises:
        ValueError: It is no JSON; it holds NaN, infinity or a number that is too large, an entry twice, half a
            character, or brackets nested too deep.
    """
    suspect = False

    def number(digits: str) -> float:
        nonlocal suspect
        value = float(digits)  # infinite if there are too many digits
        suspect |= not -LARGEST <= value <= LARGEST
        return value

    def whole(digits: str) -> int | float:
        return int(digits) if len(digits) < 300 else number(digits)

    try:
        content = json.loads(
            text, parse_constant=number, parse_float=number, parse_int=whole, object_pairs_hook=_unique
        )
        if re.search(r"\\u[dD][89a-fA-F]", text):
            json.dumps(content, ensure_ascii=False).encode()
        if suspect and (found := _not_finite(content)):
            raise ValueError(f"{found[0]} is {found[1]}, a finite number is expected")
    except UnicodeEncodeError:
        raise ValueError("it holds half a character, such as \\ud800") from None
    except RecursionError:
        raise ValueError("its brackets are nested too deep") from None
    return content


def _not_finite(content: Any, name: str = "") -> tuple[str, float] | None:
    """Name and value of the first number that is not finite."""
    if isinstance(content, float) and not -LARGEST <= content <= LARGEST:
        return f"entry {name.removeprefix('.')}" if name else "it", content
    entries = content.items() if isinstance(content, dict) else ()
    items = enumerate(content) if isinstance(content, list) else ()
    named = [(f"{name}.{key}", value) for key, value in entries]
    named += [(f"{name}[{k}]", value) for k, value in items]
    return next(filter(None, (_not_finite(value, inner) for inner, value in named)), None)


def conform(
    content: Any, schema: type[T] | Any, where: str, error: type[ForetraceError], remedy: str, entry: str = ""
) -> T:
    """Content, such as of a JSON file, as a schema wants it; that of a TypedDict as it is, whatever else it holds.

    Args:
        content: Plain values: numbers, texts, lists, dictionaries.
        schema: The type that it must have.
        where: Name of the file, or of the thing, for the message.
        error: The class to raise.
        remedy: What to do about it; ends the message.
        entry: Name of the content within the file, for the message.

    Raises:
        ForetraceError: Of the given class, naming the first entry that is missing or another than the schema's.
    """
    try:
        converted = msgspec.convert(content, schema)
    except RecursionError:
        raise error(f"{where}: its lists are nested too deep: {remedy}") from None
    except msgspec.ValidationError as reason:
        text, _, path = str(reason).partition(" - at `")
        a_key = path.startswith("key` in `")
        steps = re.findall(r"\[\.\.\.\]|\[\d+\]|[^.\[\]$`]+", path.removeprefix("key` in `"))
        name, value = _entry(content, [*steps, "[...]"] if a_key else steps, schema)
        value = name.removeprefix(_entry(content, steps, schema)[0]).removeprefix(".") if a_key else value
        name = ".".join(filter(None, (entry, name)))
        if missing := re.search(r"missing required field `(.+)`", text):
            name = ".".join(filter(None, (name, missing[1])))
            raise error(f"{where}: entry {name} is missing: {remedy}") from None
        subject = f"entry {name}" if name else "it"
        raise error(f"{where}: {subject} is {_as_json(value)}, {_expected(text)}: {remedy}") from None
    return content if is_typeddict(schema) else converted


def _entry(content: Any, steps: list[str], schema: Any) -> tuple[str, Any]:
    """Name and value of the entry that a path leads to."""
    name, value = "", content
    for number, step in enumerate(steps):
        if (
            step == "[...]"
        ):  # some value of a mapping: the first with which alone the content does not conform
            key = next((k for k in value if _is_odd(content, steps[:number], k, schema)), None)
            name, value = f"{name}.{key}", value.get(key)
        elif step.startswith("["):
            name, value = f"{name}{step}", value[int(step[1:-1])]
        else:
            name, value = f"{name}.{step}", value[step]
    return name.removeprefix("."), value


def _is_odd(content: Any, steps: list[str], key: str, schema: Any) -> bool:
    def alone(value: Any, rest: list[str]) -> Any:
        if not rest:
            return {key: value[key]}
        step = int(rest[0][1:-1]) if rest[0].startswith("[") else rest[0]
        inner = alone(value[step], rest[1:])
        if isinstance(value, Mapping):
            return {**value, step: inner}
        return [inner if k == step else other for k, other in enumerate(value)]

    try:
        msgspec.convert(alone(content, steps), schema)
    except (msgspec.ValidationError, KeyError, TypeError, ValueError):
        return True
    return False


def _expected(text: str) -> str:
    """The complaint of msgspec in the house's words."""
    if not (found := re.match(r"Expected `([^`]+)`(.*)", text)):
        return "a smaller number is expected" if "range" in text else "another value is expected"
    kinds = " or ".join(_WORDS.get(kind, kind) for kind in found[1].split(" | "))
    rest = found[2].partition(", got")[0]
    if "e+308" in rest:
        rest = ""
    for sign, word in _LIMITS.items():
        rest = rest.replace(sign, word)
    return f"{kinds}{rest} is expected"


def _as_json(value: Any) -> str:
    return json.dumps(value) if value is None or isinstance(value, bool) else shown(value)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"it holds the entry {shown(twice)} twice")
    return found
