"""Parameters of the actions in a table, which are decoded from texts once."""

from functools import lru_cache

import numpy as np
import pyarrow as pa

from foretrace.actions import Action, Tool
from foretrace.schema import parse_json


# The same rows are checked and then asked for their parameters, and the texts of many rows are the same.
@lru_cache(maxsize=1024)
def action_of(action: str, path: str, tool: str) -> Action:
    """The action of that label, with that path and tool, at the origin along x."""
    place = {"contact": (0.0, 0.0), "direction": (1.0, 0.0)}
    return Action.from_dict({"label": action, "path": parse_json(path), "tool": _tool_of(tool), **place})


@lru_cache(maxsize=64)
def _tool_of(text: str) -> Tool:
    return Tool.from_dict(parse_json(text))


def parameter_values(table: pa.Table) -> dict[str, np.ndarray]:
    """Parameters of the actions in a table by name [SI], one number a row; NaN where an action lacks one."""
    kinds = list(zip(*(table[name].to_pylist() for name in ("action", "path", "tool")), strict=True))
    numbers = {kind: k for k, kind in enumerate(dict.fromkeys(kinds))}
    found = [action_of(*kind).parameters() for kind in numbers]
    rows = [numbers[kind] for kind in kinds]
    names = dict.fromkeys(name for parameters in found for name in parameters)
    return {
        name: np.array([parameters.get(name, np.nan) for parameters in found], dtype=float)[rows]
        for name in names
    }
