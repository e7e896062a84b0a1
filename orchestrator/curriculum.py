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
    final accuracy was set as threshold, or None; iteration: chunks observed; tally: see `orchestrator.focus`.

    tracks: with a `curriculum.scope` other than `run`, one (window, tightenings) for each of its sources or groups;
    then `window` is empty and `tightenings` the fewest of them.
    """

    window: tuple = ()
    tightenings: int = 0
    iteration: int = 0
    achieved_at: int | None = None
    tally: np.ndarray | None = None
    tracks: tuple = ()


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


def observe(state, config, outcomes, track=None):
    """The `CurriculumState` after the outcomes of one more iteration (episodes in the order in which they ended).

    The window holds the last `config.window` iterations or episodes. When it is full and the achievement rate over it
    exceeds `config.achievement`, the thresholds are cut once and the window starts again: with episodes that the new
    thresholds judged, not those that were on their way (in a pipeline, a whole chunk) when the cut was made.

    track: (E,), the place in `state.tracks` of each episode, where there are any: each goes its own way like that.
    """
    if not config.count_retained:
        kept = ~outcomes.retained
        outcomes, track = outcomes.take(kept), track if track is None else track[kept]
    if state.tracks:
        tracks = tuple(
            _advance(*one, config, outcomes.take(track == number)) for number, one in enumerate(state.tracks)
        )
        window, tightenings = (), min(cuts for _, cuts in tracks)
    else:
        tracks = ()
        window, tightenings = _advance(state.window, state.tightenings, config, outcomes)
    iteration, achieved_at = state.iteration + 1, state.achieved_at
    if achieved_at is None and tightenings == final_tightenings(config):
        achieved_at = iteration
    return replace(
        state, window=window, tightenings=tightenings, iteration=iteration, achieved_at=achieved_at, tracks=tracks
    )


def _advance(window, tightenings, config, outcomes):
    """(window, tightenings) of one sequence of thresholds after its episodes of one more iteration."""
    reached = outcomes.end == REACHED
    if config.window_unit == "iterations":
        judged = outcomes.tightenings == tightenings
        entries = [(int(reached[judged].sum()), int(judged.sum()), tightenings)]
        if len(outcomes) and not judged.any():
            entries = []
    else:
        entries = [(int(hit), 1, int(cuts)) for hit, cuts in zip(reached, outcomes.tightenings)]
    for hits, count, cuts in entries:
        if cuts != tightenings:
            continue
        window = (*window, (hits, count))[-config.window :]
        if len(window) == config.window and _rate(window) > config.achievement:
            window, tightenings = (), tightenings + 1
    return window, min(tightenings, final_tightenings(config))


def tracks_of(scope, groups):
    """The track (G,) int64 of every group (G, 2) of source and target, numbered from 0, by `curriculum.scope`."""
    if scope == "run":
        return np.zeros(len(groups), dtype=np.int64)
    return np.unique(groups[:, 0] if scope == "source" else np.arange(len(groups)), return_inverse=True)[1]


def _rate(window):
    ended = sum(count for _, count in window)
    return sum(hits for hits, _ in window) / ended if ended else 0.0


class Curriculum:
    """Tracks the achievement rate and broadcasts thresholds: the part of a run that a Ray actor holds."""

    def __init__(self, config, saved=None):
        """config: the run's `orchestrator.config.Config`; saved: what `saved()` gave, to continue from."""
        self._config = config
        self._state = saved or CurriculumState()
        scope = config.curriculum.scope
        if config.task.focus or scope != "run":
            self._library = build_library(build_state_machine(config.motions))
            self._track = tracks_of(scope, self._library.groups)
        if config.task.focus and self._state.tally is None:
            self._state = replace(self._state, tally=focus.empty_tally(self._library))
        if scope != "run" and not self._state.tracks:
            self._state = replace(self._state, tracks=(((), self._state.tightenings),) * (self._track.max() + 1))

    def thresholds(self):
        """The thresholds in force."""
        state, config = self._state, self._config
        limits = thresholds(config.curriculum, config.reach, state.tightenings)
        if state.tally is not None:
            limits = replace(limits, shares=focus.shares(state.tally))
        if state.tracks:
            own = [thresholds(config.curriculum, config.reach, cuts) for _, cuts in state.tracks]
            rows = np.concatenate([one.of(np.zeros(1)) for one in own])[self._track]
            limits = replace(limits, groups=tuple(map(tuple, rows.tolist())))
        return limits

    def observe(self, *outcomes):
        """(thresholds after one more iteration's outcomes, summary of these outcomes)."""
        joined = concatenate_outcomes(outcomes)
        judges = self._config.policy.judges
        counted = joined.take(judging(joined.environment, judges)) if judges else joined
        track = self._track[self._library.group_of(counted.task)] if self._state.tracks else None
        self._state = observe(self._state, self._config.curriculum, counted, track)
        if self._state.tally is not None:
            self._state = replace(self._state, tally=focus.count(self._state.tally, joined, self._library))
        return self.thresholds(), summarize(joined, counted)

    def saved(self):
        """The state, for a checkpoint."""
        return self._state
