"""A machine of the cluster dies in the middle of a run: the run goes on where there is room, with the same numbers."""

import pytest

from tests.cluster.__main__ import main


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_sweep_whose_machine_is_killed_has_the_numbers_of_one_process(capfd):
    arguments = ["--kill", "1", "--after", "4", "--workers", "2", "checkpoint.every=2", "budget.iterations=14"]
    status = main(arguments)
    output = capfd.readouterr().out
    assert status == 0, output
    assert "killed node 1" in output and "metrics identical" in output
