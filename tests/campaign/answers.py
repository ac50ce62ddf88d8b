"""What an answer must be, whatever the input: finite and plausible, or a refusal in one line."""

import re
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from campaign import FAULT, OK, REFUSED, Outcome, one_line
from foretrace.errors import ForetraceError

MOST = 1e12
"""Numbers above are no lengths [m], masses [kg] or pixels of anything that is levered up."""
LEAKS = re.compile(
    r"\[ ?(WARN|ERROR)[: ]|libpng|Corrupt JPEG|Premature end|TIFFRead|Traceback|Fatal Python", re.I
)
"""What libraries print by themselves."""


def judged(call: Callable[[], Any], changed: tuple[str, ...] = ()) -> Outcome:
    """The outcome of a call.

    Args:
        call: Returns the answer.
        changed: Names of the arguments that are not as they should be; a TypeError has to name one of them.
    """
    try:
        answer = call()
    except ForetraceError as error:
        fault = one_line(str(error))
        return (
            Outcome(REFUSED, str(error)[:300])
            if fault is None
            else Outcome(FAULT, f"{fault}: {str(error)[:300]}")
        )
    except TypeError as error:
        named = any(re.search(rf"\b{re.escape(name)}\b", str(error)) for name in changed)
        return Outcome(REFUSED, str(error)[:300]) if named else _fault(error)
    except OSError as error:
        return Outcome(REFUSED, str(error)[:300]) if error.errno else _fault(error)
    except Exception as error:
        return _fault(error)
    odd = next(unsound(answer), None)
    if odd is None:
        return Outcome(OK, f"{type(answer).__name__}")
    return Outcome(FAULT, f"in the answer {odd}")


def leak(output: Path) -> str | None:
    """The first line that a library has printed."""
    lines = output.read_text(errors="replace").splitlines()
    return next((line[:200] for line in lines if LEAKS.search(line)), None)


def _fault(error: Exception) -> Outcome:
    where = [
        f"{Path(frame.filename).name}:{frame.lineno}" for frame in traceback.extract_tb(error.__traceback__)
    ]
    return Outcome(FAULT, f"{type(error).__name__}: {str(error)[:200]!r} at {' < '.join(where[:-4:-1])}")


def unsound(answer: Any, place: str = "", seen: frozenset[int] = frozenset()) -> Iterator[str]:
    """Places in an answer where a number is not finite or absurd.

    Numbers that may be unknown, such as the joints of an arm that was not there, are left out.
    """
    if id(answer) in seen or len(seen) > 8 or place.endswith(UNKNOWN):
        return
    seen |= {id(answer)}
    if isinstance(answer, np.ndarray) and answer.dtype.kind in "fc":
        if not np.isfinite(answer).all():
            yield f"{place or 'array'} has NaN or infinity"
        elif answer.size and np.abs(answer).max() > MOST:
            yield f"{place or 'array'} has {np.abs(answer).max():.3g}"
    elif isinstance(answer, Real) and not isinstance(answer, bool | int):
        if not abs(float(answer)) <= MOST:
            yield f"{place or 'number'} is {answer}"
    elif isinstance(answer, Mapping):
        for name, value in answer.items():
            yield from unsound(value, f"{place}.{name}", seen)
    elif isinstance(answer, list | tuple):
        for k, value in enumerate(answer[:200]):
            yield from unsound(value, f"{place}[{k}]", seen)
    elif is_dataclass(answer) and not isinstance(answer, type):
        for each in fields(answer):
            yield from unsound(getattr(answer, each.name, None), f"{place}.{each.name}", seen)


UNKNOWN = ("joint_trajectory", "joints", "support_points", "slip_index", "fall_index", "horizon")
