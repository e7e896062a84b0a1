"""Reads a state-machine file of configs/motions without the orchestrator's configuration."""

import difflib
from pathlib import Path

from motion.errors import InputError
from motion.state_machine import MotionsConfig


def read_motions(name):
    """(MotionsConfig, beats, genres) of a file of configs/motions (its name) or of any path.

    beats: per clip its times in seconds, genres: per clip a word, or None where the file gives them for no clip.
    Raises InputError, one line with file and key, for everything that is not such a file.
    """
    import yaml
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    path = _path(name)
    try:
        content = OmegaConf.to_container(OmegaConf.create(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise InputError(f"--motions {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"--motions {path}: not a text file") from error
    except (yaml.YAMLError, OmegaConfBaseException) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        raise InputError(f"--motions {path}: not YAML{where}; correct it") from error
    if not isinstance(content, dict) or not isinstance(content.get("clips"), dict):
        raise InputError(f"--motions {path}: has no mapping `clips:`; see configs/motions/builtin.yaml for one")
    try:
        config = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(MotionsConfig), content))
    except OmegaConfBaseException as error:
        key = getattr(error, "full_key", None) or "?"
        raise InputError(f"--motions {path}: {key}: {str(error).splitlines()[0]}") from error
    return config, _annotation(path, config, "beats"), _annotation(path, config, "genre")


def _path(name):
    """Path of the file that `--motions` names."""
    folder = Path(__file__).resolve().parents[2] / "configs" / "motions"
    names = sorted(path.stem for path in folder.glob("*.yaml"))
    if name in names:
        return folder / f"{name}.yaml"
    if name.endswith((".yaml", ".yml")) or "/" in name:
        if Path(name).is_file():
            return Path(name)
        raise InputError(f"--motions {name}: no such file")
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise InputError(f"--motions {name}: is none of {', '.join(names)}, nor the path of a YAML file{hint}")


def _annotation(path, config, key):
    """The values of `key` per clip, or None where no clip has one."""
    values = {name: getattr(clip, key) for name, clip in config.clips.items()}
    if not any(values.values()):
        return None
    for name, value in values.items():
        if not value:
            raise InputError(f"--motions {path}: clips.{name}.{key}: is missing; other clips have it: give it to all")
    return list(values.values())
