"""Registries: classes that register themselves, and plug-ins of other packages."""

from types import SimpleNamespace

import pytest

from foretrace import registry as module
from foretrace.errors import TrainingError
from foretrace.registry import Registry


@pytest.fixture
def animals(monkeypatch):
    """A registry with an entry, a plug-in that registers itself, and one that is registered as it is."""
    found = Registry("animal", "foretrace.animals", TrainingError)
    found.add("cat", "a cat")
    points = [
        SimpleNamespace(name="dog", value="zoo:dog", load=lambda: found.add("dog", "a dog")),
        SimpleNamespace(name="fish", value="zoo:fish", load=lambda: "a fish"),
    ]
    monkeypatch.setattr(module, "entry_points", lambda group: points if group == "foretrace.animals" else [])
    return found, points


def test_plug_ins_are_found_when_they_are_needed(animals):
    found, _ = animals
    assert found["cat"] == "a cat"
    assert not found._loaded
    assert found.find("dog") == "a dog"
    assert list(found) == ["cat", "dog", "fish"]
    found.arrange(["fish"])
    assert list(found) == ["fish", "cat", "dog"]


@pytest.mark.parametrize("label", ["cow", None, ["cat"]])
def test_unknown_labels_are_refused_with_the_choices(animals, label):
    with pytest.raises(TrainingError, match=r"unknown animal .*; available: cat, dog, fish"):
        animals[0].find(label)


def test_a_broken_plug_in_is_named(animals):
    found, points = animals
    points.append(SimpleNamespace(name="yeti", value="zoo:yeti", load=lambda: 1 / 0))
    with pytest.raises(TrainingError, match=r"the animal 'yeti' of entry point 'zoo:yeti' cannot be loaded"):
        found.find("horse")


def test_labels_are_unique_and_not_empty(animals):
    found, _ = animals
    found.add("cat", "a cat")
    for label, message in (("", "give a non-empty string"), ("cat", "is taken by 'a cat'")):
        with pytest.raises(TypeError, match=message):
            found.add(label, "another one")
