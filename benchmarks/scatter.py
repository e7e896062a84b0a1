"""What the evaluation's noise does to where motions arrive: a policy's, and ones known to arrive within the accuracy.

    python -m benchmarks.scatter RUN [--tasks 12] [--rounds 40] [--simulations 384] [--steps 26] [--seed 0] [--json]

TTAR asks that a task is reached with noise of `evaluation.log_sigma` on every action. For tasks of a run's grid, of the
newest checkpoint's policy: how far the mean of its arrivals with that noise is from the target (bias) and how far they
lie around it (spread: root of the summed variances of the root's place), both after the step at which it is nearest
without noise; and the spread where the actions of the motion without noise are played whatever happens (open loop),
which shows how much of the noise the policy corrects. Then each motion is improved as by `benchmarks.limits`, and its
actions are played with noise in their last one, two, three or all steps only: the share that is still within the final
accuracy. What a policy loses by the noise of a last step it cannot correct any more; the rest it could.
"""

import json
import math

import numpy as np

from benchmarks.limits import nearest, prepare
from workers.kinematics import NUM_DOF

LAST = (1, 2, 3)  # steps with noise, besides all


def main():
    """Measure and print."""
    search, drawn, rng, options = prepare(__doc__)
    found = []
    for label, task in drawn:
        figures = {**arrivals(search, task, rng), **shares(search, task, options.rounds, rng)}
        found.append({"task": task.tolist(), "label": label, **figures})
        print(f"{label}: {_line(figures)}", flush=True)
    names = ("bias", "spread", "open", "improved")
    medians = {name: float(np.median([item[name] for item in found])) for name in names}
    means = np.mean([item["shares"] for item in found], axis=0).tolist()
    print(f"medians, and mean shares, of {len(found)}: {_line({**medians, 'shares': means})}")
    if options.json:
        print(json.dumps(found))


def arrivals(search, task, rng):
    """{bias, spread, open: m} of the root's place with the evaluation's noise, of the policy of a `limits.Search`."""
    still = np.zeros((1, search.steps, NUM_DOF))
    at = nearest(search.play(task, still)[0])[2]
    actions, noise = search.acted[0], _noise(search, rng)
    bias, spread = _scatter(search, search.play(task, noise, at))
    return {"bias": bias, "spread": spread, "open": _scatter(search, search.play(task, noise, at, actions))[1]}


def _scatter(search, played):
    """(bias, spread) in metres of the root's place over the simulations that stand at the step looked at."""
    ratios, residuals = played
    place = residuals[:, :3] * search.final[0]
    return float(np.linalg.norm(place.mean(axis=0))), math.sqrt(place.var(axis=0).sum())


def shares(search, task, rounds, rng):
    """{improved: ratio of the improved motion; shares: of its plays with noise in the last 1, 2, 3 and all steps up to
    its arrival, those within the final accuracy there}."""
    figures = search.improve(task, rounds, rng)
    at = figures["step"] - 1
    search.play(task, np.array([figures["offsets"]]))
    actions, noise = search.acted[0], _noise(search, rng)
    within = []
    for last in (*LAST, at + 1):
        some = noise.copy()
        some[:, : max(at + 1 - last, 0)] = 0.0
        within.append(float((search.play(task, some, actions=actions)[0][:, at] <= 1.0).mean()))
    return {"improved": figures["improved"], "shares": within}


def _noise(search, rng):
    return rng.normal(0.0, search.noise, (search.simulations, search.steps, NUM_DOF))


def _line(figures):
    within = ", ".join(f"{share:.2f}" for share in figures["shares"])
    return (
        f"bias {figures['bias']:.3f} m, spread {figures['spread']:.3f} m ({figures['open']:.3f} m in open loop); "
        f"improved to {figures['improved']:.2f}, with noise in the last 1, 2, 3 and all steps {within} within"
    )


if __name__ == "__main__":
    main()
