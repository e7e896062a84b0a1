"""The direct crossfade of Koyama and Goto 2019: "30 frames to make the transition directly to the destination".

Both clips play on during the blend, the target's from its start point; 30 frames at that paper's 60 per second.
"""

from motion.baselines.poses import blend, ease, frames_of
from motion.baselines.scene import make_scene

DURATION = 0.5  # s


def crossfade(states, task, fps=30, placement=None):
    """Poses (T, 47) of the transition; see `motion.baselines`."""
    scene, times = make_scene(states, task, placement), frames_of(DURATION, fps)
    return blend(scene.source_poses(times), scene.target_poses(times), ease(times / times[-1]))
