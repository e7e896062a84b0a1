"""Every configuration key with its type, default and documentation, read from the dataclasses and their sources."""

import ast
import dataclasses
import difflib
import inspect
import textwrap
import typing
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from orchestrator.config import Config

ANY_NAME = "NAME"  # stands in a key for a name that the user chooses, e.g. a clip's


@dataclass(frozen=True)
class Key:
    """One leaf of the configuration.

    name: dotted key. type: its annotation. default: its default value. doc: one paragraph.
    """

    name: str
    type: Any
    default: Any
    doc: str

    @property
    def optional(self):
        """Whether null is a value."""
        return type(None) in typing.get_args(self.type)

    @property
    def plain_type(self):
        """The annotation without None."""
        return next(a for a in typing.get_args(self.type) if a is not type(None)) if self.optional else self.type

    @property
    def type_name(self):
        """The type in words."""
        return type_name(self.plain_type) + (" or null" if self.optional else "")


def type_name(annotation):
    """An annotation in words a user knows."""
    names = {int: "an integer", float: "a number", bool: "true or false", str: "text"}
    plural = {int: "integers", float: "numbers", bool: "booleans", str: "names"}
    if typing.get_origin(annotation) is list:
        return "a list of " + plural.get(typing.get_args(annotation)[0], "entries")
    return names.get(annotation, "a mapping")


@lru_cache
def field_docs(cls):
    """Documentation of a dataclass's fields: the string literal below each, else the comment above it."""
    docs = {}
    for base in reversed(cls.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        source = textwrap.dedent(inspect.getsource(base))
        lines, body = source.splitlines(), ast.parse(source).body[0].body
        for node, below in zip(body, [*body[1:], None], strict=True):
            if not isinstance(node, ast.AnnAssign):
                continue
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                words = str(below.value.value).split()
            else:
                words = comment_above(lines, node.lineno - 1).split()
            docs[node.target.id] = " ".join(words)
    return docs


def comment_above(lines, index):
    """The comment lines directly above line `index`."""
    first = index
    while first > 0 and lines[first - 1].lstrip().startswith("#"):
        first -= 1
    return " ".join(line.strip().lstrip("# ") for line in lines[first:index])


def default_of(field):
    """A field's default value, None if it has none."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return None if field.default is dataclasses.MISSING else field.default


def keys_of(cls, prefix=""):
    """Every leaf of a configuration dataclass as a `Key`, in the order of the fields."""
    hints, docs, found = typing.get_type_hints(cls), field_docs(cls), []
    for field in dataclasses.fields(cls):
        annotation, name = hints[field.name], prefix + field.name
        if dataclasses.is_dataclass(annotation):
            found += keys_of(annotation, name + ".")
        elif typing.get_origin(annotation) is dict:
            found += keys_of(typing.get_args(annotation)[1], f"{name}.{ANY_NAME}.")
        else:
            found.append(Key(name, annotation, default_of(field), docs.get(field.name, "")))
    return found


@lru_cache
def all_keys():
    """Every key of a run's configuration by its dotted name."""
    return {key.name: key for key in keys_of(Config)}


def find_key(name):
    """The `Key` of a dotted name, or None. In `motions.clips.idle.start` the third part is the user's own."""
    keys = all_keys()
    if name in keys:
        return keys[name]
    parts = name.split(".")
    for i in range(1, len(parts) - 1):
        pattern = ".".join([*parts[:i], ANY_NAME, *parts[i + 1 :]])
        if pattern in keys:
            return keys[pattern]
    return None


def suggestion(name, candidates):
    """A hint that names the most similar candidate, or an empty string.

    A candidate is also similar when its last part is: `learning_rate` finds `ppo.learning_rate`.
    """
    candidates = list(candidates)
    last = name.rsplit(".", 1)[-1]
    exact = [c for c in candidates if c.rsplit(".", 1)[-1] == last]
    close = exact or difflib.get_close_matches(name, candidates, 1, 0.6)
    if not close:
        parts = {c.rsplit(".", 1)[-1]: c for c in candidates}
        close = [parts[p] for p in difflib.get_close_matches(last, parts, 1, 0.7)]
    return f"; did you mean {close[0]!r}?" if close else ""
