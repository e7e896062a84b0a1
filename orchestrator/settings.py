"""Build the `Config` of a run from files and command lines, and keep it in a run's folder.

Order, later wins: defaults of the dataclasses, configs/scale/SCALE.yaml (after the scale that it names itself, if any),
configs/motions/MOTIONS.yaml, then the layers in the order given (a sweep's base, its row, the command line). `scale=`
and `motions=` choose the two files, the last layer that names them wins, and both files are applied before every other
key wherever the two stand. A layer that sets a key of `budget` replaces the budget of the layers below it:
budget.iterations=5 is not cut short by a scale's samples.

    python -m orchestrator.settings          print every key with its default and meaning
"""

import dataclasses
import os
import typing
from pathlib import Path
from typing import Any

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from learner.storage import replace_file
from motion.errors import InputError
from orchestrator.config import Config
from orchestrator.keys import all_keys, find_key, keys_of, suggestion
from orchestrator.validate import check_values, shown

FILE_KEYS = ("scale", "motions")
# runs of older versions have them in their config.yaml
REMOVED_KEYS = ("evaluation.robustness_log_sigmas", "arrival.physics", "arrival.correction")


@dataclasses.dataclass(frozen=True)
class Layer:
    """Overrides of one origin. values: dotted or nested keys. origin: words for error messages, e.g. a file's name."""

    values: dict
    origin: str


def config_folder():
    """Folder of the project's configs/: beside the packages in a checkout and in an installed wheel."""
    return Path(__file__).resolve().parent.parent / "configs"


def shipped_policies():
    """{name: file} of the policies that come with Segue."""
    return {path.stem: path for path in sorted((config_folder() / "policies").glob("*.pt"), key=lambda path: path.stem)}


def command_line(arguments):
    """The `Layer` of key=value arguments; values are YAML. InputError for an argument without `=`."""
    values = {}
    for argument in arguments:
        key, equals, text = argument.partition("=")
        if not equals or not key.strip():
            raise InputError(f"command line: {argument!r} is not of the form key=value")
        try:
            values[key.strip()] = OmegaConf.create(f"value: {text}" if text.strip() else "value: ''").value
        except Exception:  # not YAML, e.g. an address with ': ' inside: take it as it stands
            values[key.strip()] = text
        if OmegaConf.is_config(values[key.strip()]):
            values[key.strip()] = OmegaConf.to_container(values[key.strip()])
    return Layer(values, "command line")


def read_yaml(path, what):
    """The mapping in a YAML file. `what` names the file's role in errors. InputError unless it is one."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{what} {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{what} {path}: not a text file") from error
    try:
        content = OmegaConf.to_container(OmegaConf.create(text)) if text.strip() else {}
    except (yaml.YAMLError, OmegaConfBaseException) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or first_line(error)
        raise InputError(f"{what} {path}: not YAML{where}: {problem}") from error
    if not isinstance(content, dict):
        raise InputError(f"{what} {path}: must be a mapping of keys to values")
    return content


def build(layers):
    """The checked `Config` of `layers`, lowest precedence first, with absolute paths. InputError if wrong."""
    files, stack = {"scale": (Config.scale, "default"), "motions": ("builtin", "default")}, []
    for layer in layers:
        entries = [(key, value, layer.origin) for key, value in flatten(layer.values)]
        files |= {key: (value, origin) for key, value, origin in entries if key in FILE_KEYS}
        stack.append([entry for entry in entries if entry[0] not in FILE_KEYS])
    path = choose("motions", *files["motions"])
    motions = flatten(read_yaml(path, "motions file"), "motions.")
    from_files = [*scales(*files["scale"]), [(key, value, shown_path(path)) for key, value in motions]]
    entries = stacked([*from_files, [("scale", *files["scale"])], *stack])
    result = to_config(nested(entries), "configuration")
    origins = {key: origin for key, _, origin in entries}
    check_values(result, lambda key: origins.get(key, "default"))
    return absolute_paths(result)


def scales(name, origin):
    """Entries (key, value, origin) of a scale's file, after those of the scale that it names as its own `scale`."""
    layers, seen = [], []
    while name is not None:
        path = choose("scale", name, origin)
        if path in seen:
            raise InputError(f"{origin}: scale={name} is on itself: take that line out")
        seen.append(path)
        content, origin = read_yaml(path, "scale file"), shown_path(path)
        name = content.pop("scale", None)
        layers.insert(0, [(key, value, origin) for key, value in flatten(content)])
    return layers


def stacked(layers):
    """The entries of all layers, lowest first, without the budgets that a higher layer's budget replaces."""
    entries = []
    for layer in layers:
        if any(key.startswith("budget.") for key, _, _ in layer):
            entries = [entry for entry in entries if not entry[0].startswith("budget.")]
        entries += layer
    return entries


def shown_path(path):
    """A file's path for messages: relative to the project where it belongs to it."""
    path, project = Path(path), config_folder().parent
    return str(path.relative_to(project)) if path.is_relative_to(project) else str(path)


def choose(kind, name, origin):
    """Path of the file that `scale=` or `motions=` names: a file of configs/ or, for motions, a path."""
    if not isinstance(name, str) or not name:
        raise InputError(f"{origin}: {kind}={shown(name)} must be the name of a file of configs/{kind}/")
    folder = config_folder() / kind
    names = sorted(path.stem for path in folder.glob("*.yaml"))
    if name in names:
        return folder / f"{name}.yaml"
    if kind == "motions" and (name.endswith((".yaml", ".yml")) or "/" in name):
        if Path(name).is_file():
            return Path(name)
        raise InputError(f"{origin}: motions={name}: no such file")
    other = " or the path of a YAML file" if kind == "motions" else ""
    hint = suggestion(name, names)
    raise InputError(f"{origin}: {kind}={name} is not known; it is one of {', '.join(names)}{other}{hint}")


def flatten(values, prefix=""):
    """(dotted key, value) of every entry of nested or dotted mappings, down to values that are not mappings."""
    for key, value in values.items():
        if isinstance(value, dict) and value:
            yield from flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def nested(entries):
    """Nested mapping of (key, value, origin) entries, the last wins. InputError for unknown keys and wrong types."""
    tree = {}
    for name, value, origin in entries:
        key = find_key(name)
        if key is None:
            raise InputError(f"{origin}: {unknown(name)}")
        *parents, leaf = name.split(".")
        node = tree
        for parent in parents:
            node = node.setdefault(parent, {})
        node[leaf] = fitting(key, value, name, origin)
    return tree


def unknown(name):
    """Says that a key is not known and which may be meant."""
    keys = all_keys()
    below = [key for key in keys if key.startswith(name + ".")]
    if below:
        return f"{name} is a group of keys, not a value: set one of {', '.join(below)}"
    hint = suggestion(name, [*keys, *FILE_KEYS])
    return f"unknown key {name!r}{hint}; `python -m orchestrator.settings` lists all keys"


def fitting(key, value, name, origin):
    """`value` in the type of `key`, 2e6 being an integer. InputError if it is of another type."""
    if value is None and key.optional:
        return None
    try:
        return fit(key.plain_type, value)
    except TypeError:
        raise InputError(f"{origin}: {name}={shown(value)} must be {key.type_name}") from None


def fit(annotation, value):
    """`value` as an int, float, bool, str, list of these or Any; TypeError if it is none."""
    if annotation is Any:
        return value
    if typing.get_origin(annotation) is list:
        if not isinstance(value, list):
            raise TypeError
        return [fit(typing.get_args(annotation)[0], item) for item in value]
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if annotation is int and number and float(value).is_integer():
        return int(value)
    if annotation is float and number:
        return float(value)
    if annotation is str and (number or isinstance(value, str)):
        return str(value)
    if annotation is bool and isinstance(value, bool):
        return value
    raise TypeError


def to_config(values, what):
    """The `Config` of nested values over the defaults, interpolations resolved. `what` names their origin in errors."""
    try:
        config = OmegaConf.merge(OmegaConf.structured(Config), values)
        OmegaConf.resolve(config)
        return OmegaConf.to_object(config)
    except OmegaConfBaseException as error:
        raise InputError(f"{what}: {first_line(error)}") from error


def absolute_paths(config):
    """The configuration with paths that do not depend on the working directory, which differs between processes.

    start.checkpoint may be the name of a policy that comes with Segue, if nothing here has that name.
    """
    begins = config.start.checkpoint
    if begins and not os.path.exists(begins) and begins in shipped_policies():
        config.start.checkpoint = str(shipped_policies()[begins])
    for holder, name in ((config, "out"), (config.motions, "dir"), (config.start, "checkpoint")):
        value = getattr(holder, name)
        if value:
            setattr(holder, name, os.path.abspath(os.path.expanduser(value)))
    return config


def first_line(error):
    """An exception as one line, OmegaConf's key included."""
    key = getattr(error, "full_key", None)
    line = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
    return f"{key}: {line}" if key else line


def save(config, path):
    """Write the whole configuration as YAML, at once or not at all."""
    replace_file(path, OmegaConf.to_yaml(OmegaConf.structured(config)).encode())


def load(path, arguments=(), motions=None):
    """The `Config` that `save` wrote, with key=value arguments over it; see `complete`. InputError if missing or wrong.
    """
    return complete(read_yaml(path, "configuration"), path, arguments, motions)


def complete(values, path, arguments=(), motions=None):
    """The `Config` of nested or dotted values that `path` holds, key=value arguments over them. InputError if wrong.

    Nothing of configs/ is added; keys that are not there have the defaults of `Config`. motions: name or path of a
    motions file (see `choose`) in the place of the clips there.
    """
    command = command_line(arguments)
    for key in FILE_KEYS:
        if key in command.values:
            raise InputError(f"command line: {key}= chooses a file for a new run; {path} is complete already")
    entries = [(k, v, str(path)) for k, v in flatten(values) if k not in REMOVED_KEYS]
    if motions is not None:
        file = choose("motions", motions, "--motions")
        others = flatten(read_yaml(file, "motions file"), "motions.")
        entries = [entry for entry in entries if not entry[0].startswith("motions.")]
        entries += [(key, value, shown_path(file)) for key, value in others]
    entries = stacked([entries, [(key, value, command.origin) for key, value in flatten(command.values)]])
    result = to_config(nested(entries), f"configuration {path}")
    origins = {key: origin for key, _, origin in entries}
    check_values(result, lambda key: origins.get(key, "default"))
    return absolute_paths(result)


def describe():
    """Text that lists every key with its default and meaning."""
    lines = []
    for key in keys_of(Config):
        lines += [f"{key.name} = {shown(key.default)}", f"    {key.doc}"]
    return "\n".join(lines)


if __name__ == "__main__":
    print(describe())
