"""What a sweep will run: the sweep's file and the command line, as one configuration per row and seed."""

import re
from dataclasses import dataclass
from pathlib import Path

from motion.errors import InputError
from orchestrator.config import Config
from orchestrator.keys import suggestion
from orchestrator.settings import Layer, build, config_folder, read_yaml
from orchestrator.validate import shown

SWEEP_KEYS = ("name", "base", "budget", "seeds", "rows")
OWN_KEYS = ("row", "seed", "out")  # the sweep sets these for each run


@dataclass(frozen=True)
class Run:
    """One run of a sweep: its configuration and its folder."""

    config: Config
    folder: Path

    @property
    def name(self):
        """`<row>-seed<k>`: the folder's name, and the run's in MLflow."""
        return run_name(self.config.row, self.config.seed)


@dataclass(frozen=True)
class Plan:
    """A sweep: its name (the MLflow experiment), folder, rows and seeds (of all rows), and its runs, seed by seed."""

    name: str
    out: Path
    rows: tuple
    seeds: tuple
    runs: tuple


def run_name(row, seed):
    """Name of a row's run, also of its folder."""
    return f"{row}-seed{seed}"


def read_plan(path, command):
    """The `Plan` of a sweep's file and the command line's `Layer`; InputError for anything wrong in either.

    The command line may choose `rows=[...]`, `seeds=[...]` (or `seed=`) and `out=`; its other keys hold for every run.
    A row of the file may have `seeds` of its own instead of the file's.
    """
    path = find_sweep(path)
    content = read_yaml(path, "sweep file")
    for key in content:
        if key not in SWEEP_KEYS:
            raise InputError(
                f"sweep file {path}: unknown key {key!r}{suggestion(key, SWEEP_KEYS)}; keys are {', '.join(SWEEP_KEYS)}"
            )
    name = content.get("name", Path(path).stem)
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]*", name):
        raise InputError(f"sweep file {path}: name={shown(name)} must be of letters, digits, '_', '-' and '.'")
    rows = rows_of(content, path)
    overrides = dict(command.values)
    chosen = chosen_rows(overrides.pop("rows", None), rows, command.origin)
    own_seeds = {
        row: valid_seeds(values.pop("seeds"), f"sweep file {path}", f"rows.{row}.seeds")
        for row, values in rows.items()
        if "seeds" in values
    }
    if "seeds" in overrides or "seed" in overrides:
        own_seeds = {}
    seeds = chosen_seeds(overrides, content, path, command.origin)
    seeds_of = {row: own_seeds.get(row, seeds) for row in chosen}
    seeds = list(dict.fromkeys(seed for row in chosen for seed in seeds_of[row]))
    out = Path(text(overrides.pop("out", f"runs/{name}"), "out", command.origin)).expanduser().absolute()
    base = [Layer(mapping(content, "base", path), f"{path} (base)")]
    base += [Layer({"budget": content["budget"]}, f"{path} (budget)")] if content.get("budget") is not None else []
    runs = []
    for seed in seeds:
        for row in (row for row in chosen if seed in seeds_of[row]):
            own = Layer({"row": row, "seed": seed, "out": str(out)}, path)
            config = build([*base, Layer(rows[row], f"{path} (row {row})"), Layer(overrides, command.origin), own])
            runs.append(Run(config, out / run_name(row, seed)))
    return Plan(name, out, tuple(chosen), tuple(seeds), tuple(runs))


def find_sweep(path):
    """The sweep's file as given, else the project's own of that name."""
    own = config_folder().parent / path
    return path if Path(path).exists() or not own.is_file() else str(own)


def mapping(content, key, path):
    """A mapping of the sweep's file, {} if absent; keys that belong to each run are refused."""
    value = content.get(key)
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise InputError(f"sweep file {path}: {key} must be a mapping of keys to values")
    for own in OWN_KEYS:
        if own in value:
            raise InputError(f"sweep file {path}: {key} must not set {own}; the sweep sets it for each run")
    return value


def rows_of(content, path):
    """Overrides of each row by its name."""
    rows = content.get("rows")
    if not isinstance(rows, dict) or not rows:
        raise InputError(f"sweep file {path}: rows must be a mapping of at least one row to its overrides")
    for row in rows:
        if not isinstance(row, str) or not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]*", row):
            raise InputError(f"sweep file {path}: row {row!r} must be of letters, digits, '_', '-' and '.'")
    return {row: dict(mapping(rows, row, path)) for row in rows}


def chosen_rows(value, rows, origin):
    """The rows that `rows=` asks for in the sweep's order; all if it is not given."""
    if value is None:
        return list(rows)
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or not names:
        raise InputError(f"{origin}: rows={shown(value)} must be a list of rows such as [{','.join(rows)}]")
    for name in names:
        if name not in rows:
            hint = suggestion(str(name), rows)
            raise InputError(f"{origin}: rows={shown(value)}: no row {name!r}{hint}; rows are {', '.join(rows)}")
    return [row for row in rows if row in names]


def chosen_seeds(overrides, content, path, origin):
    """Seeds of the command line (`seeds=[..]`, `seed=`), else of the file, else [0]. Takes them out of `overrides`."""
    if "seeds" in overrides and "seed" in overrides:
        raise InputError(f"{origin}: give either seeds=[...] or seed=, not both")
    if "seed" in overrides:
        seeds, where, key = [overrides.pop("seed")], origin, "seed"
    elif "seeds" in overrides:
        seeds, where, key = overrides.pop("seeds"), origin, "seeds"
    else:
        seeds, where, key = content.get("seeds", [0]), f"sweep file {path}", "seeds"
    return valid_seeds(seeds, where, key)


def valid_seeds(seeds, where, key):
    """`seeds`, if they are a list of different integers of at least 0; else InputError."""
    valid = isinstance(seeds, list) and seeds and all(type(seed) is int and seed >= 0 for seed in seeds)
    if not valid or len(set(seeds)) < len(seeds):
        raise InputError(f"{where}: {key}={shown(seeds)} must be different integers of at least 0")
    return seeds


def text(value, key, origin):
    """`value` as a non-empty string."""
    if not isinstance(value, (str, int)) or not str(value).strip():
        raise InputError(f"{origin}: {key}={shown(value)} must be the path of a folder")
    return str(value)
