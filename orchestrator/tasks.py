"""The grid of evaluation tasks (section 1 and 4.3 of the paper)."""

import numpy as np


def task_grid(library, config):
    """Tasks (M, 4) in the order of groups, moments, rotations: source state, moment (s), target state, rotation (rad).

    Moments every `moment_spacing` s over the source's cancel range, rotations every `rotation_spacing` rad over the
    range, both ends included. library: `workers.library.MotionLibrary`; config: `EvaluationConfig`. With `max_tasks`,
    a subset of that size drawn once and for all, the same for every policy.
    """
    low, high = library.rotation
    rotations = low + config.rotation_spacing * np.arange(int((high - low) / config.rotation_spacing + 1e-6) + 1)
    tasks = []
    for source, target in library.groups:
        begin, end = library.cancel[source]
        moments = begin + config.moment_spacing * np.arange(int((end - begin) / config.moment_spacing + 1e-6) + 1)
        moment, rotation = (grid.ravel() for grid in np.meshgrid(moments, rotations, indexing="ij"))
        tasks.append(np.stack([np.full_like(moment, source), moment, np.full_like(moment, target), rotation], axis=1))
    tasks = np.concatenate(tasks)
    if 0 < config.max_tasks < len(tasks):
        chosen = np.random.Generator(np.random.Philox(key=0)).permutation(len(tasks))[: config.max_tasks]
        tasks = tasks[np.sort(chosen)]
    return tasks
