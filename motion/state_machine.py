"""State machines: clips with start points and cancel ranges, and the transitions (groups) between them.

The two config classes hold plain values only, so that OmegaConf can use them as schemas; `build_state_machine` loads
the clips and checks everything that a type cannot say (sbc.md sections 1 and 4).
"""

import difflib
import hashlib
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from motion.clip import Clip
from motion.errors import InputError
from motion.formats import poses, read_clip

BUILTIN = "builtin:"


@dataclass
class ClipConfig:
    """One state: a clip and where it may be entered and left."""

    # a file relative to motions.dir (.npy, .txt or .npz), or builtin:NAME
    file: str
    # whether playing goes on from the last frame to the first; whatever the file says
    looping: bool = False
    # s; where motion goes on after a transition to this clip: its pose there is the target pose
    start: float = 0.0
    # s; [first, last] moment at which a transition may leave this clip; [] is the whole clip
    cancel: list[float] = field(default_factory=list)
    # s; the music's beats in this clip, for one-hop transitions that keep time; [] is none known
    beats: list[float] = field(default_factory=list)
    # a word such as "fight"; one-hop transitions may be charged for a hop through another genre
    genre: str | None = None


@dataclass
class MotionsConfig:
    """A set of clips and the transitions between them."""

    # the set's name, for logs and checkpoints
    name: str
    # folder of the clips; not needed where all are builtin
    dir: str | None = None
    # rad; range of the target's turn about the vertical, against the source's heading (sbc.md section 4)
    rotation: list[float] = field(default_factory=lambda: [-math.pi / 2, math.pi / 2])
    # the transitions: "all" (every clip to every clip, itself included) or a list of [source, target] names
    groups: Any = "all"
    # the states by name
    clips: dict[str, ClipConfig] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class State:
    """A loaded clip. start: s. cancel: (first, last), s. Both lie within the clip."""

    name: str
    clip: Clip
    start: float
    cancel: tuple[float, float]


@dataclass(frozen=True, eq=False)
class StateMachine:
    """states: in the config's order. groups: (G, 2) (source, target) indices, sorted, each once. rotation: rad."""

    states: tuple[State, ...]
    groups: np.ndarray
    rotation: tuple[float, float]

    @property
    def content_hash(self):
        """Hash of all that a run depends on: names, poses, ranges and groups."""
        digest = hashlib.sha256()
        for state in self.states:
            digest.update(repr((state.name, state.clip.content_hash, state.start, state.cancel)).encode())
        digest.update(repr((self.groups.tolist(), self.rotation)).encode())
        return digest.hexdigest()[:16]

    @property
    def clips_hash(self):
        """Hash of the clips' names and poses: what a policy was trained on, whatever the ranges and groups."""
        names = repr([(state.name, state.clip.content_hash) for state in self.states])
        return hashlib.sha256(names.encode()).hexdigest()[:16]


def build_state_machine(config):
    """The StateMachine of a MotionsConfig.

    Raises InputError, one line with the key and the remedy, for clips that cannot be read and for values out of range.
    """
    if not config.clips:
        raise InputError("motions.clips: is empty; give at least one clip")
    rotation = _rotation(config.rotation)
    groups = _groups(config.groups, list(config.clips))
    folder = _folder(config)
    states = tuple(_state(name, clip, folder) for name, clip in config.clips.items())
    return StateMachine(states, groups, rotation)


def _folder(config):
    """The clips' folder, or None where all are builtin."""
    needing = [name for name, clip in config.clips.items() if not clip.file.startswith(BUILTIN)]
    if not needing:
        return None
    if config.dir is None:
        raise InputError(f"motions.dir: is needed by the file of motions.clips.{needing[0]}; give motions.dir=FOLDER")
    folder = Path(config.dir).expanduser()
    if not folder.is_dir():
        raise InputError(f"motions.dir: {folder} is not a folder; give motions.dir=FOLDER")
    return folder


def _state(name, config, folder):
    key = f"motions.clips.{name}"
    try:
        clip = _clip(name, config, folder)
    except InputError as error:
        raise InputError(f"{key}.file: {error}") from error
    start = _moment(f"{key}.start", config.start, clip)
    cancel = list(config.cancel) or [0.0, clip.duration]
    if len(cancel) != 2:
        raise InputError(f"{key}.cancel: has {len(cancel)} values; give [first, last] in seconds, or [] for all")
    first, last = (_moment(f"{key}.cancel", value, clip) for value in cancel)
    if first > last:
        raise InputError(f"{key}.cancel: [{first:g}, {last:g}] is reversed; give [{last:g}, {first:g}]")
    return State(name, clip, start, (first, last))


def _clip(name, config, folder):
    if not config.file.startswith(BUILTIN):
        return read_clip(folder / config.file, name, config.looping)
    # imported here, because only this needs the clips to be built
    from motion import builtin

    clip = builtin.load(config.file.removeprefix(BUILTIN))
    if clip.looping != config.looping:
        return poses.make_clip(config.file, name, clip.qpos, clip.fps, config.looping)
    return replace(clip, name=name)


def _moment(key, value, clip):
    """`value` in seconds, which must lie in the clip; up to a frame past its end counts as its end."""
    value = float(value)
    if not 0 <= value <= clip.duration + 1 / clip.fps:
        raise InputError(f"{key}: {value:g} s is outside the clip; it lasts {clip.duration:.3f} s: give a time in it")
    return min(value, clip.duration)


def _rotation(values):
    key = "motions.rotation"
    values = [float(value) for value in values]
    if len(values) != 2:
        raise InputError(f"{key}: has {len(values)} values; give [lowest, highest] in radians")
    low, high = values
    if low > high:
        raise InputError(f"{key}: [{low:g}, {high:g}] is reversed; give [{high:g}, {low:g}]")
    # 3.1416 is meant as pi
    if not -math.pi - 1e-4 <= low <= high <= math.pi + 1e-4:
        raise InputError(f"{key}: [{low:g}, {high:g}] goes beyond [-pi, pi]; give radians, not degrees")
    return max(low, -math.pi), min(high, math.pi)


def _groups(groups, names):
    """(G, 2) indices of the (source, target) pairs, sorted and each once."""
    key = "motions.groups"
    if isinstance(groups, str) and groups == "all":
        pairs = [(source, target) for source in range(len(names)) for target in range(len(names))]
    elif isinstance(groups, str) or not hasattr(groups, "__iter__"):
        raise InputError(f"{key}: is {groups!r}; give all, or a list of [source, target] names")
    else:
        pairs = []
        for i, pair in enumerate(groups):
            if isinstance(pair, str) or not hasattr(pair, "__len__") or len(pair) != 2:
                raise InputError(f"{key}[{i}]: is {pair!r}; give a pair [source, target] of names")
            pairs.append([_index(f"{key}[{i}]", name, names) for name in pair])
    if not pairs:
        raise InputError(f"{key}: is empty; give all, or at least one [source, target]")
    out = np.unique(np.array(pairs, dtype=np.int64), axis=0)
    out.flags.writeable = False
    return out


def _index(key, name, names):
    if name in names:
        return names.index(name)
    near = difflib.get_close_matches(str(name), names, n=1, cutoff=0.4)
    hint = f"did you mean {near[0]}?" if near else f"give one of {', '.join(names)}"
    raise InputError(f"{key}: no clip is called {name!r}; {hint}")
