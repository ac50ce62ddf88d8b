"""Damage to files: each change is a few plain values, chosen by hypothesis and applied in the trial's process."""

import json
import random
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

RAW: dict[str, str] = {
    "nan": "NaN",
    "inf": "Infinity",
    "-inf": "-Infinity",
    "overflow": "1e999",
    "huge": "1e308",
    "1e200": "1e200",
    "tiny": "1e-320",
    "digits": "9" * 5000,
    "deep": "[" * 100_000 + "]" * 100_000,
    "deep objects": '{"a":' * 3000 + "1" + "}" * 3000,
    "null": "null",
    "true": "true",
    "zero": "0",
    "minus": "-1",
    "half": "0.5",
    "2**63": "9223372036854775808",
    "-2**63": "-9223372036854775809",
    "many": "1000000000",
    "empty": '""',
    "word": '"x"',
    "number as text": '"1.0"',
    "long": '"' + "x" * 100_000 + '"',
    "path": '"../../../../etc/passwd"',
    "zero byte": '"a\\u0000b"',
    "surrogate": '"\\ud800"',
    "list": "[]",
    "object": "{}",
    "nulls": "[null, null]",
    "nested": "[[1, 2], [3]]",
    "lists": "[[[1.0]]]",
    "one": "[1]",
}
"""JSON that stands in place of a value."""
TOKENS = (
    *("nan", "inf", "-inf", "1e999", "1e308", "1e200", "0", "-1", "x", "", "1,5", "1;5", "9" * 5000),
    *("--", "1_0", "\u0663", "0x1", "#"),
)
"""Words that stand in place of a word of a text."""
TEXT_OPERATIONS = ("word", "drop line", "double line", "swap lines", "header", "semicolons", "tabs", "join")
BYTE_OPERATIONS = (
    *("cut", "flip", "zeros", "insert", "drop", "swap"),
    *("bom", "utf-16", "empty", "crlf", "noise", "repeat"),
)
SHARE = st.integers(0, 9999)
"""Where in a file, in ten thousandths of it."""


def json_changes() -> st.SearchStrategy[list[Any]]:
    """A value of a JSON file is replaced, removed, or swapped with another one."""
    return st.one_of(
        st.tuples(st.just("set"), SHARE, st.sampled_from(sorted(RAW))),
        st.tuples(st.just("remove"), SHARE),
        st.tuples(st.just("exchange"), SHARE, SHARE),
        st.tuples(st.just("add"), SHARE, st.sampled_from(sorted(RAW))),
    ).map(list)


def text_changes() -> st.SearchStrategy[list[Any]]:
    """Words and lines of a text are replaced, lost, or out of order."""
    return st.tuples(st.sampled_from(TEXT_OPERATIONS), SHARE, st.integers(0, len(TOKENS) - 1)).map(list)


def byte_changes() -> st.SearchStrategy[list[Any]]:
    """Bytes are cut off, flipped, lost, or another encoding."""
    return st.tuples(st.sampled_from(BYTE_OPERATIONS), SHARE, st.integers(0, 2**16)).map(list)


def changes(kind: str) -> st.SearchStrategy[list[list[Any]]]:
    """One to three changes of a file of a kind: ``json``, ``text`` or ``bytes``."""
    own = {"json": json_changes, "text": text_changes, "bytes": byte_changes}[kind]
    one = own() if kind == "bytes" else st.one_of(own(), own(), own(), byte_changes())
    return st.lists(one, min_size=1, max_size=3)


def apply(file: Path, kind: str, made: list[list[Any]]) -> None:
    """Change a file."""
    content = file.read_bytes()
    for name, *values in made:
        if name in BYTE_OPERATIONS:
            content = _change_bytes(content, name, *values)
        elif kind == "json":
            content = _change_json(content, name, *values)
        else:
            content = _change_text(content, name, *values)
    file.write_bytes(content)


def _change_json(content: bytes, name: str, share: int, value: Any = None) -> bytes:
    try:
        tree = json.loads(content)
    except (ValueError, RecursionError):
        return content
    places = list(_places(tree))
    if not places:
        return content
    holder, key = places[share * len(places) // 10_000]
    mark = "@@changed@@"
    raw = RAW.get(value, "") if isinstance(value, str) else ""
    if name == "set":
        holder[key] = mark
    elif name == "remove":
        del holder[key]
    elif name == "exchange":
        other, its = places[value * len(places) // 10_000]
        holder[key], other[its] = json.loads(json.dumps([other[its], holder[key]]))
    elif isinstance(holder, list):
        holder.append(mark)
    else:
        holder["added"] = mark
    return json.dumps(tree).replace(f'"{mark}"', raw).encode()


def _places(tree: Any) -> Any:
    """Every place in a tree, as its holder and key."""
    if isinstance(tree, dict | list):
        for key in tree if isinstance(tree, dict) else range(len(tree)):
            yield tree, key
            yield from _places(tree[key])


def _change_text(content: bytes, name: str, share: int, number: int) -> bytes:
    lines = content.decode("latin-1").splitlines()
    if not lines:
        return content
    at = share * len(lines) // 10_000
    if name == "word":
        words = lines[at].replace(",", " , ").split()
        if words:
            words[(share * 7919) % len(words)] = TOKENS[number]
        lines[at] = " ".join(words).replace(" , ", ",")
    elif name == "drop line":
        del lines[at]
    elif name == "double line":
        lines.insert(at, lines[at])
    elif name == "swap lines":
        other = number % len(lines)
        lines[at], lines[other] = lines[other], lines[at]
    elif name == "header":
        lines.insert(0, "x;y")
    elif name == "semicolons":
        lines = [line.replace(".", ",").replace(" ", ";") for line in lines]
    elif name == "tabs":
        lines = [line.replace(",", "\t").replace(" ", "\t") for line in lines]
    else:
        lines[at] = lines[at] * 3
    return "\n".join([*lines, ""]).encode("utf-8", "replace")


def _change_bytes(content: bytes, name: str, share: int, number: int) -> bytes:
    rng = random.Random(number)
    at = share * len(content) // 10_000
    length = 1 + rng.randrange(1 + len(content) // 4)
    if name == "flip" and content:
        changed = bytearray(content)
        for _ in range(rng.randint(1, 8)):
            changed[rng.randrange(min(len(content), 256) if number % 2 else len(content))] ^= (
                1 << rng.randrange(8)
            )
        return bytes(changed)
    if name == "crlf":
        return content.replace(b"\n", b"\r\n")
    if name == "utf-16":
        return content.decode("latin-1").encode("utf-16")
    rest = {
        "cut": content[:at],
        "zeros": content[:at] + bytes(length) + content[at + length :],
        "insert": content[:at] + rng.randbytes(length % 64) + content[at:],
        "drop": content[:at] + content[at + length :],
        "swap": content[at:] + content[:at],
        "bom": b"\xef\xbb\xbf" + content,
        "empty": b"",
        "noise": content[:at] + rng.randbytes(min(length, 4096)) + content[at + length :],
        "repeat": content[:at] + content[:length] + content[at:],
    }
    return rest.get(name, content)
