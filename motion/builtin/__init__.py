"""Nine built-in clips, authored by this project from keyframes, so that everything works without any motion data."""

import difflib
from functools import cache

from motion.builtin.dodge import DODGE_BACK
from motion.builtin.gaits import RUN, WALK
from motion.builtin.idle import IDLE
from motion.builtin.slashes import SLASH_DOWN, SLASH_LEFT, SLASH_UP
from motion.builtin.thrusts import SHIELD_BASH, STAB
from motion.errors import InputError

MOTIONS = {
    motion.name: motion for motion in (IDLE, WALK, RUN, DODGE_BACK, STAB, SLASH_UP, SLASH_DOWN, SLASH_LEFT, SHIELD_BASH)
}
NAMES = tuple(MOTIONS)


def load(name):
    """The built-in `motion.clip.Clip` called `name`. Raises InputError for an unknown name."""
    if name not in MOTIONS:
        near = difflib.get_close_matches(str(name), NAMES, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"choose one of {', '.join(NAMES)}"
        raise InputError(f"there is no built-in clip '{name}': {hint}")
    return _build(name)


@cache
def _build(name):
    return MOTIONS[name].clip()
