"""Which transitions a report shows: some that were reached, of other clips each, and the worst."""

from dataclasses import dataclass

import numpy as np

from motion.baselines import METHODS, Placement, make_scene
from motion.errors import InputError
from motion.state_machine import build_state_machine
from orchestrator.curriculum import thresholds
from orchestrator.evaluation import replay
from orchestrator.evaluation.episodes import run_tasks
from orchestrator.report import takes
from orchestrator.tasks import TaskGrid
from workers.library import build_library
from workers.types import DEVIATIONS, REACHED

KEY_BODIES = DEVIATIONS.index("key_bodies")
CANDIDATES = 300  # tasks that are played to choose from
INTERPOLATION = "interpolation"


@dataclass(frozen=True)
class Shown:
    """One transition on show. number: of the task in the grid. ours, other: `Take`s of the policy and of interpolation
    (None where it cannot be used). deviation: d^kp of the policy's last frame, m."""

    number: int
    source: str
    moment: float
    target: str
    rotation: float
    ours: takes.Take
    other: takes.Take | None
    deviation: float


@dataclass(frozen=True)
class Chosen:
    """good, bad: tuples of `Shown`. tried, reached: how many tasks were played to choose from, and how many of them
    reached the target, at `limits` (`Thresholds`)."""

    good: tuple
    bad: tuple
    tried: int
    reached: int
    limits: object


def choose(config, folder, good, bad):
    """The `Chosen` of a run's newest policy: `good` and `bad` transitions, out of CANDIDATES tasks of its grid.

    Played as in the evaluation, noise included, at the thresholds that training reached. Good: reached, from one clip
    to another, with the largest turns; if none is reached, those that end nearest to the target (d^kp). Bad: not
    reached, farthest from the target at the end; if all are reached, the longest. Of as many clips as possible.
    """
    machine = build_state_machine(config.motions)
    library = build_library(machine)
    policy, tightenings = replay.load_policy(folder, config)
    limits = thresholds(config.curriculum, config.reach, tightenings)
    numbers, tasks = candidates(TaskGrid(library, config.evaluation), CANDIDATES)
    outcomes = run_tasks(config, library, policy, tasks, limits, config.evaluation.log_sigma, numbers)
    reached, off = outcomes.end == REACHED, outcomes.deviations[:, KEY_BODIES]
    turns, to_another = np.abs(tasks[:, 3]), tasks[:, 0] != tasks[:, 2]
    best = np.lexsort((-turns, ~to_another)) if reached.any() else np.argsort(off)
    worst = np.argsort(-off) if not reached.all() else np.argsort(-outcomes.steps)
    best, worst = best[reached[best] | ~reached.any()], worst[~reached[worst] | reached.all()]
    placement = Placement(config.task.transition_time, config.rotation.reference)

    def shown(row):
        motion = replay.record(
            config, library, policy, tasks[row], limits, config.evaluation.log_sigma, int(numbers[row])
        )
        scene = make_scene(machine.states, tasks[row], placement)
        return Shown(
            int(numbers[row]), scene.source.name, scene.moment, scene.target.name, float(tasks[row][3]),
            takes.of_policy(scene, motion), interpolated(machine.states, tasks[row], scene, placement),
            float(motion.deviations[-1, KEY_BODIES]),
        )  # fmt: skip

    return Chosen(
        tuple(map(shown, different(best, tasks, good))), tuple(map(shown, different(worst, tasks, bad))),
        len(tasks), int(reached.sum()), limits,
    )  # fmt: skip


def candidates(grid, count):
    """(numbers, tasks (n, 4)) of at most `count` tasks of a `TaskGrid`, drawn once and for all."""
    order = np.random.Generator(np.random.Philox(key=1)).permutation(len(grid))[:count]
    numbers = grid.numbers(0, len(grid))[np.sort(order)]
    return numbers, grid.tasks(numbers)


def different(order, tasks, count):
    """The first `count` rows of `order` (indices of tasks), each sharing as few clips as possible with those before."""
    out = []
    for _ in range(min(count, len(order))):
        left = [row for row in order if row not in out]
        out.append(min(left, key=lambda row: sum((tasks[row, [0, 2]] == tasks[other, [0, 2]]).sum() for other in out)))
    return out


def interpolated(states, task, scene, placement):
    """The `Take` of the paper's interpolation for the same task, None where it cannot be used."""
    try:
        return takes.of_method(scene, METHODS[INTERPOLATION](states, task, takes.FPS, placement))
    except InputError:
        return None
