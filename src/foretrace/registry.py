"""Classes that register themselves by label, and those that other packages add through entry points."""

from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any, Generic, TypeVar

from foretrace.errors import ForetraceError, shown
from foretrace.extras import named_extras

T = TypeVar("T")


class Registry(Mapping[str, T], Generic[T]):
    """Everything of one kind by its label; read-only for users, filled by `add`.

    Entry points of the group are loaded on the first look-up that needs them: a package that declares
    ``[project.entry-points."foretrace.predictors"]`` is found without being imported by hand.

    Args:
        kind: What is registered, in the singular, for messages: ``predictor``.
        group: Entry-point group: ``foretrace.predictors``.
        error: Class of the error about an unknown label.
    """

    def __init__(self, kind: str, group: str, error: type[ForetraceError]):
        self.kind, self.group, self._error = kind, group, error
        self._entries: dict[str, T] = {}
        self._declared: dict[str, str] = {}
        self._loaded = False

    def declare(self, label: str, module: str) -> None:
        """Name an entry that a module registers when it is imported; the first look-up of the label imports it."""
        self._declared[label] = module

    def add(self, label: str, entry: T) -> T:
        """Register an entry; returns it.

        Raises:
            TypeError: The label is not a non-empty string, or another entry has it.
        """
        if not isinstance(label, str) or not label:
            raise TypeError(f"{self.kind} label {label!r}: give a non-empty string")
        taken = self._entries.get(label)
        if taken is not None and not _same_place(taken, entry):
            raise TypeError(f"{self.kind} label {label!r} is taken by {taken!r}: choose another one")
        self._entries[label] = entry
        return entry

    def arrange(self, labels: Iterable[str]) -> None:
        """List these labels first, in this order."""
        first = {label: self._entries[label] for label in labels}
        self._entries = first | self._entries

    def find(self, label: Any) -> T:
        """The entry of a label.

        Raises:
            ForetraceError: Of the registry's class, if there is none.
        """
        if label not in self:
            raise self._error(f"unknown {self.kind} {shown(label)}; available: {', '.join(self)}")
        return self[label]

    def __getitem__(self, label: str) -> T:
        if label not in self._entries and label in self._declared:
            with named_extras():
                import_module(self._declared[label])
        if label not in self._entries:
            self._load()
        return self._entries[label]

    def __contains__(self, label: object) -> bool:
        if not isinstance(label, str):
            return False
        if label not in self._entries and label not in self._declared:
            self._load()
        return label in self._entries or label in self._declared

    def __iter__(self) -> Iterator[str]:
        self._load()
        return iter(dict.fromkeys((*self._declared, *self._entries)))

    def __len__(self) -> int:
        return len(list(iter(self)))

    def _load(self) -> None:
        if self._loaded:
            return
        self._loaded = True
        for entry in entry_points(group=self.group):
            try:
                found = entry.load()
            except Exception as reason:  # a broken plug-in must not take everything else down
                raise self._error(
                    f"the {self.kind} {shown(entry.name)} of entry point {shown(entry.value)} cannot be loaded "
                    f"({shown(reason)}): mend or uninstall the package that declares it"
                ) from reason
            if entry.name not in self._entries and not isinstance(found, type):
                self._entries[entry.name] = found


def adds_anything(subclass: type) -> bool:
    """Whether a class body defines anything: one that does not, such as torch's tracer makes, stands for its parent."""
    return any(not name.startswith("__") for name in subclass.__dict__)


def _same_place(one: Any, other: Any) -> bool:
    """Whether two classes are the same one, defined again, as in a notebook or after a reload."""
    names = ("__module__", "__qualname__")
    return one is other or all(
        hasattr(one, name) and getattr(one, name) == getattr(other, name, None) for name in names
    )
