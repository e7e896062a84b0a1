"""Kinematic transitions that an animator would use instead of the trained policy, for the same tasks.

`METHODS[name](states, task, fps=30, placement=Placement())` -> qpos (T, 47) at `fps`: the first pose is the source
clip's at the task's moment, the last one lies on the target clip, (T - 1) / fps seconds past its start point; both are
shown exactly as the clips have them. Before and after it the clips are played as `scene.Scene` puts them.

states: the `State`s of a `StateMachine`. task: (source state, moment in s, target state, rotation in rad), as in
orchestrator.tasks. placement: what of a run's configuration decides where the target stands (Eq. 14).

A method that cannot be used for the given states raises `motion.errors.InputError`, one line. numpy only; one_hop alone
loads `motion.onehop`, which needs numba, when it is called.
"""

from motion.baselines.crossfade import crossfade
from motion.baselines.dead_blending import dead_blending
from motion.baselines.inertialization import inertialization, inertialization_unreal
from motion.baselines.interpolation import interpolation
from motion.baselines.one_hop import one_hop
from motion.baselines.scene import Placement, Scene, make_scene

__all__ = ["DESCRIPTIONS", "LABELS", "METHODS", "Placement", "Scene", "make_scene"]

METHODS = {
    "interpolation": interpolation,
    "crossfade": crossfade,
    "inertialization": inertialization,
    "inertialization_unreal": inertialization_unreal,
    "dead_blending": dead_blending,
    "one_hop": one_hop,
}

LABELS = {
    "interpolation": "Interpolation",
    "crossfade": "Crossfade",
    "inertialization": "Inertialization",
    "inertialization_unreal": "Inertialization (Unreal)",
    "dead_blending": "Dead blending",
    "one_hop": "One-hop",
}

DESCRIPTIONS = {
    "interpolation": "ease-in-ease-out cubic blend of both clips over 0.4 s with time warping: the paper's baseline",
    "crossfade": "ease-in-ease-out blend of both clips over 0.5 s, 30 frames at 60 per second",
    "inertialization": "target clip at once, plus an offset that decays over 0.4 s along a quintic (Bollo 2018)",
    "inertialization_unreal": "the same with Unreal Engine's guards against overshoot, which give up some velocity",
    "dead_blending": "source extrapolated with decaying velocity, crossfaded over 0.4 s into the target (Holden 2023)",
    "one_hop": "optimal one-hop transition (Koyama and Goto 2019), warped on the ground to the task's target",
}
