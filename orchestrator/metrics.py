"""What one iteration's outcomes and update say, under the names that metrics.jsonl and MLflow use."""

import numpy as np

from motion import skeleton
from workers.types import FELL, REACHED, REWARD_PARTS, TIMED_OUT


def summarize(outcomes, counted):
    """Metrics (dict) of the episodes that ended in one iteration; None where no episode ended.

    counted: those of them that the curriculum counts; all but where `policy.judges` chooses.
    """
    count = len(outcomes)
    metrics = {"episode/count": count}

    def share(mask):
        return float(mask.mean()) if count else None

    returns = outcomes.parts.sum(axis=1)
    metrics["return/mean"] = float(returns.mean()) if count else None
    for i, name in enumerate(REWARD_PARTS):
        metrics[f"return/{name}"] = float(outcomes.parts[:, i].mean()) if count else None
    metrics["achievement"] = share(outcomes.end == REACHED)
    fresh = outcomes.end[~outcomes.retained] == REACHED
    metrics["achievement_fresh"] = float(fresh.mean()) if len(fresh) else None
    judged = counted.end[~counted.retained] == REACHED
    metrics["achievement_judged"] = float(judged.mean()) if len(judged) else None
    for name, end in (("reached", REACHED), ("fell", FELL), ("timed_out", TIMED_OUT)):
        metrics[f"end/{name}"] = share(outcomes.end == end)
    fell = outcomes.end == FELL
    # the cause of every fall: which body touched the ground; a simulation that exploded is body -1
    for body, name in enumerate(skeleton.BODY_NAMES):
        if (fell & (outcomes.fell_on == body)).any():
            metrics[f"fell_on/{name}"] = share(fell & (outcomes.fell_on == body))
    unstable = fell & (outcomes.fell_on < 0)
    metrics["end/unstable"] = share(unstable)
    metrics["physics/unstable"] = len(np.unique(outcomes.environment[unstable]))
    metrics["episode/steps"] = float(outcomes.steps.mean()) if count else None
    metrics["episode/trembles"] = float(outcomes.trembles.mean()) if count else None
    metrics["episode/root_rotation"] = float(outcomes.deviations[:, 2].mean()) if count else None
    return metrics


def describe_thresholds(thresholds):
    """Metrics (dict) of the thresholds in force; where they differ between tasks, the loosest, and how far all got."""
    metrics = {
        "thresholds/root_position": thresholds.root_position,
        "thresholds/key_bodies": thresholds.key_bodies,
        "thresholds/joint_rotation": thresholds.joint_rotation,
        "thresholds/tightenings": thresholds.tightenings,
    }
    if thresholds.groups:
        cuts = [group[-1] for group in thresholds.groups]
        metrics |= {"thresholds/mean_tightenings": float(np.mean(cuts)), "thresholds/most_tightenings": int(max(cuts))}
    return metrics
