"""Killing any process at any time changes no number of a run."""

import pytest

from tests.chaos.killer import ITERATIONS, VICTIMS, Kill, disturbed, numbers, plan, undisturbed


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    return undisturbed(tmp_path_factory.mktemp("chaos") / "undisturbed")


def test_a_plan_is_a_function_of_its_seed_and_names_only_known_victims():
    assert plan(3, 20) == plan(3, 20) != plan(4, 20)
    assert {kill.victim for seed in range(5) for kill in plan(seed, 50)} == set(VICTIMS)
    assert all(0 < kill.iteration < ITERATIONS for kill in plan(0, 100))


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize(
    "kills",
    [
        # actors, one after the other and several at once
        [Kill(i, "worker", 0.02) for i in (10, 30, 30)]
        + [Kill(100, "worker", 0.0), Kill(100, "learner", 0.0), Kill(100, "curriculum", 0.0)],
        # the command itself too, whose kill and stop test_sweep.py and test_commands.py hold
        pytest.param(
            [
                Kill(9, "learner", 0.01), Kill(20, "driver", 0.05), Kill(60, "driver, politely", 0.02),
                Kill(90, "curriculum", 0.0), Kill(90, "worker", 0.0),
            ],
            marks=pytest.mark.exhaustive,
        ),
    ],
    ids=["actors", "commands"],
)  # fmt: skip
def test_a_run_whose_processes_are_killed_is_the_undisturbed_run(kills, reference, tmp_path):
    report = disturbed(tmp_path / "run", sorted(kills, key=lambda kill: kill.iteration), reference)
    assert len(report.recovery) >= len(kills) - 2, report.output[-3000:]  # one may find its victim just being replaced
    assert len(numbers(tmp_path / "run")) == ITERATIONS
    assert (report.wrong_lines, report.wrong_steps, report.same_weights) == (0, 0, True), report.output[-3000:]
