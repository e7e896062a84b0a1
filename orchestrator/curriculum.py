"""The curriculum of shrinking thresholds (Eq. 16): a pure function of the outcomes in order."""

from dataclasses import dataclass, replace

import numpy as np

from motion.state_machine import build_state_machine
from orchestrator import focus
from orchestrator.metrics import summarize
from workers.library import build_library
from workers.types import REACHED, Thresholds, concatenate_outcomes, judging


@dataclass(frozen=True)
class CurriculumState:
    """window: (reached, ended) per entry, oldest first; tightenings: cuts so far; achieved_at: iteration at which the
    final accuracy was set as threshold, or None; iteration: chunks observed; tally: see `orchestrator.focus`."""

    window: tuple = ()
    tightenings: int = 0
    iteration: int = 0
    achieved_at: int | None = None
    tally: np.ndarray | None = None


def final_tightenings(config):
    """How many cuts it takes until every threshold is at its floor."""
    count = 0
    while any(start * config.factor**count > floor for start, floor in zip(config.start, config.floor)):
        count += 1
    return count


def thresholds(config, reach, tightenings):
    """`Thresholds` after so many cuts: each start value times factor^tightenings, but not below its floor.

    config: `CurriculumConfig`; reach: `workers.config.ReachConfig`.
    """
    cut = config.factor**tightenings
    values = [max(start * cut, floor) for start, floor in zip(config.start, config.floor)]
    heading = max(reach.heading_start * cut, reach.heading_floor) if reach.heading else np.inf
    return Thresholds(*values, heading=heading, tightenings=tightenings)


def observe(state, config, outcomes):
    """The `CurriculumState` after the outcomes of one more iteration (episodes in the order in which they ended).

    The window holds the last `config.window` iterations or episodes. When it is full and the achievement rate over it
    exceeds `config.achievement`, the thresholds are cut once and the window starts again: with episodes that the new
    thresholds judged, not those that were on their way (in a pipeline, a whole chunk) when the cut was made.
    """
    iteration = state.iteration + 1
    if not config.count_retained:
        outcomes = outcomes.take(~outcomes.retained)
    reached = outcomes.end == REACHED
    if config.window_unit == "iterations":
        judged = outcomes.tightenings == state.tightenings
        entries = [(int(reached[judged].sum()), int(judged.sum()), state.tightenings)]
        if len(outcomes) and not judged.any():
            entries = []
    else:
        entries = [(int(hit), 1, int(cuts)) for hit, cuts in zip(reached, outcomes.tightenings)]
    window, tightenings = state.window, state.tightenings
    for hits, count, cuts in entries:
        if cuts != tightenings:
            continue
        window = (*window, (hits, count))[-config.window :]
        if len(window) == config.window and _rate(window) > config.achievement:
            window, tightenings = (), tightenings + 1
    last = final_tightenings(config)
    tightenings = min(tightenings, last)
    achieved_at = state.achieved_at
    if achieved_at is None and tightenings == last:
        achieved_at = iteration
    return replace(state, window=window, tightenings=tightenings, iteration=iteration, achieved_at=achieved_at)


def _rate(window):
    ended = sum(count for _, count in window)
    return sum(hits for hits, _ in window) / ended if ended else 0.0


class Curriculum:
    """Tracks the achievement rate and broadcasts thresholds: the part of a run that a Ray actor holds."""

    def __init__(self, config, saved=None):
        """config: the run's `orchestrator.config.Config`; saved: what `saved()` gave, to continue from."""
        self._config = config
        self._state = saved or CurriculumState()
        self._library = build_library(build_state_machine(config.motions)) if config.task.focus else None
        if self._library and self._state.tally is None:
            self._state = replace(self._state, tally=focus.empty_tally(self._library))

    def thresholds(self):
        """The thresholds in force."""
        limits = thresholds(self._config.curriculum, self._config.reach, self._state.tightenings)
        return replace(limits, shares=focus.shares(self._state.tally)) if self._library else limits

    def observe(self, *outcomes):
        """(thresholds after one more iteration's outcomes, summary of these outcomes)."""
        joined = concatenate_outcomes(outcomes)
        judges = self._config.policy.judges
        counted = joined.take(judging(joined.environment, judges)) if judges else joined
        self._state = observe(self._state, self._config.curriculum, counted)
        if self._library:
            self._state = replace(self._state, tally=focus.count(self._state.tally, joined, self._library))
        return self.thresholds(), summarize(joined, counted)

    def saved(self):
        """The state, for a checkpoint."""
        return self._state
