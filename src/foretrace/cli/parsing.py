"""From the words of a command line to a command that is ready to run, with tyro.

A command is a function. Its parameters are its options, and so are the fields of dataclasses among them; help comes
from docstrings. What all commands have in common is decided here: how options look, and how lists of commands do.
"""

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import partial
from importlib import import_module
from io import StringIO
from pathlib import Path
from shutil import get_terminal_size
from tempfile import TemporaryFile
from textwrap import fill
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_args, get_type_hints

from foretrace.errors import CommandError, shown
from foretrace.urls import as_place, is_url

if TYPE_CHECKING:
    from tyro.constructors import ConstructorRegistry, PrimitiveTypeInfo, StructTypeInfo

Ready = Callable[[], int | None]
"""A command with its options; returns the exit status."""
USAGE = 2
"""Exit status of options that cannot be read."""
ADAPTATIONS = "adaptations"
"""Attribute of a function: how fields of dataclasses among its parameters differ from its options."""
T = TypeVar("T", bound=Callable[..., Any])


@dataclass(frozen=True)
class Command:
    """A command whose module is imported when it is asked for."""

    summary: str
    """What it does, in a line of at most 60 characters."""
    home: str | Callable[[], Callable[..., int | None]]
    """Module and function, as ``foretrace.cli.data:show``; or what makes the function."""
    section: str = ""
    """Heading under which it is listed."""
    varies: bool = False
    """Whether the options depend on other options: the function then makes the command from the words."""
    extras: Sequence[str] = ()
    """Extras that it needs, where these are several."""

    def load(self, words: Sequence[str]) -> Callable[..., int | None]:
        """The command as a function."""
        if not isinstance(self.home, str):
            return self.home()
        module, _, name = self.home.partition(":")
        function = getattr(import_module(module), name)
        return function(words) if self.varies else function


@dataclass(frozen=True)
class Group:
    """Several commands under one name."""

    summary: str
    """What they have in common, in a line of at most 60 characters."""
    commands: Mapping[str, "Entry"] | Callable[[], "Mapping[str, Entry]"]
    """Each by its name within the group; or what makes them, where that takes time."""
    section: str = ""
    """Heading under which it is listed."""
    extras: Sequence[str] = ()
    """Extras that each of them needs, where these are several."""

    @property
    def members(self) -> "Mapping[str, Entry]":
        """Each command by its name within the group."""
        return self.commands() if callable(self.commands) else self.commands


Entry = Command | Group | Callable[..., int | None]
"""A function, or one that is imported later, or several."""


@dataclass(frozen=True)
class Adaptations:
    """How fields of dataclasses differ from the options of a command."""

    left_out: Mapping[type, Sequence[str]] = field(default_factory=dict)
    """Fields that are no options, by class; they keep their defaults."""
    renamed: Mapping[str, str] = field(default_factory=dict)
    """Names of options by those of fields."""


def adapt(*left_out: tuple[type, Sequence[str]], **renamed: str) -> Callable[[T], T]:
    """Mark a command whose options differ from the fields of its dataclasses.

    Args:
        *left_out: Classes, each with names of its fields that are no options; they keep their defaults.
        **renamed: Names of options by those of fields.
    """

    def mark(command: T) -> T:
        setattr(command, ADAPTATIONS, Adaptations(dict(left_out), renamed))
        return command

    return mark


def parse(entries: Mapping[str, Entry], words: Sequence[str], program: str, about: str) -> Ready:
    """The command that words ask for, with its options.

    Args:
        entries: Commands by name.
        words: Name of a command, and its options.
        program: What stands before these words.
        about: What the program does, for its help.

    Raises:
        CommandError: There is no such command, or its options cannot be read.
        SystemExit: Help was asked for and has been printed.
    """
    name, *rest = [*words, ""]
    if name in ("-h", "--help", ""):
        return partial(_list, entries, program, about, 0 if name else 2)
    if name not in entries:
        raise CommandError(f"unknown command {shown(name)}: {_suggest(name, entries)}")
    entry = entries[name]
    if isinstance(entry, Group):
        return parse(entry.members, rest[:-1], f"{program} {name}", entry.summary)
    command = entry.load(rest[:-1]) if isinstance(entry, Command) else entry
    return read_options(command, rest[:-1], f"{program} {name}")


def read_options(command: Callable[..., int | None], words: Sequence[str], program: str) -> Ready:
    """A command with the options in words.

    Raises:
        CommandError: The options cannot be read.
        SystemExit: Help was asked for and has been printed.
    """
    import tyro

    documentation = inspect.getdoc(command) or ""
    told = StringIO()
    try:
        with redirect_stderr(told):
            ready: Any = tyro.cli(
                command,
                prog=program,
                description=_wrap(_clean(documentation.split("\nArgs:\n")[0].strip())),
                args=list(words),
                registry=_registry(getattr(command, ADAPTATIONS, Adaptations())),
                config=(
                    tyro.conf.DisallowNone,
                    tyro.conf.FlagCreatePairsOff,
                    tyro.conf.HelptextFromCommentsOff,
                    tyro.conf.PositionalMetavarFromFieldName,
                ),
            )
    except SystemExit as end:
        if end.code == USAGE and told.getvalue():
            raise CommandError(_in_one_line(told.getvalue(), program)) from None
        raise
    _check_out(ready, documentation.partition("\n    out: ")[2])
    return ready


def _check_out(ready: Any, about: str) -> None:
    """Refuse an --out that cannot be written before the work is done.

    Args:
        ready: The command with its options.
        about: What its documentation says of --out, which begins with "Folder" for a folder; may be empty.

    Raises:
        CommandError: Naming what is in the way.
    """
    given = getattr(ready, "keywords", {})
    places = [given.get("out"), *(getattr(value, "out", None) for value in given.values())]
    for out in (place for place in places if isinstance(place, Path)):
        if is_url(out):
            if about.startswith("Folder or URL"):
                continue
            raise CommandError(
                f"--out {as_place(out, CommandError)} is a URL: name a folder; only `foretrace simulate` writes to URLs"
            )
        if out.is_file() and about.startswith("Folder"):
            raise CommandError(f"--out {out} is a file: name a folder")
        if out.is_dir() and about and not about.startswith("Folder"):
            raise CommandError(f"--out {out} is a folder: name a file")
        there = next(place for place in (out, *out.absolute().parents) if place.exists())
        if there != out and not there.is_dir():
            raise CommandError(f"--out {out} cannot be made: {there} is a file; choose another --out")
        try:
            with TemporaryFile(dir=there) if there.is_dir() else open(there, "ab"):
                pass
        except OSError as reason:
            raise CommandError(
                f"--out {out} cannot be written ({there}: {reason.strerror}): choose another --out"
            ) from None


def _in_one_line(told: str, program: str) -> str:
    """What tyro says in a box with a title, a message, and sections about what was meant and where help is."""
    # The box is drawn with dashes where the output knows no other lines.
    lines = [
        line.strip("\u2502\u256d\u256e\u2570\u256f \n").replace("\u2500", "-")
        for line in told.splitlines()[1:]
    ]
    parted = re.split(r"^-{10,}.*$", "\n".join(lines), flags=re.MULTILINE)
    message, *others = [part for part in parted if part.strip()]
    parts = [" ".join(message.split()).rstrip(".")]
    meant = [line.strip() for part in others if "Perhaps you meant" in part for line in part.splitlines()]
    if names := [line for line in meant if line.startswith("-")]:
        parts.append(f"perhaps {names[0]} is meant")
    return "; ".join([*parts, f"`{program} --help` lists the options"])


def _list(entries: Mapping[str, Entry], program: str, about: str, status: int) -> int:
    """Print one line for each command."""
    width = max(len(name) for name in entries) + 2
    print(f"usage: {program} [-h] COMMAND ...\n\n{about}")
    section = None
    for name, entry in entries.items():
        named = isinstance(entry, Command | Group)
        if (heading := entry.section if named else "") != section:
            section = heading
            print(f"\n{section or 'commands'}:")
        summary = entry.summary if named else ""
        print(f"  {name:{width}}{summary}")
    print(f"\n`{program} COMMAND --help` lists the options of a command.")
    return status


def _suggest(name: str, entries: Mapping[str, Entry]) -> str:
    if close := get_close_matches(name, entries, n=1, cutoff=0.75):
        return f"did you mean {close[0]}?"
    return f"choose from {', '.join(entries)}"


def _registry(adaptations: Adaptations) -> "ConstructorRegistry":
    """How tyro takes functions and dataclasses apart."""
    import tyro
    from tyro.constructors import (
        ConstructorRegistry,
        PrimitiveConstructorSpec,
        PrimitiveTypeInfo,
        StructConstructorSpec,
    )

    registry, inside = ConstructorRegistry(), []
    hint = tyro.conf.arg(help_behavior_hint=_hint)

    def adapted(field: Any) -> Any:
        name = tyro.conf.arg(name=adaptations.renamed.get(field.name))
        return replace(field, type=Annotated[field.type, hint, name], helptext=partial(_help, field.helptext))

    @registry.primitive_rule
    def optional(info: "PrimitiveTypeInfo") -> Any:
        """An option that need not be given looks like one that must be."""
        kinds = [kind for kind in get_args(info.type) if kind is not type(None)]
        if len(kinds) != 1 or type(None) not in get_args(info.type):
            return None
        spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], info.markers))
        if not isinstance(spec, PrimitiveConstructorSpec):
            return None  # tyro's own rules are for what is no primitive
        return replace(
            spec,
            is_instance=lambda value: value is None or spec.is_instance(value),
            str_from_instance=lambda value: ["None"] if value is None else spec.str_from_instance(value),
        )

    @registry.struct_rule
    def options(info: "StructTypeInfo") -> StructConstructorSpec | None:
        """Help without what explains nothing, and without the fields that are no options."""
        if inside:
            return None
        if inspect.isfunction(info.type):
            spec = _take_apart(info.type)
        else:
            inside.append(info.type)
            try:
                spec = ConstructorRegistry.get_struct_spec(info)
            finally:
                inside.pop()
        if not isinstance(spec, StructConstructorSpec):
            return None
        hidden = adaptations.left_out.get(info.type, ())
        return replace(spec, fields=tuple(adapted(each) for each in spec.fields if each.name not in hidden))

    return registry


def _take_apart(function: Callable[..., Any]) -> Any:
    """A function's parameters as options; it is called later."""
    import docstring_parser
    import tyro
    from tyro.constructors import StructConstructorSpec, StructFieldSpec

    hints = get_type_hints(function, include_extras=True)
    entries = docstring_parser.parse(inspect.getdoc(function) or "").params
    help = {entry.arg_name: entry.description for entry in entries}
    fields = [
        StructFieldSpec(
            name,
            hints[name],
            tyro.MISSING_NONPROP if parameter.default is parameter.empty else parameter.default,
            help.get(name),
        )
        for name, parameter in inspect.signature(function).parameters.items()
    ]
    return StructConstructorSpec(partial(partial, function), tuple(fields))


def _hint(default: str) -> str:
    """What help says of a default."""
    on = "(on by default; the flag turns it off)"
    return {"None": "", "": "", "False": "", "True": on}.get(default, f"(default: {default})")


def _help(text: str | Callable[[], str | None] | None) -> str | None:
    text = text() if callable(text) else text
    return None if text is None else _clean(" ".join(text.split()))


def _clean(text: str) -> str:
    """Text of a docstring for the terminal: without marks for code, and what is not given is no longer None."""
    return re.sub(r"\bNone: ", "by default ", text.replace("``", ""))


def _wrap(text: str) -> str:
    """Paragraphs that fit the terminal; indented, since tyro joins lines that begin with a letter."""
    width = min(get_terminal_size().columns, 120)
    paragraphs = (" ".join(paragraph.split()) for paragraph in text.split("\n\n"))
    return "\n".join(fill(each, width, initial_indent="  ", subsequent_indent="  ") for each in paragraphs)
