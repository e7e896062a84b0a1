"""`orchestrator.focus`: the tally against one written out, and what it makes of the tasks that are drawn."""

from dataclasses import replace

import numpy as np
import pytest

from motion.errors import InputError
from orchestrator import focus
from orchestrator.curriculum import Curriculum
from orchestrator.settings import build, command_line
from workers.planner import cells_of
from workers.rollout import Rollout
from workers.types import REACHED


def test_the_tally_fades_counts_fresh_episodes_and_gives_shares_by_failure(trajectories, library):
    tally, ended, slow = focus.empty_tally(library), 0, {}
    for chunk in trajectories.chunks:
        outcomes = chunk.outcomes
        before, kept = tally, tally.copy()
        tally = focus.count(tally, outcomes, library)
        np.testing.assert_array_equal(before, kept)
        slow = {cell: (focus.FADE * failed, focus.FADE * count) for cell, (failed, count) in slow.items()}
        for i, cell in enumerate(cells_of(outcomes.task, library).tolist()):
            if not outcomes.retained[i]:
                failed, count = slow.get(cell, (0.0, 0.0))
                slow[cell] = failed + (outcomes.end[i] != REACHED), count + 1
                ended += 1
    assert ended > 20
    for cell in range(tally.shape[1]):
        np.testing.assert_allclose(tally[:, cell], slow.get(cell, (0.0, 0.0)))
    mean = (sum(f for f, _ in slow.values()) + 1) / (sum(n for _, n in slow.values()) + 2)
    rates = [
        (failed + focus.PRIOR * mean) / (count + focus.PRIOR)
        for failed, count in (slow.get(cell, (0.0, 0.0)) for cell in range(tally.shape[1]))
    ]
    np.testing.assert_allclose(np.diff([0.0, *focus.shares(tally)]), np.array(rates) / sum(rates))


def test_before_the_first_outcome_all_cells_have_the_same_share(library):
    shares = np.diff([0.0, *focus.shares(focus.empty_tally(library))])
    np.testing.assert_allclose(shares, 1 / len(shares))


def test_judges_draw_uniformly_and_the_others_where_it_fails(library, make_config, make_policy, easy):
    """All share on one cell: new tasks of exploring environments lie in it, those of judges are the paper's."""
    cell = 37
    shares = tuple(float(c >= cell) for c in range(len(library.groups) * 32))
    policy = replace(make_policy(), judges=4)
    tasks = {}
    for share in (0.0, 1.0):
        config = make_config(
            {"task.focus": share, "policy.judges": 4, "task.max_steps": 4, "task.stay_probability": 0.0}
        )
        rollout = Rollout(config, library, 16, 12, 5)
        _, state = rollout.collect(rollout.initial_state(0), policy, replace(easy, shares=shares))
        tasks[share] = state.task
    judge = np.arange(16) % 4 == 0
    assert (cells_of(tasks[1.0][~judge], library) == cell).all()
    np.testing.assert_array_equal(tasks[1.0][judge], tasks[0.0][judge])
    assert (cells_of(tasks[0.0][~judge], library) != cell).any()


def test_the_curriculum_broadcasts_the_shares_of_what_it_saw(trajectories, make_config, library):
    config = make_config({"task.focus": 0.5, "policy.judges": 4})
    curriculum = Curriculum(config)
    limits, _ = curriculum.observe(trajectories.chunks[0].outcomes)
    wanted = focus.count(focus.empty_tally(library), trajectories.chunks[0].outcomes, library)
    assert limits.shares == focus.shares(wanted) == curriculum.thresholds().shares
    again = Curriculum(config, curriculum.saved())
    assert again.thresholds() == curriculum.thresholds()
    assert Curriculum(make_config()).thresholds().shares == ()


def test_focus_needs_judges():
    with pytest.raises(InputError, match="task.focus=0.5 needs judging environments.*policy.judges=8"):
        build([command_line(["scale=smoke", "task.focus=0.5", "policy.judges=0"])])
